"""The published chain from commands and poses to window norms.

The chain of Samson et al. 2024 is reimplemented, so that our results can be compared with the paper's. They
print medians of the norm of g over windows of 2 s. Their u is not the raw command but the response of a
powertrain model to it; their v comes from splines of held poses. Where the paper and its public code leave a
choice, the function that makes it documents it.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import ROUNDING_S, Flags, Floats, Ints, arrays
from pipeline.stages import PUBLISHED_SAMPLES, WINDOW_S

_STIFFNESS = 0.8
"""Lambda of the published smoothing spline; it halves the amplitude of a motion of 0.36 Hz."""
_PERIOD = WINDOW_S / PUBLISHED_SAMPLES
_TAUS = (0.05, 3.0)
"""Bounds of the powertrain's time constant [s]: the published ones are 0.6 to 1.1, see `follow_published`."""
_SLOW_SHARE = 0.5
"""Share of the steps to use, the slower ones: in fast ones limits lower the ratio."""
_SMALLEST = 0.05
"""Command [m/s, rad/s] below which a ratio to it is noise."""
_OFF_RATE = 0.01
"""Relative tolerance of the rate of 20 Hz: the chain is defined for 40 samples in 2 s."""


@dataclass(frozen=True)
class Limits:
    """Vehicle data of the published chain.

    Attributes:
        speed_mps: limit of the body command's speed; None if unknown.
        yaw_rate_radps: limit of its yaw rate; None if unknown.
        track_m: track width, which converts a yaw rate into a difference of wheel speeds.
    """

    speed_mps: float | None
    yaw_rate_radps: float | None
    track_m: float


@dataclass(frozen=True)
class PublishedRun:
    """Result of the published chain for a run.

    Attributes:
        norms: one row per window: ``t_start`` [s], ``segment``, ``step``, ``window_norm`` [m/s].
        tau_s: fitted time constant of the wheels.
        scale: factors of the body command, (forward, yaw rate).
    """

    norms: pl.DataFrame
    tau_s: float
    scale: tuple[float, float]


@dataclass(frozen=True)
class _Steps:
    """Command steps as rows of a matrix: sample indices, -1 beyond a step's end."""

    index: Ints

    def lay_out(self, values: Floats) -> Floats:
        """Values (n, 2) as (steps, longest, 2); the last sample of a step is repeated beyond its end."""
        return values[np.where(self.index < 0, self.index.max(axis=1, keepdims=True), self.index)]


def follow_published(
    slip: pl.DataFrame, poses: pl.DataFrame, *, limits: Limits, command_is_scaled: bool
) -> PublishedRun | None:
    """Window norms of one run by the published chain, with the pose's yaw rate.

    - u: the body command, clipped, through a first-order lag with one time constant for both wheels, over the
      whole command step, starting from the measured wheel speeds. The time constant minimizes the mean
      absolute error between the lagged command and the measured wheels of the run (0.05 to 3 s).
    - If the log's command was scaled wrongly and is corrected (finding `command_scale`), forward speed and
      yaw rate are first multiplied by their measured ratios in slow steady steps.
    - v: x, y and yaw of the poses as recorded, held ones too, at 20 Hz; per window of 40 samples a smoothing
      spline with lambda 0.8 over t from 0 to 2 s; forward differences, rotated by the smoothed heading at
      their start, the last value repeated.
    - The norm of a window is that of its 3 x 40 slips, with L = 1 m. No window is excluded as suspect.

    Args:
        slip: table `slip` of the run, both inputs.
        poses: table `poses` of the run.
        limits: limits of the vehicle's body command.
        command_is_scaled: whether the command was scaled wrongly and is corrected.

    Returns:
        None if the run has no command, no measured wheels, no whole window, or a rate other than 20 Hz.
    """
    both = _join_inputs(slip)
    if both.height < PUBLISHED_SAMPLES or abs(float(both["t"].diff().median()) / _PERIOD - 1.0) > _OFF_RATE:  # type: ignore[arg-type]
        return None
    steps = _find_steps(both)
    command, measured = both.select("f_x", "f_w").to_numpy(), both.select("m_x", "m_w").to_numpy()
    scale = _find_scale(both) if command_is_scaled else (1.0, 1.0)
    bounds = [np.inf if end is None else end for end in (limits.speed_mps, limits.yaw_rate_radps)]
    asked = steps.lay_out(np.clip(command * scale, [-end for end in bounds], bounds))
    got = steps.lay_out(measured)
    sides = np.array([[1.0, 1.0], [-0.5, 0.5]]) * np.array([[1.0], [limits.track_m]])
    tau = _fit_lag(asked @ sides, got @ sides, steps.index >= 0)
    driven = _lag(asked, got[:, 0], tau)
    windows = _cut_windows(steps.index)
    if not windows.size:
        return None
    input_velocity = np.empty_like(command)
    there = steps.index >= 0
    input_velocity[steps.index[there]] = driven[there]
    norms = _measure_windows(both, poses, input_velocity, windows)
    first = windows[:, 0]
    frame = both[first].select(pl.col("t").alias("t_start"), "segment", "step")
    return PublishedRun(frame.with_columns(pl.Series("window_norm", norms)), tau, scale)


def _join_inputs(slip: pl.DataFrame) -> pl.DataFrame:
    wheels = slip.filter(pl.col("input") == "measured").select(
        "stamp", pl.col("f_x").alias("m_x"), pl.col("f_w").alias("m_w")
    )
    return slip.filter(pl.col("input") == "command").join(wheels, on="stamp").sort("t")


def _find_steps(both: pl.DataFrame) -> _Steps:
    """A step ends where its number changes or a sample is missing."""
    number, times = both["step"].to_numpy(), both["t"].to_numpy()
    starts = np.flatnonzero(
        np.concatenate(([True], (np.diff(number) != 0) | (np.diff(times) > 1.5 * _PERIOD)))
    )
    sizes = np.diff(np.concatenate((starts, [number.size])))
    offset = np.arange(int(sizes.max()))
    index = starts[:, None] + offset[None, :]
    return _Steps(np.where(offset[None, :] < sizes[:, None], index, -1))


def _find_scale(both: pl.DataFrame) -> tuple[float, float]:
    """Ratio of measured to commanded motion, forward and turning, in the slower half of the steady steps."""
    means = both.filter(~pl.col("transitory")).group_by("step").agg(pl.col("f_x", "f_w", "m_x", "m_w").mean())
    scales = []
    for asked, got in (("f_x", "m_x"), ("f_w", "m_w")):
        live = means.filter(pl.col(asked).abs() > _SMALLEST)
        slow = live.filter(pl.col(asked).abs() <= pl.col(asked).abs().quantile(_SLOW_SHARE))
        ratio = slow.select((pl.col(got) / pl.col(asked)).median()).item()
        scales.append(1.0 if ratio is None or ratio <= 0.0 else float(ratio))
    return scales[0], scales[1]


def _fit_lag(asked: Floats, got: Floats, there: Flags) -> float:
    """Time constant [s] that minimizes the error of lagged wheel commands (left, right)."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - heavy

    def miss(tau: float) -> float:
        return float(np.mean(np.abs(_lag(asked, got[:, 0], tau) - got)[there]))

    return float(minimize_scalar(miss, bounds=_TAUS, method="bounded", options={"xatol": 0.01}).x)


def _lag(asked: Floats, start: Floats, tau: float) -> Floats:
    """First-order response to held values, along axis 1; exact for commands that are held over a sample."""
    from scipy.signal import lfilter  # noqa: PLC0415 - heavy

    keep = np.exp(-_PERIOD / tau)
    before = np.concatenate((start[:, None], asked[:, :-1]), axis=1)
    # The first output is the start itself: the filter state compensates for its first input.
    memory = keep * start[:, None]
    answer: Floats = lfilter([1.0 - keep], [1.0, -keep], before, axis=1, zi=memory)[0]
    return answer


def _cut_windows(index: Ints) -> Ints:
    """Whole windows from each step's start, as rows of sample indices."""
    whole = index[:, : index.shape[1] // PUBLISHED_SAMPLES * PUBLISHED_SAMPLES].reshape(-1, PUBLISHED_SAMPLES)
    return whole[whole[:, -1] >= 0]


def _measure_windows(both: pl.DataFrame, poses: pl.DataFrame, driven: Floats, windows: Ints) -> Floats:
    held = np.maximum(arrays.hold_indices(both["t"].to_numpy() + ROUNDING_S, poses["t"].to_numpy()), 0)
    turned = {name: poses[name].to_numpy()[held] for name in ("x", "y", "q_x", "q_y", "q_z", "q_w")}
    yaw = np.arctan2(
        2.0 * (turned["q_w"] * turned["q_z"] + turned["q_x"] * turned["q_y"]),
        1.0 - 2.0 * (turned["q_y"] ** 2 + turned["q_z"] ** 2),
    )
    smoother = _make_smoother()
    x, y, heading = (
        values @ smoother.T
        for values in (turned["x"][windows], turned["y"][windows], np.unwrap(yaw[windows], axis=1))
    )
    east, north, turn = (_difference(values) for values in (x, y, heading))
    cosine, sine = np.cos(heading), np.sin(heading)
    forward, sideways = cosine * east + sine * north, cosine * north - sine * east
    for velocity in (forward, sideways):
        velocity[:, -1] = velocity[:, -2]
    squares = (driven[windows, 0] - forward) ** 2 + sideways**2 + (driven[windows, 1] - turn) ** 2
    norms: Floats = np.sqrt(squares.sum(axis=1))
    return norms


def _difference(values: Floats) -> Floats:
    forward = np.diff(values, axis=1) / _PERIOD
    return np.concatenate((forward, forward[:, -1:]), axis=1)


@functools.cache
def _make_smoother() -> Floats:
    """The matrix (40, 40) of the smoothing spline: with fixed abscissae it is linear in the values."""
    from scipy.interpolate import make_smoothing_spline  # noqa: PLC0415 - heavy

    times = np.linspace(0.0, WINDOW_S, PUBLISHED_SAMPLES)
    columns = [
        make_smoothing_spline(times, unit, lam=_STIFFNESS)(times) for unit in np.eye(PUBLISHED_SAMPLES)
    ]
    return np.stack(columns, axis=1)


def read_limits(vehicle: Mapping[str, object]) -> Limits:
    """Limits of a vehicle from its manifest."""
    names = ("max_speed_mps", "max_yaw_rate_radps", "track_width_m")
    ends = [vehicle.get(name) for name in names]
    speed, turn, track = (float(end) if isinstance(end, (int, float)) else None for end in ends)
    return Limits(speed, turn, 1.0 if track is None else track)
