"""From what a search found to what is named: classes that cannot be told apart, and clocks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.diagnosis.context import Context, is_late
from pipeline.diagnosis.excitation import suggest_manoeuvre
from pipeline.diagnosis.naming import Search
from pipeline.diagnosis.undecided import Undecided
from pipeline.models.catalogue import find_late_effect, list_effects
from pipeline.models.conditions import LEAST_DELAY_S
from pipeline.models.effect import Effect, Late, find_late

_SKEWED_CLOCK = 0.03


@dataclass(frozen=True)
class Clocks:
    """What the delays of a run come to.

    Attributes:
        effects: of late poses and of a late heading, as far as they are certain.
        timing: of every run, in JSON's words.
        undecided: a late heading whose position may be late with it or not.
    """

    effects: tuple[Effect, ...]
    timing: tuple[Mapping[str, float | str | None], ...]
    undecided: tuple[Undecided, ...] = ()


def read_clocks(context: Context, body: Search) -> Clocks:
    """Name clocks: with a gyro the delays of heading and position are known apart."""
    state = body.final.state
    extra = find_late(state.effects, Late.POSES)
    rows, positions, certain = [], [], []
    for number, (timing, run) in enumerate(zip(state.timing, context.runs, strict=True)):
        yaw = run.alignment.heading_delay_s
        own = find_late(state.effects_of(number), Late.POSES)
        more = own.delay if own is not None else 0.0
        late = yaw + more
        positions.append(late)
        certain.append(is_late(run))
        rows.append(
            {
                "heading": "gyro" if run.gyro_fit is not None else "pose",
                "pose_delay_s": round(late, 4),
                "yaw_delay_s": None if run.gyro_fit is None else round(yaw, 4),
                "wheel_delay_s": round(timing.wheel_delay_s, 4) if body.way == "measured" else None,
            }
        )
    found: list[Effect] = []
    late = float(np.mean(positions))
    # A heading that is older than its position is known; the other way round it is a late position.
    skewed = extra is not None and context.has_gyro and more < 0.0
    if skewed:
        found.append(find_late_effect(Late.HEADING).of_delay(-more))
    least = max(LEAST_DELAY_S, _SKEWED_CLOCK if skewed else 0.0)
    known = extra is not None if not context.has_gyro else any(certain)
    if known and max(map(abs, positions)) >= least:
        clock = find_late_effect(Late.POSES).of_delay(late)
        if context.has_gyro and not context.largest.moves_both_ways:
            # The gyro dates the heading; only driving and turning at once tie the position's clock to it.
            skew = find_late_effect(Late.HEADING)()
            pair = Undecided((clock.id, skew.id), suggest_manoeuvre(clock, skew))
            return Clocks(tuple(found), tuple(rows), (pair,))
        found.append(clock)
    return Clocks(tuple(found), tuple(rows))


def join_classes(effects: Sequence[Effect]) -> list[Effect]:
    """Effects with those of which all parts were found put under their own name."""
    found = {effect.id: effect for effect in effects}
    for kind in list_effects():
        parts = kind().searched_as
        if kind.parts and parts <= found.keys():
            found = {name: effect for name, effect in found.items() if name not in parts} | {
                kind.id: kind.join(found)
            }
    return list(found.values())


def list_equivalents(effect: Effect, context: Context) -> tuple[str, ...]:
    """Other names of the same thing, as far as this recording goes."""
    return effect.equivalent_to if effect.is_equivalent(context.conditions) else ()
