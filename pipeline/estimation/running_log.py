"""Diagnosis of a log that is still being written: effects and intervals that remain valid at its end.

Repeated tests of growing evidence exceed any threshold in the end by chance. An effect therefore passes a
stricter test here than in a finished log, and passes it in two successive looks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from pipeline.core.untrusted import objects_in
from pipeline.estimation.acceptance import LEAST_T
from pipeline.estimation.error_regions import ABOVE_FLOOR, format_errors
from pipeline.estimation.learning import INTERVAL_SHARE, find_goal
from pipeline.estimation.verdict import find_refusal, measure_excess

Content = Mapping[str, object]

RUNNING_T = 2.0 * LEAST_T
"""Threshold of t for naming in a running log, `LEAST_T` in a finished one: `make watch-replay` counts
retracted names."""
_MOST_ASKS = 3
"""Maximum number of manoeuvres to ask for at once: as many as can be read while driving."""
NUMBER_KEYS = ("value", "low", "high", "unit")


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


def list_passing(diagnosis: Content) -> list[str]:
    """Ids of the effects that pass the test of a running log, regardless of the look before.

    Args:
        diagnosis: the JSON object of a run as in ``slip diagnose --json``.
    """
    return [str(effect["id"]) for effect in objects_in(diagnosis, "effects") if _passes(effect)]


def list_stated(diagnosis: Content, before: Sequence[str]) -> list[Stated]:
    """The effects that may be reported after this look.

    Args:
        diagnosis: the JSON object of a run.
        before: result of `list_passing` for the look before.
    """
    return [
        Stated(
            str(effect["id"]),
            str(effect["clause"]),
            {
                name: {
                    **{key: value.get(key) for key in NUMBER_KEYS},
                    "share": _measure_share(str(effect["id"]), name, value),
                }
                for name, value in cast("Mapping[str, Content]", effect["parameters"]).items()
            },
        )
        for effect in objects_in(diagnosis, "effects")
        if _passes(effect) and effect["id"] in before
    ]


def summarize_knowledge(diagnosis: Content, before: Sequence[str]) -> dict[str, object]:
    """What is known after a look, what is not, and what to drive for it.

    Args:
        diagnosis: the JSON object of a run.
        before: result of `list_passing` for the look before.

    Returns:
        ``stated``: effects with their parameters and relative uncertainties; ``waiting``: ids of effects that
        a second look must confirm; ``undecided``, ``unseen``: effects that are not separated or not
        observable; ``drive``: manoeuvres for them; ``enough``: whether more driving of this kind changes
        nothing, so that none is suggested; ``data``, ``error``, ``problem``: sentences; ``passing``: ids for
        the next look.
    """
    passing = list_passing(diagnosis)
    stated = list_stated(diagnosis, before)
    names = {one.id for one in stated}
    undecided = objects_in(diagnosis, "undecided")
    unseen = cast("Mapping[str, Content]", diagnosis.get("unobservable_why") or {})
    named = [one for one in objects_in(diagnosis, "effects") if not one["corrected"]]
    waiting = [str(one["id"]) for one in named if one["id"] not in names]
    is_enough = _is_enough(diagnosis, stated, waiting)
    asks = [str(one["separate_by"]) for one in undecided]
    asks += [part for one in unseen.values() for part in str(one["manoeuvre"]).split("; ")]
    ladder = objects_in(diagnosis, "ladder")
    problems = [
        str(one["text"]) for one in objects_in(diagnosis, "findings") if one.get("where") == "diagnosis"
    ]
    return {
        "stated": [one.to_json() for one in stated],
        "waiting": waiting,
        "undecided": [one["candidates"] for one in undecided],
        "unseen": list(unseen),
        "drive": [] if is_enough else list(dict.fromkeys(asks))[:_MOST_ASKS],
        "enough": is_enough,
        "data": diagnosis.get("enough"),
        "error": format_errors(ladder[-1]) if ladder else None,
        "problem": "" if ladder else next(iter(problems), find_refusal(diagnosis)),
        "passing": passing,
    }


def _is_enough(diagnosis: Content, stated: Sequence[Stated], waiting: Sequence[str]) -> bool:
    """Whether all effects are reported and known accurately, and the model is at the noise floor."""
    known = all(
        number["share"] is not None and cast("float", number["share"]) <= INTERVAL_SHARE
        for one in stated
        for number in one.numbers.values()
    )
    is_open = bool(waiting or diagnosis.get("undecided"))
    return bool(stated) and known and not is_open and 0.0 < measure_excess(diagnosis) < ABOVE_FLOOR


def _passes(effect: Content) -> bool:
    """Whether a named effect has the evidence required in a running log; corrected clocks are excluded."""
    return not (effect["tentative"] or effect["corrected"]) and measure_t(effect) >= RUNNING_T


def measure_t(effect: Content) -> float:
    """The t value of an effect at the end of the log so far; 0 if it was not searched for."""
    evidence = cast("Content", effect.get("growth") or {}).get("evidence")
    values = cast("Sequence[float | None]", cast("Content", evidence or {}).get("t") or [])
    return float(values[-1] or 0.0) if values else 0.0


def _measure_share(effect: str, name: str, number: Content) -> float | None:
    """Half-width of an interval relative to the value, or to a typical one if that is larger."""
    value, low, high = (cast("float | None", number.get(key)) for key in ("value", "low", "high"))
    if value is None or low is None or high is None:
        return None
    return INTERVAL_SHARE * 0.5 * (high - low) / find_goal(effect, name, value)
