"""Questions: of what a diagnosis left undecided, of numbers that are not known well, of effects by name."""

from collections.abc import Container, Iterable, Sequence

import numpy as np

from pipeline.core.numbers import NORMAL_95
from pipeline.identification.growth import find_goal
from pipeline.models import find_effect, list_effects
from pipeline.models.conditions import Largest
from pipeline.plan.errors import PlanError
from pipeline.plan.knowledge import Hypothesis, Knowledge
from pipeline.plan.questions import DECIDED_T, Precision, Separation


def ask_undecided(knowledge: Knowledge, groups: Iterable[Sequence[str]]) -> list[Separation]:
    """Which of the candidates of each group acts: the first against every other, each fitted to the logs."""
    found = []
    for group in groups:
        rest = [effect for effect in knowledge.base.effects if effect.id not in group]
        first, *others = [knowledge.suppose([*rest, find_effect(name)()]) for name in group]
        found += [
            Separation(f"{group[0]} or {name}", (group[0], name), (first, other))
            for name, other in zip(group[1:], others, strict=True)
        ]
    return found


def ask_apart(knowledge: Knowledge, settled: Container[str] = ()) -> list[Separation]:
    """Whether what is named may be something else that looks alike: one effect that stands for one or more.

    Asked is what the logs so far leave open.

    Args:
        knowledge: where the plan starts from.
        settled: ids of effects of which something else is asked.
    """
    base = knowledge.base
    named = [effect for effect in base.effects if effect.id not in settled]
    if knowledge.fitted is None:
        return []
    swaps: dict[tuple[tuple[str, ...], str], None] = {}
    for effect in named:
        for name in effect.confused_with:
            alike = tuple(one.id for one in named if name in one.confused_with)
            swaps |= dict.fromkeys([((effect.id,), name), (alike, name)])
    found = []
    for dropped, name in swaps:
        other = find_effect(name)()
        if knowledge.vehicle.kind not in other.kinds or set(dropped) & {name, *other.contains}:
            continue
        rest = [effect for effect in base.effects if effect.id not in {*dropped, name}]
        rival, apart = knowledge.rival([*rest, other])
        if apart < DECIDED_T:
            text = f"{' and '.join(dropped)} or {name}"
            found.append(Separation(text, (*dropped, name), (base, rival), both_ways=False))
    return found


def ask_numbers(model: Hypothesis) -> list[Precision]:
    """How large each number of a model is, of those that are not known to five percent yet."""
    spread = np.sqrt(np.diag(np.linalg.inv(model.information))) if model.free else np.zeros(0)
    found = []
    for place, number in enumerate(model.free):
        goal = find_goal(number.effect, number.name, float(model.values[place]))
        if NORMAL_95 * float(spread[place]) > goal:
            unit = "" if number.unit == "1" else f" {number.unit}"
            text = f"{number.label} within {goal:.2g}{unit}"
            found.append(Precision(text, (number.effect,), model, place, goal))
    return found


def ask_presence(knowledge: Knowledge, names: Iterable[str], largest: Largest) -> list[Separation]:
    """Whether effects act that the logs could not show: of a usual size each, against their absence.

    Raises:
        PlanError: ``wrong_vehicle``, one does not exist on this kind of vehicle.
        MotionError: ``unknown_effect``.
    """
    found = []
    for name in names:
        effect = find_effect(name)
        if knowledge.vehicle.kind not in effect.kinds:
            what = f"{name} exists on {' or '.join(effect.kinds)} vehicles only"
            raise PlanError("wrong_vehicle", what, where=knowledge.vehicle.id, hint="Choose another effect.")
        if name in knowledge.base.names:
            continue
        with_it = knowledge.base.extend(effect().make_usual(largest))
        found.append(Separation(f"whether {name} acts", (name,), (with_it, knowledge.base), both_ways=False))
    return found


def list_names(knowledge: Knowledge) -> tuple[str, ...]:
    """Every effect of the catalogue that exists on the vehicle."""
    return tuple(effect.id for effect in list_effects() if knowledge.vehicle.kind in effect.kinds)
