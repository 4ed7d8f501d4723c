"""The signature of each effect: how residuals depend on the variable that it acts on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import FEWEST_OF_SPREAD, NORMAL_95, Flags, Floats, Ints, robust_spread
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.model_state import ModelState
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.estimation.window_residuals import CLIP, average_windows, locate_windows, number_stretches
from pipeline.models import Place, Timing

# The signature of an effect: the residual against the variable that it acts on, with the effect's curve.
#
# The contribution of an effect in a run is the residual of the model without it minus the residual of the
# model with it. It is plotted against the variable whose bins explain the largest share of its mean square.
# No effect is treated specially by its id.

CHANNELS = ("x", "y", "w")
SINCE_STEP = "since_step"

_BINS = 16
"""Most bins of a curve: more are not distinguishable in a figure."""
_FEWEST = 4
"""Fewest windows per bin."""
_FEWEST_BINS = 3
"""Fewest bins of a curve."""
_NOTHING = 1e-9
"""A smaller range or gain is rounding error."""
# A simpler variable (earlier in the list) is chosen if its explained share is lower by at most this fraction.
_NEARLY = 0.05
# Smallest command change that counts as a step, as a share of the range of the command.
_STEP = 0.1
_LONGEST_STEP_S = 5.0
"""Time after a step [s] for which its response is shown."""

VARIABLES: Mapping[str, tuple[str, str]] = {
    "f_x": ("ideal speed", "m/s"),
    "f_y": ("ideal lateral speed", "m/s"),
    "f_w": ("ideal yaw rate", "rad/s"),
    "f_x_f_w": ("ideal speed times ideal yaw rate", "m/s²"),
    "a_x": ("change of ideal speed", "m/s²"),
    "a_w": ("change of ideal yaw rate", "rad/s²"),
    "roll": ("roll", "rad"),
    "pitch": ("pitch", "rad"),
    "p_x": ("predicted speed", "m/s"),
    "p_w": ("predicted yaw rate", "rad/s"),
    "p_x_p_w": ("predicted speed times predicted yaw rate", "m/s²"),
    "rim": ("ideal speed of the fastest wheel", "m/s"),
    SINCE_STEP: ("time since a step of the input", "s"),
    "d_x": ("change of ideal speed over one second", "m/s"),
    "d_w": ("change of ideal yaw rate over one second", "rad/s"),
    "yaw": ("heading in the map", "rad"),
    "t": ("time in the run", "s"),
    "x": ("x in the map", "m"),
    "y": ("y in the map", "m"),
}
"""Variables of signatures, the simplest first: label and unit."""
_OF_MAP = frozenset({"x", "y", "yaw"})
"""Variables on which what a command or a drive does cannot depend."""


@dataclass(frozen=True)
class Signature:
    """One effect in one run, in bins of the variable that it acts on.

    Attributes:
        effect: its id.
        channel: where it changes the prediction most, with 1 rad equal to 1 m: `x`, `y` or `w`.
        variable: key of `VARIABLES`; for `SINCE_STEP` the residual is divided by the height of the step.
        explained: share of the mean square of the contribution that is a function of the variable.
        value: middle of every bin, shape (k,).
        curve: contribution of the effect there, [m/s] or [rad/s], or a share of a step, shape (k,).
        before, after: mean residual of the model without and with the effect, shape (k,).
        before_error, after_error: half-widths of their 95 % intervals, clustered by ten-second blocks, (k,).
    """

    effect: str
    channel: str
    variable: str
    explained: float
    value: Floats
    curve: Floats
    before: Floats
    before_error: Floats
    after: Floats
    after_error: Floats


def find_signatures(data: EstimationData, state: ModelState, run: int = 0) -> list[Signature]:
    """The signature of every effect of a model in one run; effects without a contribution are left out.

    Args:
        data: the runs.
        state: the model with its values and the recordings' delays.
        run: which of the runs.
    """
    run_residuals = data.residuals_by_run[run]
    times = run_residuals.windows.times
    since = times.mean(axis=1) - run_residuals.run.start_s
    block = number_stretches(np.zeros(since.size, dtype=np.int64), since)
    shared = measure_variables(run_residuals) | _measure_predicted(run_residuals, state, run)
    bins = {name: _bin(values, block) for name, values in shared.items()}
    by_channel = [
        {**bins, **{name: _bin(one[0], block, one[1]) for name, one in own.items()}}
        for own in _measure_by_channel(run_residuals, shared)
    ]
    after = data.find_run_residuals(state, run)
    signatures = []
    for effect in state.effects:
        before = data.find_run_residuals(state.drop([effect.id]), run)
        acts = [one for one in VARIABLES if effect.place > Place.DRIVE or one not in _OF_MAP]
        signature = _find_one(effect.id, before - after, after, by_channel, block, acts)
        if signature is not None:
            signatures.append(signature)
    return signatures


def measure_variables(run_residuals: RunResiduals) -> dict[str, Floats]:
    """Recorded variables of signatures at every window, shape (n,) each."""
    velocity = run_residuals.predict_velocity((), Timing())
    spans, earlier = locate_windows(run_residuals), locate_windows(run_residuals, 1.0)
    ideal = average_windows(run_residuals, velocity, spans)
    times, grid, context = run_residuals.windows.times, run_residuals.grid, run_residuals.context
    middle = times.mean(axis=1)
    ends = [np.interp(times, grid.times, signal) for signal in (velocity.x, velocity.w)]
    rates = [(one[:, 1] - one[:, 0]) / run_residuals.windows.span_s for one in ends]
    change = ideal - average_windows(run_residuals, velocity, earlier)
    attitude = [np.interp(middle, context.times, column) for column in context.attitude.T]
    track = run_residuals.run.track
    places = [np.interp(middle, track.times, column) for column in track.position.T[:2]]
    return {
        "f_x": ideal[:, 0],
        "f_y": ideal[:, 1],
        "f_w": ideal[:, 2],
        "f_x_f_w": spans.average(run_residuals, velocity.x * velocity.w),
        "a_x": rates[0],
        "a_w": rates[1],
        "roll": attitude[0],
        "pitch": attitude[1],
        "d_x": change[:, 0],
        "d_w": change[:, 2],
        "yaw": np.angle(np.exp(1j * attitude[2])),
        "t": middle,
        "x": places[0],
        "y": places[1],
    }


def _measure_predicted(run_residuals: RunResiduals, state: ModelState, run: int) -> dict[str, Floats]:
    """Noise-free speed and yaw rate predicted by the model at every window."""
    velocity = run_residuals.predict_velocity(state.effects_of(run), state.timing[run])
    spans = locate_windows(run_residuals)
    return {
        "p_x": spans.average(run_residuals, velocity.x),
        "p_w": spans.average(run_residuals, velocity.w),
        "p_x_p_w": spans.average(run_residuals, velocity.x * velocity.w),
    }


def _measure_by_channel(
    run_residuals: RunResiduals, shared: Mapping[str, Floats]
) -> list[dict[str, tuple[Floats, Floats | None]]]:
    """Variables that differ for x, y and w, each with the divisor of the residual.

    The rim speed of the fastest wheel has the sign of the motion. For the time since the last step of the
    input (NaN without one in the last seconds) the divisor is the height of that step.
    """
    velocity = run_residuals.predict_velocity((), Timing())
    grid, middle = run_residuals.grid, run_residuals.windows.times.mean(axis=1)
    rim = np.abs(shared["f_x"]) + 0.5 * run_residuals.context.track_m * np.abs(shared["f_w"])
    signs = (shared["f_x"], shared["f_x_f_w"], shared["f_w"])
    variables = []
    for sign, signal in zip(signs, (velocity.x, velocity.y, velocity.w), strict=True):
        starts, heights = _find_steps(signal)
        since, height = np.full(middle.size, np.nan), np.zeros(middle.size)
        if starts.size:
            last = np.searchsorted(grid.times[starts], middle, side="right") - 1
            age = middle - grid.times[starts[np.maximum(last, 0)]]
            known = (last >= 0) & (age <= _LONGEST_STEP_S)
            since[known], height[known] = age[known], heights[last[known]]
        variables.append({SINCE_STEP: (since, height), "rim": (np.sign(sign) * rim, None)})
    return variables


def _find_steps(signal: Floats) -> tuple[Ints, Floats]:
    """Cells where a held signal steps, and the step heights; a step within a cell spans two cells."""
    least = _STEP * float(np.ptp(signal))
    jumps = np.diff(signal)
    both = jumps + np.append(jumps[1:], 0.0)
    starts = np.flatnonzero((np.abs(both) > least) & (least > 0.0))
    starts = starts[np.diff(starts, prepend=-9) > 2]  # noqa: PLR2004 - the cells of one step
    return starts, signal[np.minimum(starts + 3, signal.size - 1)] - signal[starts]


@dataclass(frozen=True)
class _Bins:
    """A variable in bins of equal width, neighbours merged until each has windows of enough blocks.

    Attributes:
        inside: windows in any bin, shape (n,).
        number: bin of each such window, shape (m,).
        scale: divisor of the residual of each such window, shape (m,).
        middle: mean of the variable in every bin, shape (k,).
    """

    inside: Flags
    number: Ints
    scale: Floats
    middle: Floats

    def regress(self, residual: Floats) -> Floats:
        """Least-squares factor of the scale in every bin (the mean for a scale of one), shape (k,)."""
        power = np.bincount(self.number, self.scale**2)
        return np.bincount(self.number, residual * self.scale) / np.maximum(power, 1e-12)

    def explain(self, curve: Floats) -> float:
        """Share of the mean square of a curve, over all windows, that is a function of the variable."""
        total = float(np.sum(curve**2))
        if self.middle.size < _FEWEST_BINS or total <= 0.0:
            return 0.0
        inside = curve[self.inside]
        rest = inside - self.regress(inside)[self.number] * self.scale
        return float(np.sum(inside**2) - np.sum(rest**2)) / total

    def find_error(self, residual: Floats, block: Ints) -> Floats:
        """Half-width of the cluster-robust 95 % interval of `regress` (Liang and Zeger 1986), shape (k,)."""
        rest = (residual - self.regress(residual)[self.number] * self.scale) * self.scale
        count, width = self.middle.size, int(block.max()) + 1
        index = self.number * width + block[self.inside]
        sums = np.bincount(index, rest, minlength=count * width).reshape(count, width)
        blocks = np.bincount(np.unique(index) // width, minlength=count)
        power = np.maximum(np.bincount(self.number, self.scale**2), 1e-12)
        spread = np.sqrt((sums**2).sum(axis=1) * blocks / np.maximum(blocks - 1, 1))
        error: Floats = NORMAL_95 * spread / power
        return error


def _bin(values: Floats, block: Ints, scale: Floats | None = None) -> _Bins:
    """A variable in bins; windows where it is NaN are left out, isolated extremes go to the outer bins."""
    number = np.full(values.size, -1, dtype=np.int64)
    known = np.isfinite(values)
    low, high = np.quantile(values[known], (0.005, 0.995)).tolist() if known.any() else (0.0, 0.0)
    if high - low > _NOTHING:
        index = np.clip(((values[known] - low) / (high - low) * _BINS).astype(np.int64), 0, _BINS - 1)
        width = int(block.max()) + 1
        met = np.zeros((_BINS, width), dtype=np.int64)
        np.add.at(met, (index, block[known]), 1)
        number[known] = _merge(met)[index]
    inside = number >= 0
    number = number[inside]
    scale = np.ones(number.size) if scale is None else scale[inside]
    middle = np.bincount(number, values[inside]) / np.maximum(np.bincount(number), 1)
    return _Bins(inside, number, scale, middle)


def _merge(met: Ints) -> Ints:
    """Merge bins with too few windows, or windows of too few blocks, with their neighbours.

    Args:
        met: windows by bin and block, shape (bins, blocks).

    Returns:
        New number of every bin, shape (bins,).
    """
    number, together = np.zeros(met.shape[0], dtype=np.int64), np.zeros(met.shape[1], dtype=np.int64)
    for index, row in enumerate(met):
        if together.sum() >= _FEWEST and np.count_nonzero(together) >= FEWEST_OF_SPREAD:
            number[index:] += 1
            together = np.zeros_like(together)
        together = together + row
    if together.sum() < _FEWEST or np.count_nonzero(together) < FEWEST_OF_SPREAD:
        number = np.minimum(number, max(int(number[-1]) - 1, 0))
    return number


def _find_one(
    name: str,
    curve: Floats,
    after: Floats,
    by_channel: Sequence[Mapping[str, _Bins]],
    block: Ints,
    variables: Sequence[str],
) -> Signature | None:
    """The signature in the channel and variable with the largest contribution of the effect.

    A yaw rate counts as the speed of a point one metre away, as in the modulus of slip.
    """
    best, strongest = _NOTHING, None
    for channel, known in enumerate(by_channel):
        size = float(np.sqrt((curve[:, channel] ** 2).mean()))
        if size <= best:
            continue
        shares = {key: known[key].explain(curve[:, channel]) for key in variables}
        most = max(shares.values())
        if size * most > best:
            best = size * most
            variable = next(key for key, share in shares.items() if share >= (1.0 - _NEARLY) * most)
            strongest = channel, variable, shares[variable]
    if strongest is None:
        return None
    channel, variable, explained = strongest
    bins = by_channel[channel][variable]
    # Outliers are clipped at six robust standard deviations.
    rest = after[:, channel]
    centre = float(np.median(rest))
    limit = CLIP * robust_spread(rest - centre) + _NOTHING
    rest = np.clip(rest, centre - limit, centre + limit)[bins.inside]
    own = curve[bins.inside, channel]
    return Signature(
        effect=name,
        channel=CHANNELS[channel],
        variable=variable,
        explained=explained,
        value=bins.middle,
        curve=bins.regress(own),
        before=bins.regress(own + rest),
        before_error=bins.find_error(own + rest, block),
        after=bins.regress(rest),
        after_error=bins.find_error(rest, block),
    )
