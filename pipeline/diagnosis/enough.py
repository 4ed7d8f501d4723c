"""Is the log long enough: intervals of numbers and evidence for names against the seconds that were used."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.core.numbers import finite_or_none
from pipeline.identification.growth import (
    INTERVAL_SHARE,
    Curve,
    extrapolate,
    find_goal,
    last_until,
    pick_points,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.diagnosis.diagnosis import Json, Named

# By less than this share the rest of a drive makes no interval narrower.
_NO_NARROWER = 0.1
# Nobody drives so many times as long for a number.
_TOO_LONG = 10.0
# Where driving is all alike, a fifth of it is as little.
_WORTH_SAYING = 0.25
_DIGITS = 4


@dataclass(frozen=True)
class Growth:
    """What was known of an effect by when.

    Attributes:
        evidence: t of its name, by which the loss on unseen data rises without it; None where it was not
            searched for.
        widths: half-width of the 95 % interval by parameter.
    """

    evidence: Curve | None
    widths: Mapping[str, Curve]

    def to_json(self) -> dict[str, Json]:
        """Curves of at most sixty points each."""
        return {
            "evidence": None if self.evidence is None else _list_points(self.evidence, "t"),
            "parameters": {name: _list_points(one, "half_width") for name, one in self.widths.items()},
        }


def _list_points(curve: Curve, name: str) -> dict[str, Json]:
    places = pick_points(curve.seconds.size)
    return {
        "seconds": [round(float(one), 1) for one in curve.seconds[places]],
        name: [finite_or_none(one, _DIGITS) for one in curve.values[places]],
    }


def _say(half: float, unit: str) -> str:
    return f"{half:.2g}" if unit == "1" else f"{half:.2g} {unit}"


def describe_enough(effects: Sequence[Named]) -> str:
    """Since when the numbers of a diagnosis were known, and how much of the drive made no difference.

    A number is known when its interval is a twentieth of it, or of a usual one where it is smaller.

    Returns:
        A sentence or two; empty where nothing was named that grows with driving.
    """
    known, vague, needed, driven, small = [], [], 0.0, 0.0, False
    for effect in effects:
        for name, curve in () if effect.growth is None else effect.growth.widths.items():
            value = effect.parameters.get(name)
            if value is None or not math.isfinite(curve.values[-1]):
                continue
            label, half = f"{effect.id}.{name}", float(curve.values[-1])
            goal = find_goal(effect.id, name, value.value)
            since = last_until(curve, goal)
            driven = max(driven, float(curve.seconds[-1]))
            needed = max(needed, last_until(curve, half * (1.0 + _NO_NARROWER)))
            if math.isfinite(since):
                known.append((since, label))
                small |= half > INTERVAL_SHARE * abs(value.value)
            else:
                vague.append((half / goal, f"{label} only within {_say(half, value.unit)}", curve, goal))
    if not known and not vague:
        return ""
    told = []
    if known:
        since, label = max(known)
        who = label if len(known) == 1 else f"{len(known)} numbers"
        share = f"{INTERVAL_SHARE:.0%}{' of a usual size' if small else ''}"
        told.append(f"{who} within {share} after {since:.0f} of {driven:.0f} s of driving")
    if vague:
        _, text, curve, goal = max(vague, key=lambda one: one[0])
        text += f" ({len(vague) - 1} more not within {INTERVAL_SHARE:.0%})" if len(vague) > 1 else ""
        seconds = extrapolate(curve, goal)
        more = (
            f"{seconds / 60.0:.0f} min of such driving are needed"
            if seconds < _TOO_LONG * driven
            else "which more of such driving hardly narrows"
        )
        told.append(f"{text}, {more}")
    idle = 1.0 - needed / driven
    if idle >= _WORTH_SAYING:
        told.append(f"the last {idle:.0%} of this drive made no interval narrower by a tenth")
    return "; ".join(told)
