"""The evidence of a recording for a model and for all candidate extensions."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Floats, Ints, guarded_spread, guarded_spreads, robust_spread
from pipeline.estimation.parts import RIDGE
from pipeline.estimation.proposals import Candidate, leave_out_silent, list_trials

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.estimation.fit import PartFit
    from pipeline.estimation.parts import Part
    from pipeline.estimation.state import State
    from pipeline.models.effect import Effect
    from pipeline.models.parameter import Largest

# The noise of residuals: an autoregressive model that whitens them.
#
# Residuals of field data are autocorrelated over seconds, and the commands of a driver or a controller react
# to them. A candidate is therefore judged on the innovation, the part of a residual that its own past does
# not predict (Ljung, System Identification, 2nd ed., section 3.2): it is independent of earlier commands.

ORDER = 6
"""Order of the autoregressive model: three seconds of half-second windows."""
_OVERLAP_S = 0.06
"""Largest overlap [s] of consecutive windows: half the time between poses at 8 Hz."""
_GAP = 1.5
"""Step between window starts, in typical steps, above which there is a gap: the window has no past."""
_CLIP = 4.0
"""Robust standard deviations at which residuals are clipped before the autocovariance is computed."""
_LARGEST_REFLECTION = 0.995
"""Largest partial autocorrelation: at one the predictor would not decay."""


@dataclass(frozen=True)
class Tiles:
    """Windows that cover a recording without overlap.

    Attributes:
        rows: their indices among all windows, shape (k,).
        past: number of tiles that precede each without a gap, at most `ORDER`, shape (k,).
        unit: ten-second stretch of each, shape (k,).
    """

    rows: Ints
    past: Ints
    unit: Ints


def tile_windows(part: Part) -> Tiles:
    """The windows of a part that follow one another without overlap."""
    rows: list[int] = []
    last, end, before = -1, -np.inf, -np.inf
    for index, (number, (start, stop)) in enumerate(zip(part.run.tolist(), part.times.tolist(), strict=True)):
        if number != last or start >= end - _OVERLAP_S or start < before:
            rows.append(index)
            last, end = number, stop
        before = start
    rows_of_tiles = np.array(rows, dtype=np.int64)
    starts, runs = part.times[rows_of_tiles, 0], part.run[rows_of_tiles]
    steps = np.diff(starts)
    typical = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    fresh = np.concatenate(([True], (np.diff(runs) != 0) | (steps > _GAP * typical) | (steps <= 0.0)))
    first = np.maximum.accumulate(np.where(fresh, np.arange(rows_of_tiles.size), 0))
    return Tiles(
        rows_of_tiles, np.minimum(np.arange(rows_of_tiles.size) - first, ORDER), part.unit[rows_of_tiles]
    )


@dataclass(frozen=True)
class Noise:
    """Autoregressive noise of each channel.

    Attributes:
        tiles: windows of the residuals.
        channels: which of x, y, w carry information.
        predictors: coefficients by channel and number of known past residuals, newest first.
        scale: standard deviation of the innovation by channel and that number, shape (c, `ORDER` + 1).
    """

    tiles: Tiles
    channels: tuple[int, ...]
    predictors: tuple[tuple[Floats, ...], ...]
    scale: Floats

    def whiten(self, columns: Floats) -> Floats:
        """Innovations of columns in units of their standard deviation.

        Args:
            columns: at the tiles, shape (k, 3, q).

        Returns:
            Shape (k, c, q).
        """
        white = np.zeros((columns.shape[0], len(self.channels), columns.shape[2]))
        for index, channel in enumerate(self.channels):
            signal = columns[:, channel, :]
            for order, coefficients in enumerate(self.predictors[index]):
                rows = np.flatnonzero(self.tiles.past == order)
                if not rows.size:
                    continue
                fresh = signal[rows]
                for lag, coefficient in enumerate(coefficients.tolist(), start=1):
                    past = signal[rows - lag]
                    past *= coefficient
                    fresh -= past
                white[rows, index] = fresh / self.scale[index, order]
        return white

    def whiten_residual(self, residual: Floats) -> Floats:
        """Innovations of residuals of all windows, shape (n, 3), at the tiles, shape (k, c)."""
        return self.whiten(residual[self.tiles.rows, :, None])[:, :, 0]


def learn_noise(tiles: Tiles, channels: Sequence[int], residual: Floats) -> Noise:
    """Noise estimated from residuals at the tiles, shape (k, 3)."""
    predictors, scales = [], []
    for channel in channels:
        coefficients, variances = _predict(_autocovariance(tiles, residual[:, channel]))
        predictors.append(coefficients)
        scales.append(np.sqrt(variances))
    shape = Noise(tiles, tuple(channels), tuple(predictors), np.array(scales))
    spread = guarded_spreads(shape.whiten(residual[:, :, None])[:, :, 0], _HELD)
    return Noise(tiles, tuple(channels), tuple(predictors), np.array(scales) * spread[:, None])


def _autocovariance(tiles: Tiles, values: Floats) -> Floats:
    """Autocovariance over lags 0 to `ORDER`, outliers clipped, shape (`ORDER` + 1,)."""
    spread = guarded_spread(values, _HELD)
    clipped = np.clip(values, -_CLIP * spread, _CLIP * spread)
    covariance = np.zeros(ORDER + 1)
    for lag in range(ORDER + 1):
        rows = np.flatnonzero(tiles.past >= lag)
        covariance[lag] = float(clipped[rows] @ clipped[rows - lag]) / max(rows.size + lag, 1)
    covariance[0] = max(covariance[0] * (1.0 + 1e-6), 1e-18)
    return covariance


def _predict(covariance: Floats) -> tuple[tuple[Floats, ...], Floats]:
    """Best linear predictors of orders 0 to `ORDER` and their variances (Levinson and Durbin)."""
    coefficients, variance = np.zeros(0), float(covariance[0])
    predictors, variances = [coefficients], [variance]
    for order in range(1, covariance.size):
        reflection = float(covariance[order] - coefficients @ covariance[order - 1 : 0 : -1]) / variance
        reflection = min(max(reflection, -_LARGEST_REFLECTION), _LARGEST_REFLECTION)
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        variance *= 1.0 - reflection**2
        predictors.append(coefficients)
        variances.append(variance)
    return tuple(predictors), np.array(variances)


# The evidence of a recording for a model and for all candidate extensions.
#
# Per ten-second stretch, it consists of the normal equations of the residuals, of the columns of the model's
# own parameters and of those of every candidate, whitened and weighted. These small matrices give the gain
# expected of one or two additional effects; only the best of these are fitted.

_FOLDS = 10
"""Cross-validation folds of stretches for the estimate of the noise."""
_MOST_STEPS = 10
"""Most candidates that may explain residuals in the estimate of the noise."""
_HELD = 6.0
"""Standard deviations at which innovations are clipped."""
_PAIRED = 16
"""Number of candidates with the largest expected gain that are combined in pairs."""
_STARTS = 2
"""Starts per candidate in these pairs."""


@dataclass(frozen=True)
class Start:
    """A candidate at one of its starts.

    Attributes:
        effect: with its start values.
        own: start values by run, for a clock that each run has separately.
        places: indices of its columns in the evidence.
    """

    effect: Effect
    own: tuple[float, ...]
    places: tuple[int, ...]

    @property
    def numbers(self) -> int:
        """Number of free parameters of a fit from there; an effect with a secant has one column for all."""
        free = (name for name, value in self.effect.values.items() if np.isfinite(value))
        return max(len(self.places), len(set(free) - self.effect.fixed))

    def add_to(self, state: State) -> State:
        """The state extended by the effect."""
        extended = state.add(self.effect)
        return extended.set_clocks(self.effect, self.own) if self.own else extended


@dataclass(frozen=True)
class Hypothesis:
    """One or two effects that could be added to a model.

    Attributes:
        starts: one of each effect.
        chi_square: expected reduction of the innovations' chi-square.
    """

    starts: tuple[Start, ...]
    chi_square: float

    @property
    def numbers(self) -> int:
        """Number of additional free parameters."""
        return sum(start.numbers for start in self.starts)


class Evidence:
    """Evidence for effects that a fitted model lacks on one path.

    Args:
        part: the path.
        fit: the model.
        candidates: effects that could be added.
        largest: reference of relative start values.
        noise: of the residuals where it is known.

    Attributes:
        noise: of the residuals that no candidate explains.
        starts: every candidate at every start.
        itself: expected chi-square of the effect that was left out; zero where none was.
    """

    itself: float = 0.0

    def __init__(
        self,
        part: Part,
        fit: PartFit,
        candidates: Sequence[Candidate],
        largest: Largest,
        noise: Noise | None = None,
    ) -> None:
        self.part, self.fit = part, fit
        tiles = tile_windows(part)
        absent = [candidate for candidate in candidates if fit.state.find(candidate.id) is None]
        own = fit.jacobian[tiles.rows]
        columns, starts, count = [own], list[Start](), 0
        for candidate in absent:
            for effect, own_values, block in _collect(part, fit, largest, tiles, candidate):
                places = tuple(range(count, count + block.shape[2]))
                starts.append(Start(effect, own_values, places))
                columns.append(block)
                count += block.shape[2]
        self.starts = tuple(starts)
        self._own = own.shape[2]
        self.noise = noise or self._find_noise(tiles, np.concatenate(columns, axis=2))
        self._names = fit.state.ids
        columns += [
            (part.find_residuals(fit.state.drop([name])) - fit.residual)[tiles.rows, :, None]
            for name in self._names
        ]
        white = self.noise.whiten(np.concatenate((self._residual(tiles), *columns), axis=2))
        self._normal = _sum_normals(tiles.unit, self._weigh(white)).sum(axis=0)

    def _residual(self, tiles: Tiles) -> Floats:
        return self.fit.residual[tiles.rows, :, None]

    def _find_noise(self, tiles: Tiles, columns: Floats) -> Noise:
        """Noise of the held-out residuals after all useful candidates together.

        Columns are added one effect at a time while the held-out error falls. Channels without an
        improvement use the model's own residuals.
        """
        factor = self.fit.weights.factors(self.fit.residual)[tiles.rows][:, :, None]
        rows = np.concatenate((self._residual(tiles), columns), axis=2) * factor
        size = np.sqrt((rows**2).sum(axis=(0, 1))) + 1e-300
        normals = _sum_normals(tiles.unit, rows / size)
        fold = np.arange(normals.shape[0]) % _FOLDS
        folds = np.array([normals[fold == number].sum(axis=0) for number in np.unique(fold)])
        groups = [[self._own + index for index in start.places] for start in self.starts]
        chosen = _choose_columns(folds, self._own, groups)
        residual = self.fit.residual[tiles.rows]
        held = residual.copy()
        stretch = np.unique(tiles.unit, return_inverse=True)[1]
        if chosen:
            places = np.array(chosen) + 1
            for number, held_out in enumerate(folds):
                normal = folds.sum(axis=0) - held_out
                step = _solve(normal, places) * size[0] / size[places]
                mine = stretch % _FOLDS == number
                held[mine] -= columns[mine][:, :, chosen] @ step
        for channel in range(held.shape[1]):
            if _clipped_rms(held[:, channel]) >= _clipped_rms(residual[:, channel]):
                held[:, channel] = residual[:, channel]
        return learn_noise(tiles, self.part.channels, held)

    @staticmethod
    def _weigh(white: Floats) -> Floats:
        """Whitened rows with the Huber weights of the residual, which is the first column."""
        size = np.abs(white[:, :, :1])
        weighed: Floats = white * np.sqrt(_HELD / np.maximum(size, _HELD))
        return weighed

    @cached_property
    def _projected(self) -> tuple[Floats, Floats]:
        """Normal matrix and gradient of the candidates' columns, the model's own columns projected out."""
        whole = self._normal
        size = np.sqrt(np.diag(whole)) + 1e-300
        size[0] = 1.0
        whole = whole / size / size[:, None]
        own, rest = slice(1, self._own + 1), slice(self._own + 1, None)
        normal, across, pull = whole[rest, rest], whole[rest, own], whole[rest, 0]
        if self._own:
            inner = whole[own, own] + RIDGE * np.eye(self._own)
            solved = np.linalg.solve(inner, np.column_stack((across.T, whole[own, 0])))
            normal, pull = normal - across @ solved[:, :-1], pull - across @ solved[:, -1]
        return normal, pull

    def leave_out(self, name: str) -> Evidence:
        """The same evidence without the starts of one candidate."""
        fewer = copy(self)
        fewer.starts = tuple(start for start in self.starts if start.effect.id != name)
        return fewer

    def without(self, name: str) -> Evidence:
        """The evidence at the model without one of its effects, to first order."""
        mine = {1 + index for index, number in enumerate(self.fit.free) if number.effect == name}
        absence = self._normal.shape[0] - len(self._names) + self._names.index(name)
        # The residual of the model without it is the residual plus the contribution of the effect.
        whole = self._normal.copy()
        whole[0] += whole[absence]
        whole[:, 0] += whole[:, absence]
        order = [index for index in range(whole.shape[0]) if index not in mine]
        order += sorted(mine)
        fewer = copy(self)
        fewer.__dict__.pop("_projected", None)
        fewer._normal = whole[np.ix_(order, order)]  # noqa: SLF001 - of its own kind
        fewer._own = self._own - len(mine)  # noqa: SLF001
        last = whole.shape[0] - 1 - self._own
        itself = [absence - 1 - self._own, *range(last, last + len(mine))]
        fewer.itself = fewer.expect_gain(itself)
        return fewer

    def expect_gain(self, places: Sequence[int]) -> float:
        """Expected reduction of chi-square by columns, with the model's own parameters fitted again."""
        return self._expect_gains([places])[0]

    def _expect_gains(self, groups: Sequence[Sequence[int]]) -> list[float]:
        """As `expect_gain`, for each group of columns."""
        gains: list[float] = find_gains(*self._projected, groups, 1e-6).tolist()
        return gains

    def rank_singles(self, price: float) -> list[Hypothesis]:
        """The best start of every candidate, the largest expected gain net of the price first.

        Args:
            price: chi-square required per parameter.
        """
        return [options[0] for options in self._rank_starts(price)]

    def rank_pairs(self, price: float) -> list[Hypothesis]:
        """Pairs of the leading candidates with the best starts of each pair, the best pair first."""
        options = [one[:_STARTS] for one in self._rank_starts(price)[:_PAIRED]]
        joined = [
            [(*one.starts, *other.starts) for one in first for other in second]
            for first, second in combinations(options, 2)
        ]
        joined_gains = iter(self._form_hypotheses([starts for pair in joined for starts in pair]))
        pairs = [
            max((next(joined_gains) for _ in pair), key=lambda one: one.chi_square - price * one.numbers)
            for pair in joined
        ]
        return sorted(pairs, key=lambda pair: price * pair.numbers - pair.chi_square)

    def _form_hypotheses(self, together: Sequence[tuple[Start, ...]]) -> list[Hypothesis]:
        """Hypotheses of starts that are added together, with their expected gains."""
        groups = [[index for start in starts for index in start.places] for starts in together]
        gains = self._expect_gains(groups)
        return [Hypothesis(starts, gain) for starts, gain in zip(together, gains, strict=True)]

    def _rank_starts(self, price: float) -> list[list[Hypothesis]]:
        by_effect: dict[str, list[Hypothesis]] = {}
        for hypothesis in self._form_hypotheses([(start,) for start in self.starts]):
            by_effect.setdefault(hypothesis.starts[0].effect.id, []).append(hypothesis)

        def cost(one: Hypothesis) -> float:
            return price * one.numbers - one.chi_square

        return sorted((sorted(one, key=cost) for one in by_effect.values()), key=lambda one: cost(one[0]))


def _collect(
    part: Part, fit: PartFit, largest: Largest, tiles: Tiles, candidate: Candidate
) -> list[tuple[Effect, tuple[float, ...], Floats]]:
    """Every start of a candidate with its columns at the tiles; parameters without influence are fixed."""
    factor, pairs = fit.weights.factors(fit.residual), []
    for trial in list_trials(part, fit, candidate, largest):
        loud = leave_out_silent(trial, factor)
        if loud is None:
            continue
        columns = loud[0].columns[tiles.rows]
        if trial.shift.any():
            columns = np.concatenate((columns, trial.shift[tiles.rows][:, :, None]), axis=2)
        if np.isfinite(columns).all():
            pairs.append((loud[0].effect, trial.own, columns))
    return pairs


def _sum_normals(unit: Ints, rows: Floats) -> Floats:
    """Normal matrices of rows (k, c, m) by ten-second stretch, shape (b, m, m)."""
    edges = np.flatnonzero(np.diff(unit)) + 1
    pieces = (piece.reshape(-1, rows.shape[2]) for piece in np.split(rows, edges))
    return np.array([piece.T @ piece for piece in pieces])


def find_gains(normal: Floats, pull: Floats, groups: Sequence[Sequence[int]], ridge: float) -> Floats:
    """Reduction of a residual's sum of squares by each group of columns, shape (g,).

    Args:
        normal: normal matrix of the columns, shape (m, m).
        pull: product of each column and the residual, shape (m,).
        groups: indices of the columns.
        ridge: regularization that keeps the equations solvable.
    """
    gains, sizes = np.zeros(len(groups)), np.array([len(places) for places in groups], dtype=np.int64)
    for size in np.unique(sizes).tolist():
        mine = np.flatnonzero(sizes == size)
        at = np.array([groups[index] for index in mine.tolist()])
        inner, asked = normal[at[:, :, None], at[:, None, :]] + ridge * np.eye(size), pull[at]
        gains[mine] = np.sum(asked * np.linalg.solve(inner, asked[:, :, None])[:, :, 0], axis=1)
    return gains


def _solve(normal: Floats, places: Ints) -> Floats:
    """Least-squares coefficients of some columns for the residual, which is column 0."""
    inner = normal[np.ix_(places, places)] + RIDGE * np.eye(places.size)
    return np.asarray(np.linalg.solve(inner, normal[places, 0]), dtype=np.float64)


def _choose_columns(folds: Floats, own: int, groups: Sequence[Sequence[int]]) -> list[int]:
    """Columns with the lowest cross-validation error, added group by group to the model's own ones.

    Args:
        folds: normal matrices of the residual, as column 0, and of all columns, by fold, shape (f, m, m).
        own: number of columns of the model's own parameters, which come first.
        groups: columns of each candidate's start.
    """
    whole = folds.sum(axis=0)
    chosen = list(range(own))
    best, selected = _cross_validate(folds, whole, chosen), chosen
    for places in _step_forward(whole, chosen, groups, min(_MOST_STEPS, max(folds.shape[0] - 2, 1))):
        chosen = [*chosen, *places]
        loss = _cross_validate(folds, whole, chosen)
        if loss < best:
            best, selected = loss, chosen
    return selected


def _step_forward(
    whole: Floats, chosen: list[int], groups: Sequence[Sequence[int]], steps: int
) -> Iterator[Sequence[int]]:
    """Groups of columns by the gain of each beside those before it (forward selection)."""
    for _ in range(steps):
        at = np.array(chosen, dtype=np.int64) + 1
        solved = np.linalg.solve(whole[np.ix_(at, at)] + RIDGE * np.eye(at.size), whole[at])
        beside = (whole - whole[:, at] @ solved)[1:]
        free = [places for places in groups if not set(places) & set(chosen)]
        gains = find_gains(beside[:, 1:], beside[:, 0], free, 1e-4) / [len(places) for places in free]
        if not gains.max(initial=0.0) > 0.0:
            return
        group = free[int(gains.argmax())]
        chosen = [*chosen, *group]
        yield group


def _cross_validate(folds: Floats, whole: Floats, chosen: Sequence[int]) -> float:
    """Sum of the squared residuals of every fold under coefficients from the other folds."""
    at = np.array(chosen, dtype=np.int64) + 1
    total = 0.0
    for fold in folds:
        total += float(fold[0, 0])
        if at.size:
            step = _solve(whole - fold, at)
            total += float(step @ fold[np.ix_(at, at)] @ step - 2.0 * step @ fold[at, 0])
    return total


def _clipped_rms(values: Floats) -> float:
    limit = _HELD * robust_spread(values) + 1e-12
    return float(np.sqrt(np.mean(np.minimum(np.abs(values), limit) ** 2)))
