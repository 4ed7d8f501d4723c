"""Changes between two groups of runs: each quantity tested against the usual variation between runs.

    x_r = m_g(r) + b_r + e_r,    b ~ N(0, diag(spread^2)),    var e_r known

Each run gives estimates of p quantities with their covariance. A quantity has changed if the means of two
groups differ by more than the errors of the runs and the spread between runs explain. The spread is estimated
from groups of several runs, also from other runs of the same vehicle; without any its prior is used. All
spreads are weighted by their probability, so that few runs give wide intervals, as Student's t has them. If
the errors of two quantities are correlated, the one whose change explains the difference alone is selected
first; its change is then a free parameter in the tests of the others (forward selection, with Holm's
correction for the remaining quantities at each step).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from scipy.special import ndtr

from pipeline.core import Flags, Floats
from pipeline.datasets.levels import weigh_run_spreads

CHANCE = 0.02
"""Level of a check's tests, so that it reports any change where there is none in at most one of forty checks:
of 2,400 drawn pairs 2.8 % were called changed at a level of 0.025, as spreads of other quantities enter as
means (`make bench NAME=check_again ARGS=drawn`)."""
POWER = 0.8
"""Probability of detecting a change of the smallest reported size."""
MOST_MORE = 30
"""Additional runs per side up to which more runs are recommended."""
_BISECTIONS = 60
"""Bisections of an interval: doubles have 53 bits."""
_TAIL = 0.025
"""Probability beyond either end of an interval of 95 %."""
_LEAST_ERROR = 1e-6
"""Smallest standard error, in typical errors of a quantity: an exactly known quantity also needs an error."""
_LEAST_LEFT = 1e-3
"""Fraction of a variance that remains at least when another spread between runs is substituted."""

Side = Literal["before", "after"]
Status = Literal["changed", "differs", "unchanged", "unknown"]
BEFORE: Side = "before"
AFTER: Side = "after"


@dataclass(frozen=True)
class RunNumbers:
    """Estimates of p quantities from one run.

    Attributes:
        run: name of the run.
        side: group of the run.
        values: estimates, NaN where the run gives none, shape (p,).
        covariance: covariance of their errors, shape (p, p).
    """

    run: str
    side: Side
    values: Floats
    covariance: Floats

    @property
    def known(self) -> Flags:
        """Whether the run gives an estimate, shape (p,)."""
        finite: Flags = np.isfinite(self.values) & np.isfinite(np.diag(self.covariance))
        return finite


@dataclass(frozen=True)
class Change:
    """Comparison of one quantity on both sides.

    Attributes:
        status: `changed` exceeds the variation between runs that these runs show; `differs` exceeds chance
            within these runs, but not that variation, or no runs show it; `unknown`: no estimate of a side.
        before, after: means of the sides; NaN if a side has no estimate.
        low, high: 95 % interval of the difference, for future runs.
        p: probability of a difference as large in any of all quantities without a change.
        p_within: the same if all runs of one side were alike: for these recordings alone.
        smallest: change that is detected with probability `POWER`.
        spread: spread between runs of a side.
        freedom: degrees of freedom of that spread: runs that determine it, less one a group; with none it is
            the usual one.
        p_alone: probability of a difference as large in this quantity alone without a change.
        asked: the underlying test.
        outlook: what more runs would show.
        within: interval of the difference of these recordings, by their errors alone; those of all
            quantities hold together with 95 %.
    """

    status: Status
    before: float
    after: float
    low: float = math.nan
    high: float = math.nan
    p: float = math.nan
    p_within: float = math.nan
    smallest: float = math.nan
    spread: float = math.nan
    freedom: int = 0
    p_alone: float = math.nan
    asked: Asked | None = field(default=None, repr=False, compare=False)
    outlook: Outlook | None = field(default=None, repr=False, compare=False)
    within: tuple[float, float] = (math.nan, math.nan)

    @property
    def difference(self) -> float:
        """After minus before."""
        return self.after - self.before

    @property
    def is_default(self) -> bool:
        """Whether the spread is the usual one, because no runs determine it."""
        return self.freedom == 0

    def find_power(self, change: float) -> float:
        """Probability of detecting a change while the other quantities stay; NaN for an unknown quantity."""
        return math.nan if self.asked is None else self.asked.find_power(change)

    def count_missing(self) -> int | None:
        """Additional runs per side needed to confirm the difference of these runs, or to halve `smallest`.

        None where the quantity has changed or is unknown, or where more than `MOST_MORE` are needed.
        """
        return None if self.outlook is None or self.status == "changed" else self.outlook.count_missing()


@dataclass(frozen=True)
class _Spread:
    """Distribution of the spread of one quantity between runs of a side.

    Attributes:
        sizes: possible spreads, shape (k,).
        chances: probability of each, shape (k,).
        usual: scale of their prior; zero where runs are assumed alike.
        freedom: runs that determine it, less one a group.
    """

    sizes: Floats
    chances: Floats
    usual: float
    freedom: int = 0

    @property
    def square(self) -> float:
        """Mean square."""
        return float(self.chances @ self.sizes**2)


@dataclass(frozen=True)
class Asked:
    """Test of one quantity given the others: a difference and its uncertainty.

    Attributes:
        difference: after minus before.
        deviations: standard deviations of the difference, by spread between runs, shape (k,).
        chances: probabilities of the spreads, shape (k,).
        alarm: probability of a false alarm allowed for this quantity.
    """

    difference: float
    deviations: Floats
    chances: Floats
    alarm: float

    def weigh_tail(self, size: float) -> float:
        """Probability of a difference above a size."""
        return float(self.chances @ ndtr(-size / self.deviations))

    @property
    def p(self) -> float:
        """Two-sided probability of a difference as large as this one."""
        return 2.0 * self.weigh_tail(abs(self.difference))

    def find_quantile(self, tail: float) -> float:
        """Size that is exceeded with this probability."""
        low, high = 0.0, 40.0 * float(self.deviations.max())
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.weigh_tail(middle) > tail else (low, middle)
        return high

    def find_smallest(self) -> float:
        """Change that is detected with probability `POWER`."""
        return self.find_quantile(0.5 * self.alarm) + self.find_quantile(1.0 - POWER)

    def find_power(self, change: float) -> float:
        """Probability of detecting a change."""
        limit = self.find_quantile(0.5 * self.alarm)
        return self.weigh_tail(limit - change) + self.weigh_tail(limit + change)

    def rescale(self, size: float) -> Asked:
        """The same test in a unit that is 1 / ``size`` of the present one."""
        return replace(self, difference=size * self.difference, deviations=size * self.deviations)


@dataclass(frozen=True)
class Outlook:
    """Expected result of more runs for one quantity, if they are like those so far.

    Attributes:
        spread: spread between runs of a side.
        error: standard error of one run.
        counts: runs so far, before and after.
        alarm: probability of a false alarm allowed for the quantity.
        goal: change to be detected.
    """

    spread: _Spread
    error: float
    counts: tuple[int, int]
    alarm: float
    goal: float

    def count_missing(self) -> int | None:
        """Additional runs per side that reduce the smallest change to the goal; None beyond `MOST_MORE`."""
        if self.expect_smallest(MOST_MORE) > self.goal:
            return None
        least, most = 0, MOST_MORE
        while most - least > 1:
            middle = (least + most) // 2
            least, most = (least, middle) if self.expect_smallest(middle) <= self.goal else (middle, most)
        return most

    def expect_smallest(self, added: int) -> float:
        """Smallest change that is detected with this many additional runs per side."""
        sizes, chances = self.spread.sizes, self.spread.chances
        counts = [count + added for count in self.counts]
        if self.spread.usual > 0.0:
            middle = float(sizes[np.searchsorted(np.cumsum(chances), 0.5)])
            values: list[float] = []
            for count in counts:
                scores = np.linspace(-1.0, 1.0, count)
                values += (scores * math.hypot(self.error, middle) / float(np.std(scores, ddof=1))).tolist()
            sides = [BEFORE] * counts[0] + [AFTER] * counts[1]
            errors = [self.error] * len(values)
            sizes, chances = weigh_run_spreads(values, errors, sides, self.spread.usual)
        deviations = np.sqrt((self.error**2 + sizes**2) * sum(1.0 / count for count in counts))
        return Asked(0.0, deviations, chances, self.alarm).find_smallest()


def compare_sides(
    runs: Sequence[RunNumbers],
    usual: Floats,
    *,
    alike: bool = False,
    others: Mapping[str, Sequence[RunNumbers]] = MappingProxyType({}),
) -> list[Change]:
    """Compare the quantities of two groups of runs.

    Args:
        runs: runs of both sides, at least one of each.
        usual: scale of the half-normal prior of each quantity's spread between runs, shape (p,); zero for
            one that runs share without a change.
        alike: whether runs of a side are assumed alike, so that only the errors of these recordings count.
        others: further runs of the vehicle by group, such as a terrain: they tell the spread between runs.
    """
    size = _find_sizes(runs, usual)

    def rescale(run: RunNumbers) -> RunNumbers:
        return replace(run, values=run.values / size, covariance=run.covariance / np.outer(size, size))

    scaled = [rescale(run) for run in runs]
    groups: list[tuple[str, RunNumbers]] = [(run.side, run) for run in scaled]
    groups += [(f"others {name}", rescale(run)) for name, group in others.items() for run in group]
    spreads = [
        _learn_spread(groups, index, float(scale)) for index, scale in enumerate((usual / size).tolist())
    ]
    whole = _Sides(scaled, spreads)
    within = _Sides(scaled, [_Spread(np.zeros(1), np.ones(1), 0.0)] * usual.size)
    seen = within.find_changed()
    significant = seen if alike else whole.find_changed()
    judged = within if alike else whole
    changes = []
    for index, scale in enumerate(size.tolist()):
        change = _make_change(judged, index, significant, seen, scale)
        if change.status != "unknown":
            alone = within.ask(index, [index])
            half = alone.find_quantile(_TAIL / len(within.family))
            ends = (scale * (alone.difference - half), scale * (alone.difference + half))
            # What correlated errors leave open is no difference of this quantity.
            is_open = change.status == "differs" and ends[0] <= 0.0 <= ends[1]
            change = replace(change, within=ends, status="unchanged" if is_open else change.status)
        changes.append(change)
    return changes


def _find_sizes(runs: Sequence[RunNumbers], usual: Floats) -> Floats:
    """Scale of each quantity, so that quantities of different units share one matrix, shape (p,)."""
    errors = np.array([np.where(run.known, np.sqrt(np.diag(run.covariance)), np.nan) for run in runs])
    known = np.isfinite(errors).any(axis=0)
    size = np.array(usual)
    size[known] = np.nanmedian(errors[:, known], axis=0)
    return np.where(size > 0.0, size, np.where(usual > 0.0, usual, 1.0))


def _learn_spread(runs: Sequence[tuple[str, RunNumbers]], index: int, usual: float) -> _Spread:
    known = [(group, run) for group, run in runs if run.known[index]]
    if not known or usual == 0.0:
        return _Spread(np.array([usual]), np.ones(1), usual)
    values = [float(run.values[index]) for _, run in known]
    errors = [max(math.sqrt(run.covariance[index, index]), _LEAST_ERROR) for _, run in known]
    groups = [group for group, _ in known]
    freedom = len(known) - len({*groups})
    return _Spread(*weigh_run_spreads(values, errors, groups, usual), usual, freedom)


class _Sides:
    """Means of all quantities on both sides, with one model of the spreads between runs."""

    def __init__(self, runs: Sequence[RunNumbers], spreads: Sequence[_Spread]) -> None:
        self.runs, self.spreads = runs, spreads
        self.square = np.array([spread.square for spread in spreads])
        counts = {
            side: np.sum([run.known for run in runs if run.side == side], axis=0) for side in (BEFORE, AFTER)
        }
        self.counts = counts
        self.known: Flags = (counts[BEFORE] > 0) & (counts[AFTER] > 0)
        self.means, self.covariances = {}, {}
        for side in (BEFORE, AFTER):
            self.means[side], self.covariances[side] = self._average(side)
        self.family = [int(index) for index in np.flatnonzero(self.known)]

    def _average(self, side: Side) -> tuple[Floats, Floats]:
        """Weighted means of a side's runs and their covariance; NaN where no run gives an estimate."""
        count = self.square.size
        weight, pull = np.zeros((count, count)), np.zeros(count)
        for run in self.runs:
            if run.side == side and run.known.any():
                rows = np.flatnonzero(run.known)
                inside = np.ix_(rows, rows)
                own = np.linalg.inv(run.covariance[inside] + np.diag(self.square[rows] + _LEAST_ERROR**2))
                weight[inside] += own
                pull[rows] += own @ run.values[rows]
        known = np.flatnonzero(self.counts[side] > 0)
        means, covariance = np.full(count, np.nan), np.full((count, count), np.nan)
        inverse = np.linalg.inv(weight[np.ix_(known, known)])
        covariance[np.ix_(known, known)] = inverse
        means[known] = inverse @ pull[known]
        return means, covariance

    def ask(self, index: int, beside: Sequence[int]) -> Asked:
        """Test the difference of a quantity, given that the quantities in ``beside`` have not changed.

        Their differences carry information on the errors that they share with it.
        """
        rows = [index, *(other for other in beside if other != index)]
        inside = np.ix_(rows, rows)
        covariance = self.covariances[BEFORE][inside] + self.covariances[AFTER][inside]
        difference = (self.means[AFTER] - self.means[BEFORE])[rows]
        precision = np.linalg.inv(covariance)
        variance = 1.0 / float(precision[0, 0])
        own = variance * float(precision[0] @ difference)
        spread = self.spreads[index]
        parts = sum(1.0 / self.counts[side][index] for side in (BEFORE, AFTER))
        other = (spread.sizes**2 - spread.square) * parts
        deviations = np.sqrt(np.maximum(variance + other, _LEAST_LEFT * variance))
        return Asked(own, deviations, spread.chances, CHANCE / max(len(beside), 1))

    def find_changed(self) -> dict[int, float]:
        """Corrected p of every known quantity; those with p up to `CHANCE` have changed."""
        remaining, changed = list(self.family), dict[int, float]()
        floor = 0.0
        while remaining:
            ps = {index: self.ask(index, remaining).p * len(remaining) for index in remaining}
            best = min(ps, key=lambda index: ps[index])
            if ps[best] > CHANCE:
                return changed | {index: min(max(p, floor), 1.0) for index, p in ps.items()}
            floor = max(floor, ps[best])
            changed[best] = floor
            remaining.remove(best)
        return changed

    def look_ahead(self, index: int, goal: float) -> Outlook:
        """Expected result of more runs for a quantity."""
        errors = [math.sqrt(run.covariance[index, index]) for run in self.runs if run.known[index]]
        counts = (int(self.counts[BEFORE][index]), int(self.counts[AFTER][index]))
        error = max(float(np.median(errors)), _LEAST_ERROR)
        return Outlook(self.spreads[index], error, counts, CHANCE / len(self.family), goal)


def _make_change(
    judged: _Sides, index: int, significant: dict[int, float], seen: dict[int, float], size: float
) -> Change:
    before, after = (float(judged.means[side][index]) * size for side in (BEFORE, AFTER))
    if index not in significant:
        return Change("unknown", before, after)
    asked = judged.ask(index, judged.family)
    smallest = asked.find_smallest()
    alone = judged.ask(index, [index])
    half = alone.find_quantile(_TAIL)
    p, p_within = significant[index], seen[index]
    spread = judged.spreads[index]
    is_known = spread.freedom > 0 or spread.usual == 0.0
    status: Status = (
        "changed" if p <= CHANCE and is_known else "differs" if min(p, p_within) <= CHANCE else "unchanged"
    )
    goal = abs(alone.difference) if status == "differs" else 0.5 * smallest
    return Change(
        status,
        before,
        after,
        low=size * (alone.difference - half),
        high=size * (alone.difference + half),
        p=p,
        p_within=p_within,
        smallest=size * smallest,
        spread=size * math.sqrt(judged.spreads[index].square),
        freedom=judged.spreads[index].freedom,
        p_alone=alone.p,
        asked=asked.rescale(size),
        outlook=judged.look_ahead(index, goal),
    )
