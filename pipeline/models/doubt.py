"""Doubts about a fitted value: why it is not to be used as it stands, the same for every face."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.models.parameter import stands_at_bound

if TYPE_CHECKING:
    from pipeline.models.parameter import Parameter

AT_BOUND, UNDETERMINED, ONE_LIMIT = "at_bound", "undetermined", "one_limit"
UNDECIDED, TOO_SHORT, FEW_STRETCHES = "undecided", "too_short", "few_stretches"
FEWEST_STRETCHES = 5
"""Stretches of driving below which the interval of an estimate that rests on them is too narrow."""

_TEXTS = {
    AT_BOUND: ("at its bound", "at its bound: a limit of the search, not a measurement"),
    UNDETERMINED: ("undetermined", "undetermined: the runs of the fit leave it open"),
    ONE_LIMIT: ("undetermined", "undetermined: its interval reaches a limit of the search"),
    UNDECIDED: ("undecided", "undecided: another effect would explain the data as well"),
    TOO_SHORT: ("run too short", "the driving is too short for certainty"),
    FEW_STRETCHES: ("read from {} stretches", "read from {} of the driven stretches of 20 s only"),
}
"""Mark beside a value, and the reason, by the id of a doubt."""


@dataclass(frozen=True)
class Doubt:
    """A doubt about a value.

    Attributes:
        id: which one, a key of the table of texts; empty for none.
        stretches: how many stretches of driving the value rests on, where these are few.
    """

    id: str = ""
    stretches: int = 0

    def __bool__(self) -> bool:
        return bool(self.id)

    @property
    def is_known(self) -> bool:
        """Whether there is such a doubt."""
        return self.id in _TEXTS

    @property
    def mark(self) -> str:
        """It in a word or three, as beside a value; empty without a doubt."""
        return _TEXTS[self.id][0].format(self.stretches) if self.id else ""

    @property
    def reason(self) -> str:
        """It as a clause; empty without a doubt."""
        return _TEXTS[self.id][1].format(self.stretches) if self.id else ""


def doubt_number(parameter: Parameter, value: float, low: float, high: float) -> Doubt:
    """The doubt that a value and its interval show by themselves.

    Args:
        parameter: of which it is a value.
        value: the fitted value.
        low: lower end of its 95 % interval; NaN without one.
        high: upper end.
    """
    if stands_at_bound(value, parameter.bounds):
        return Doubt(AT_BOUND)
    if not math.isfinite(high - low):
        return Doubt(UNDETERMINED)
    return Doubt(ONE_LIMIT if parameter.is_one_sided(low, high) else "")
