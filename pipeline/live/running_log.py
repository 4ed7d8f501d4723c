"""What is known of a log that is still being written.

Repeated tests of growing evidence exceed any threshold in the end by chance. An effect therefore passes a
stricter test here than in a finished log, and passes it in two successive looks.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from pipeline.core import pick_finite
from pipeline.estimation.decision import LEAST_T
from pipeline.estimation.driving_need import find_goal
from pipeline.models import list_effects
from pipeline.results import (
    ABOVE_FLOOR,
    INTERVAL_SHARE,
    Named,
    RunDiagnosis,
    Value,
    find_refusal,
    measure_excess,
)
from pipeline.words import (
    describe_alarm,
    describe_clause,
    describe_need,
    describe_separation,
    format_step,
    suggest_drive,
)

RUNNING_T = 2.0 * LEAST_T
"""Threshold of t for naming in a running log, `LEAST_T` in a finished one: `make bench NAME=watch` counts
retracted names."""
_MOST_ASKS = 3
"""Maximum number of manoeuvres to ask for at once: as many as can be read while driving."""


@dataclass(frozen=True)
class Stated:
    """An effect that is reported of a log so far.

    Attributes:
        id: id of the effect.
        text: its influence on the motion, with its parameters.
        numbers: ``value``, ``low``, ``high`` and ``unit`` by parameter.
    """

    id: str
    text: str
    numbers: Mapping[str, Mapping[str, object]]

    def to_json(self) -> dict[str, object]:
        """The object of one effect."""
        return {
            "effect": self.id,
            "text": self.text,
            "parameters": {k: dict(v) for k, v in self.numbers.items()},
        }


def list_passing(diagnosis: RunDiagnosis) -> list[str]:
    """Ids of the effects that pass the test of a running log, regardless of the look before."""
    return [effect.id for effect in diagnosis.effects if _passes(effect)]


def list_stated(diagnosis: RunDiagnosis, before: Sequence[str]) -> list[Stated]:
    """The effects that may be reported after this look.

    Args:
        diagnosis: of the log so far.
        before: result of `list_passing` for the look before.
    """
    return [
        Stated(
            effect.id,
            describe_clause(effect, diagnosis),
            {
                name: {
                    **pick_finite(value, "value", "low", "high"),
                    "unit": value.unit,
                    "share": _measure_share(effect.id, name, value),
                }
                for name, value in effect.parameters.items()
            },
        )
        for effect in diagnosis.effects
        if _passes(effect) and effect.id in before
    ]


def summarize_knowledge(diagnosis: RunDiagnosis, before: Sequence[str]) -> dict[str, object]:
    """What is known after a look, what is not, and what to drive for it.

    Args:
        diagnosis: of the log so far.
        before: result of `list_passing` for the look before.

    Returns:
        ``stated``: effects with their parameters and relative uncertainties; ``waiting``: ids of effects that
        a second look must confirm; ``undecided``, ``unseen``: effects that are not separated or not
        observable; ``drive``: manoeuvres for them; ``enough``: whether more driving of this kind changes
        nothing, so that none is suggested; ``data``, ``error``, ``problem``: sentences; ``passing``: ids for
        the next look; ``alarms``: numbers beyond the range in which learners on board let them go.
    """
    passing = list_passing(diagnosis)
    stated = list_stated(diagnosis, before)
    names = {one.id for one in stated}
    unseen = [*diagnosis.unobservable_why]
    waiting = [one.id for one in diagnosis.effects if not one.corrected and one.id not in names]
    is_enough = _is_enough(diagnosis, stated, waiting)
    asks = [describe_separation(one) for one in diagnosis.undecided]
    asks += [part for name in unseen for part in suggest_drive(name).split("; ")]
    ladder = diagnosis.ladder
    problems = [one.text for one in diagnosis.findings if one.where == "diagnosis"]
    return {
        "stated": [one.to_json() for one in stated],
        "waiting": waiting,
        "undecided": [list(one.candidates) for one in diagnosis.undecided],
        "unseen": unseen,
        "drive": [] if is_enough else list(dict.fromkeys(asks))[:_MOST_ASKS],
        "enough": is_enough,
        "data": describe_need(diagnosis) or None,
        "error": format_step(ladder[-1]) if ladder else None,
        "problem": "" if ladder else next(iter(problems), find_refusal(diagnosis.findings)),
        "passing": passing,
        "alarms": list_alarms(one for one in diagnosis.effects if one.id in names),
    }


def list_alarms(effects: Iterable[Named]) -> list[dict[str, object]]:
    """Numbers of effects that are beyond the range in which learners on board let them go."""
    kinds, alarms = {kind.id: kind for kind in list_effects()}, list[dict[str, object]]()
    for effect in effects:
        for parameter in kinds[effect.id].parameters if effect.id in kinds else ():
            within, number = parameter.learned_within, effect.parameters.get(parameter.name)
            if within is not None and number is not None and not within.low <= number.value <= within.high:
                text = describe_alarm(effect.id, parameter, number.value)
                alarm = {"effect": effect.id, "parameter": parameter.name, "value": number.value}
                alarms.append({**alarm, "low": within.low, "high": within.high, "text": text})
    return alarms


def _is_enough(diagnosis: RunDiagnosis, stated: Sequence[Stated], waiting: Sequence[str]) -> bool:
    """Whether all effects are reported and known accurately, and the model is at the noise floor."""
    known = all(
        number["share"] is not None and cast("float", number["share"]) <= INTERVAL_SHARE
        for one in stated
        for number in one.numbers.values()
    )
    is_open = bool(waiting or diagnosis.undecided)
    return bool(stated) and known and not is_open and 0.0 < measure_excess(diagnosis) < ABOVE_FLOOR


def _passes(effect: Named) -> bool:
    """Whether a named effect has the evidence required in a running log; corrected clocks are excluded."""
    return not effect.corrected and measure_t(effect) >= RUNNING_T


def measure_t(effect: Named) -> float:
    """The t value of an effect at the end of the log so far; 0 if it was not searched for."""
    evidence = None if effect.growth is None else effect.growth.evidence
    return float(np.nan_to_num(evidence.t[-1])) if evidence is not None and evidence.t else 0.0


def _measure_share(effect: str, name: str, number: Value) -> float | None:
    """Half-width of an interval relative to the value, or to a typical one if that is larger."""
    if not math.isfinite(number.high - number.low):
        return None
    return INTERVAL_SHARE * 0.5 * (number.high - number.low) / find_goal(effect, name, number.value)
