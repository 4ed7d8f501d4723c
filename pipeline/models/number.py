"""Numbers of effects: what a fit finds, a model file holds, a diagnosis says, and every face shows.

A doubt says why a number is not to be used as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import msgspec
from msgspec.structs import replace

from pipeline.core import JSON_DIGITS, NORMAL_95, count_places, round_digits, round_numbers
from pipeline.models.parameter import cut_interval, stands_at_bound

if TYPE_CHECKING:
    from pipeline.models.parameter import Parameter

AT_BOUND, UNDETERMINED, ONE_LIMIT = "at_bound", "undetermined", "one_limit"
UNDECIDED, TOO_SHORT, FEW_STRETCHES = "undecided", "too_short", "few_stretches"
FEWEST_STRETCHES = 5
"""Stretches of driving below which the interval of an estimate that rests on them is too narrow."""

DOUBTS = {
    AT_BOUND: ("at its bound", "at its bound: a limit of the search, not a measurement"),
    UNDETERMINED: ("undetermined", "undetermined: the runs of the fit leave it open"),
    ONE_LIMIT: ("undetermined", "undetermined: its interval reaches a limit of the search"),
    UNDECIDED: ("undecided", "undecided: another effect would explain the data as well"),
    TOO_SHORT: ("run too short", "the driving is too short for certainty"),
    FEW_STRETCHES: ("few stretches: {}", "only {} of the driven stretches of 20 s tell it"),
}
"""Of each doubt about a number: its mark beside a value, and the reason."""


class Interval(msgspec.Struct, frozen=True):
    """An interval; NaN where there is none."""

    low: float = math.nan
    high: float = math.nan


class Number(msgspec.Struct, frozen=True):
    """A number of an effect.

    Attributes:
        value: the value.
        low, high: its 95 % interval; NaN where there is none.
        unit: SI, `1` for a dimensionless number.
        at_bound: whether it is at its bound.
        another_run: expected interval in another run on this ground.
        is_spread_measured: whether the spread between runs was measured, not only assumed.
        doubt: why it is not to be used as it stands, a key of `DOUBTS`; empty without one.
        stretches: how many stretches of driving it rests on, where few.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    unit: str = "1"
    at_bound: bool = False
    another_run: Interval = Interval()
    is_spread_measured: bool = False
    doubt: str = ""
    stretches: int = 0

    def doubt_as(self, parameter: Parameter) -> Number:
        """It as a number of a parameter: with the doubt that its value and interval show, if any.

        Such a doubt is graver than one that was noted before.
        """
        at_bound, said = stands_at_bound(self.value, parameter.bounds), self.doubt
        if at_bound:
            said = AT_BOUND
        elif not math.isfinite(self.high - self.low):
            said = UNDETERMINED
        elif parameter.is_one_sided(self.low, self.high):
            said = ONE_LIMIT
        count = self.stretches if said == self.doubt else 0
        return replace(self, unit=parameter.unit, at_bound=at_bound, doubt=said, stretches=count)

    def to_json(self) -> dict[str, Any]:
        """It as JSON: null for what is not known, whether the runs leave it open, and its doubt in words."""
        content = cast("dict[str, Any]", round_numbers(msgspec.to_builtins(self)))
        return {**content, "undetermined": self.is_undetermined, "doubt_text": self.reason}

    @property
    def mark(self) -> str:
        """Its doubt in a word or three, as beside a value; empty without a doubt."""
        return DOUBTS[self.doubt][0].format(self.stretches) if self.doubt else ""

    @property
    def reason(self) -> str:
        """Its doubt as a clause; empty without a doubt."""
        return DOUBTS[self.doubt][1].format(self.stretches) if self.doubt else ""

    @property
    def elsewhere(self) -> str:
        """What to expect of it in another run, and whether that is assumed; empty where it is not known."""
        there = self.another_run
        if not math.isfinite(there.high - there.low):
            return ""
        text = f"another run: {there.low:.3g} to {there.high:.3g}"
        return text if self.is_spread_measured else f"{text}, assumed"

    @property
    def is_undetermined(self) -> bool:
        """Whether the runs do not determine it: no finite interval, one limit only, or at its bound."""
        return self.at_bound or self.doubt == ONE_LIMIT or not math.isfinite(self.high - self.low)

    def is_open(self, parameter: Parameter) -> bool:
        """Whether the runs do not tell how large it is: undetermined, or its interval is as wide as it."""
        return self.is_undetermined or parameter.is_wide(self.value, self.low, self.high)

    @property
    def half(self) -> float:
        """The wider half of its interval: the other half may be cut at a bound of the parameter."""
        return max(self.high - self.value, self.value - self.low)

    @property
    def digits(self) -> int:
        """Significant digits that its interval supports, at least one; as in JSON where it has none."""
        if not self.value or not 0.0 < self.half < math.inf:
            return JSON_DIGITS
        places = count_places(self.half)
        return min(max(math.floor(math.log10(abs(self.value))) + places + 1, 1), JSON_DIGITS)

    def move(self, change: float) -> Number:
        """The value and its intervals shifted by a known amount."""
        there = self.another_run
        return replace(
            self, value=self.value + change, low=self.low + change, high=self.high + change,
            another_run=Interval(there.low + change, there.high + change),
        )  # fmt: skip


def split_determined(numbers: Mapping[str, Number]) -> tuple[dict[str, Number], dict[str, Number]]:
    """Values that the runs determine, and those that they leave open or that are at a bound."""
    known = {name: value for name, value in numbers.items() if not value.is_undetermined}
    return known, {name: value for name, value in numbers.items() if name not in known}


def expect_another_run(parameter: Parameter, number: Number) -> Interval:
    """95 % interval of a number in another run on the same ground, NaN where this run has none.

    It combines the interval of this run with the spread between runs, observed or typical
    (`Parameter.spread`), as independent errors. The spread applies to both runs: their difference is larger
    by the root of two than the deviation of one run from the ground's mean. It is cut at the search bounds.
    """
    value, low, high = number.value, number.low, number.high
    if not math.isfinite(high - low):
        return Interval()
    change = NORMAL_95 * math.sqrt(2.0) * parameter.spread.size
    below, above = math.hypot(value - low, change), math.hypot(high - value, change)
    return Interval(*map(round_digits, cut_interval(value - below, value + above, parameter.bounds)))
