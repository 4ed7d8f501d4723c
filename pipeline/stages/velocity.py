"""The velocity stage: body velocities on a uniform grid, the gyro's yaw rate, and motion events.

Held poses are left out. The increments between the remaining ones are taken on SE(3), so that neither a turn
nor tilted ground causes a false velocity. Their running sum is an odometer, and a local quadratic fit of this
odometer gives the velocity.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, arrays, format_share, rigid
from pipeline.run import (
    ANSWERS_S,
    SPAN_S,
    Alignment,
    DriveSeries,
    GyroFit,
    Limits,
    find_limits,
    select_fresh,
    trace_traction,
)
from pipeline.sources import Vehicle, VelocitySection
from pipeline.stages.findings import Finding, StageError
from pipeline.stages.inputs import Ideal
from pipeline.stages.spans import LIVE, USUAL_S, Rims, Span, Spans, gather_rims, mark_excluded
from schemas import tabulate

_LEAST_TURNING_RADPS = 0.03
"""Standard deviation of the yaw rate below which an unused gyro cannot be judged, so that no disagreement is
reported."""
_SCALE_FORGIVEN = 0.05
"""Relative scale error of a gyro that is not reported: data sheets of MEMS gyros state 1 to 3 %."""
_BIAS_FORGIVEN = 0.01
"""Bias of a gyro [rad/s] above which it is reported: 0.6 degrees per second."""
_LATE = 0.04
"""Delay of poses [s] above which it is reported: the period of poses at 25 Hz."""


def smooth_gyro(times: Floats, imu: pl.DataFrame, fit: GyroFit, window: float) -> Floats:
    """The gyro's yaw rate [rad/s] at grid times, with sign, scale, bias and clock corrected.

    It is smoothed by the same local fit as the poses. Gaps of the gyro are NaN and are not bridged.

    Args:
        times: grid [s], shape (n,).
        imu: table `imu`.
        fit: fit of the gyro to the poses.
        window: width of the fit [s].
    """
    stamps, rate = imu["t"].to_numpy() - fit.moved_s, imu["rate_z"].to_numpy()
    distinct = np.concatenate(([True], np.diff(stamps) > 0.0))
    stamps, rate = stamps[distinct], rate[distinct]
    first = max(float(times.min()) - 1.0, float(stamps[0]))
    last = min(float(times.max()) + 1.0, float(stamps[-1]))
    rate_hz = VelocitySection().rate_hz
    count = arrays.count_grid(first, last, rate_hz)
    if count < 2 or stamps.size < 2:  # noqa: PLR2004 - no overlap with the poses
        return np.full(times.size, np.nan)
    # Grid times may differ from stamps by rounding.
    following = np.searchsorted(stamps, times - arrays.ROUNDING_S)
    before = stamps[np.maximum(following - 1, 0)]
    after = stamps[np.minimum(following, stamps.size - 1)]
    away = np.maximum(np.abs(times - before), np.abs(after - times))
    known = away <= arrays.SILENT_S + arrays.ROUNDING_S
    # Of the uniform grid only the points beside the given times, however long the gyro was silent.
    cell = np.clip(np.floor((times[known] - first) * rate_hz).astype(np.int64), 0, count - 2)
    grid = first + np.unique(np.concatenate((cell, cell + 1))) / rate_hz
    angle = arrays.integrate_rate(stamps, rate)[:, None]
    smooth = arrays.differentiate_locally(grid, stamps, angle, window)[:, 0]
    corrected = np.full(times.size, np.nan)
    if known.any():
        corrected[known] = fit.signed_scale * np.interp(times[known], grid, smooth) + fit.bias
    return corrected


def report_gyro(alignment: Alignment, turning: Floats) -> list[Finding]:
    """Findings on the gyro.

    Args:
        alignment: alignment with its fit to the poses, if any.
        turning: yaw rate of the poses [rad/s], shape (n,).
    """
    fit = alignment.gyro
    if fit is None:
        if float(np.std(turning)) < _LEAST_TURNING_RADPS:
            text = "the vehicle turned too little to check the gyro against the poses: it was not used"
            return [Finding("imu_unchecked", "info", text)]
        text = "the gyro does not agree with the poses, or is silent in part of the run: it was not used"
        return [Finding("imu_disagrees", "warning", text, where="imu")]
    findings = []
    if fit.signed_scale < 0.0:
        text = (
            "the gyro's yaw rate has the wrong sign and was inverted: it then differs from the yaw rate of "
            f"the poses by {format_share(fit.residual)}"
        )
        findings.append(Finding("imu_sign", "warning", text, where="imu", value=fit.signed_scale))
    scale = abs(fit.signed_scale)
    if abs(scale - 1.0) > _SCALE_FORGIVEN:
        text = f"the poses turn {scale:.3f} times as much as the gyro says: it was scaled"
        findings.append(Finding("imu_scale", "warning", text, where="imu", value=scale))
    if abs(fit.bias) > _BIAS_FORGIVEN:
        text = f"the gyro has a bias of {-fit.bias:.4f} rad/s against the poses: it was removed"
        findings.append(Finding("imu_bias", "info", text, where="imu", value=-fit.bias))
    delay = alignment.heading_delay_s
    if abs(delay) > _LATE:
        late = "late" if delay > 0.0 else "early"
        text = f"the poses are {abs(delay):.2g} s {late} against the gyro: corrected"
        findings.append(Finding("pose_delay", "info", text, where="pose", value=delay))
    return findings


@dataclass(frozen=True)
class VelocityResult:
    """Velocities and findings."""

    table: pl.DataFrame
    findings: tuple[Finding, ...] = field(default=())


def compute_velocities(
    poses: pl.DataFrame,
    imu: pl.DataFrame,
    alignment: Alignment,
    settings: VelocitySection,
    *,
    where: str,
    wheels: DriveSeries | None = None,
) -> VelocityResult:
    """Differentiate aligned poses into body velocities.

    Args:
        poses: table `poses`, aligned.
        imu: table `imu`; may be empty.
        alignment: with the fit of the gyro to the poses, if it is good.
        settings: grid rate [Hz], width of the fit [s], source of the yaw rate.
        where: the run, for error messages.
        wheels: measured wheels, which tell a localization that waits from a vehicle at rest.

    Raises:
        StageError: no segment is long enough, or the gyro is requested and none is usable.
    """
    table, skipped = differentiate_poses(poses, settings, wheels, where=where)
    findings: list[Finding] = []
    if skipped:
        are, hold = ("segment is", "holds") if skipped == 1 else ("segments are", "hold")
        text = f"{skipped} {are} shorter than {SPAN_S} s or {hold} one pose: left out"
        findings.append(Finding("short_segments", "info", text, count=skipped))
    gyro = alignment.gyro
    if not imu.is_empty():
        findings += report_gyro(alignment, table["v_w"].to_numpy())
    rate = None if gyro is None else smooth_gyro(table["t"].to_numpy(), imu, gyro, settings.window_s)
    column = (
        pl.Series("v_w_imu", rate, dtype=pl.Float64).fill_nan(None)
        if rate is not None
        else pl.lit(None, pl.Float64).alias("v_w_imu")
    )
    table = table.with_columns(column)
    if settings.yaw == "imu":
        if rate is None:
            what = "--yaw imu was given, but the log has no gyro that agrees with the poses"
            raise StageError("no_gyro", what, where=where, hint="Use --yaw pose (the default).")
        silent = table["v_w_imu"].null_count()
        if silent:
            text = f"the gyro is silent in {silent} time steps: the poses' yaw rate is used there"
            findings.append(Finding("imu_gap", "warning", text, where="imu", count=silent))
        table = table.with_columns(pl.coalesce(pl.col("v_w_imu"), pl.col("v_w")).alias("v_w"))
    return VelocityResult(table, tuple(findings))


def differentiate_poses(
    poses: pl.DataFrame, settings: VelocitySection, wheels: DriveSeries | None, *, where: str
) -> tuple[pl.DataFrame, int]:
    """Body velocities on the uniform grid of every segment, without those of a gyro.

    Args:
        poses: table `poses`, aligned.
        settings: grid rate [Hz] and width of the fit [s].
        wheels: see `compute_velocities`.
        where: the run, for error messages.

    Returns:
        Table `velocities` without `v_w_imu`, and the number of segments that were too short.

    Raises:
        StageError: ``no_segment``.
    """
    pieces = [_differentiate_segment(piece, settings, wheels) for piece in rigid.cut_segments(poses)]
    made = [piece for piece in pieces if piece is not None]
    if not made:
        what = "the poses hold no stretch of half a second without a gap or a jump"
        hint = "Check the pose topic with `slip inspect`; or widen velocity.gap_s, velocity.jump_m."
        raise StageError("no_segment", what, where=where, hint=hint)
    table = pl.DataFrame({name: np.concatenate([piece[name] for piece in made]) for name in made[0]})
    return table, len(pieces) - len(made)


def _differentiate_segment(
    piece: dict[str, NDArray[Any]], settings: VelocitySection, wheels: DriveSeries | None
) -> dict[str, NDArray[Any]] | None:
    """Velocities of one segment, by column; None if it is too short."""
    times = piece["t"]
    fresh = select_fresh(piece, wheels)
    aligned = np.maximum.accumulate(times - piece["latency"])
    # Latencies do not change the order, up to rounding.
    fresh = fresh[np.diff(aligned[fresh], prepend=-np.inf) > 0.0]
    if fresh.size < 2:  # noqa: PLR2004 - one pose has no velocity
        return None
    stamps = aligned[fresh]
    # The grid covers the whole segment including repeats: a vehicle may be at rest at its end.
    first, last = float(aligned[0]), float(aligned[-1])
    if last - first < SPAN_S:
        return None
    position, quaternion = piece["position"][fresh], piece["quaternion"][fresh]
    move, turn = rigid.measure_increments(position, quaternion)
    odometer = np.concatenate(
        (np.zeros((1, 3)), np.cumsum(np.column_stack((move[:, :2], turn[:, 2])), axis=0))
    )
    grid = arrays.make_grid(first, last, settings.rate_hz)
    inside = np.clip(grid, stamps[0], stamps[-1])
    velocity = arrays.differentiate_locally(inside, stamps, odometer, settings.window_s)
    late, stamped = piece["latency"], np.interp(inside, stamps, times[fresh])
    # A common delay moves a velocity in time, and does not change it.
    before = (
        arrays.differentiate_locally(stamped, times[fresh], odometer, settings.window_s)
        if np.ptp(late) > 0.0
        else velocity
    )
    at, attitude = rigid.interpolate_poses(inside, stamps, position, quaternion)
    roll, pitch, yaw = rigid.euler_from_quaternions(attitude)
    return {
        "t": grid,
        "stamp": piece["stamp"][0] + np.round((grid - times[0]) * 1e9).astype(np.int64),
        "segment": np.full(grid.size, piece["segment"][0], dtype=np.int32),
        **{name: at[:, i] for i, name in enumerate("xyz")},
        "roll": roll,
        "pitch": pitch,
        "yaw": np.unwrap(yaw),
        **{name: velocity[:, i] for i, name in enumerate(("v_x", "v_y", "v_w"))},
        "recorded_t": stamped,
        **{f"recorded_{axis}": before[:, i] for i, axis in enumerate("xyw")},
        "outlier": piece["outlier"][arrays.nearest_indices(grid, aligned)],
    }


_FALSE_MOTION = {"pushed", "localization_frozen"}
"""Incidents in which the body's motion says nothing about the ground under the wheels."""
_WIDTH = 5
"""Samples over which the size of an event is averaged: shorter peaks are noise of the poses."""
_FEWEST = 40
"""Least number of samples for a usual ratio: two seconds of driving."""
_SMOOTH_S = 0.5
"""Width of a running mean [s], below the 0.75 s over which poses are differentiated."""
_JOINED_S = 1.5
"""Largest gap [s] between events of one kind that are merged."""
_KINDS = {1: "digging_in", 2: "spinning", 3: "sliding"}
_MEANS = {
    "digging_in": "the vehicle moved less and less per turn of its wheels: it dug in",
    "spinning": "the wheels turned and the vehicle hardly moved: the wheels spun",
    "sliding": "the vehicle moved faster than its wheels turned: it slid",
}


@dataclass(frozen=True)
class MotionEvents:
    """Table `events`, and a finding for every event that is not an incident."""

    table: pl.DataFrame = field(default_factory=lambda: tabulate("events", []))
    findings: tuple[Finding, ...] = ()


def find_events(
    velocities: pl.DataFrame,
    inputs: Mapping[str, Ideal],
    vehicle: Vehicle,
    spans: Spans,
) -> MotionEvents:
    """All events of a run in order.

    Args:
        velocities: table `velocities`, of poses alone.
        inputs: ideal velocities by input; without measured wheels only incidents are detected.
        vehicle: its track converts yaw rates to rim speeds.
        spans: contradictions of the run.
    """
    times = velocities["t"].to_numpy()
    rims = gather_rims(velocities, inputs, vehicle)
    loss, events = np.zeros(times.size), list[_Event]()
    if rims is not None and rims.driven is not None:
        fastest, driven = np.abs(rims.driven).sum(axis=1), np.nan_to_num(rims.driven)
        unknown = spans.wrong | np.isnan(fastest)
        unknown |= mark_excluded(times, [one for one in spans.incidents if one.kind in _FALSE_MOTION])
        moved = _smooth(times, rims.moved)
        gain = _measure_gain(rims, driven[:, 0], moved[:, 0])
        limits = find_limits(rims.top, gain)
        brought = gain * driven[:, 0]
        signals = _Signals(
            times,
            np.where(unknown, 0.0, brought),
            driven[:, 2],
            np.where(unknown, 0.0, _count_sideways(moved, brought)),
        )
        events = _leave_out_usual(_find_traction(signals, limits), times, fastest > LIVE * rims.top)
        events = _end_where_stuck(events, times, spans.incidents)
        wheels = np.where(signals.wheels == 0.0, np.inf, signals.wheels)
        loss = 1.0 - signals.body / wheels
    rows = [
        _make_row(velocities, kind, (times[a], times[b], times[known]), _measure_size(kind, loss[a : b + 1]))
        for kind, a, b, known in events
    ]
    for one in spans.incidents:
        ends = (one.start, one.end, min(one.start + ANSWERS_S, one.end))
        rows.append(_make_row(velocities, one.kind, ends, None))
    findings = [
        Finding(kind, "warning", _MEANS[kind], t_start=float(times[a]), t_end=float(times[b]))
        for kind, a, b, _ in events
    ]
    rows.sort(key=lambda row: (row["t_start"], row["kind"]))
    return MotionEvents(tabulate("events", rows), tuple(findings))


_Event = tuple[str, int, int, int]
"""Kind of an event, its first and last sample, and the sample at which it is known."""


@dataclass(frozen=True)
class _Signals:
    """Inputs of `trace_traction` on the grid, shape (n,) each; zero if unknown."""

    times: Floats
    wheels: Floats
    turning: Floats
    body: Floats


def _smooth(times: Floats, values: Floats) -> Floats:
    """Running mean over `_SMOOTH_S`, shape (n, k)."""
    steps = arrays.count_steps(times, _SMOOTH_S)
    total = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)))
    low = np.maximum(np.arange(times.size) - steps // 2, 0)
    high = np.minimum(np.arange(times.size) + steps // 2 + 1, times.size)
    means: Floats = (total[high] - total[low]) / (high - low)[:, None]
    return means


def _measure_gain(rims: Rims, driven: Floats, moved: Floats) -> float:
    """Usual ratio of the body's forward motion to that of the wheels; 0 if the wheels never moved."""
    turning = np.abs(driven) > LIVE * rims.top
    if turning.sum() < _FEWEST:
        return 0.0
    return max(float(np.median(moved[turning] / driven[turning])), 0.0)


def _count_sideways(moved: Floats, brought: Floats) -> Floats:
    """Forward speed of the body, to which sideways motion is added up to the speed of the wheels.

    A vehicle that slides sideways through a turn moves: neither does it dig in nor do its wheels spin in
    place. Only up to the speed of the wheels, because a sensor ahead of the axles moves sideways in every
    turn, which is no slide.

    Args:
        moved: (v_x, v_y, v_w times half the track) of the body [m/s], shape (n, 3).
        brought: forward speed of the body that is usual at the wheel speeds [m/s], shape (n,).
    """
    forward, total = moved[:, 0], np.hypot(moved[:, 0], moved[:, 1])
    missing = np.minimum(total, np.abs(brought)) - np.abs(forward)
    counted: Floats = forward + np.sign(brought) * np.maximum(missing, 0.0)
    return counted


def _find_traction(signals: _Signals, limits: Limits) -> list[_Event]:
    times, wheels, body = signals.times, signals.wheels, signals.body
    step = float(np.median(np.diff(times)))
    codes = trace_traction(wheels.tolist(), signals.turning.tolist(), body.tolist(), step, **vars(limits))
    events: list[_Event] = []
    joined, index = arrays.count_steps(times, _JOINED_S), 0
    while index < len(codes):
        if codes[index] == 0:
            index += 1
            continue
        first, kind = index, _KINDS[codes[index]]
        # Wheels that dig themselves in finally spin.
        while (
            index < len(codes) and codes[index] and (_KINDS[codes[index]] == "sliding") == (kind == "sliding")
        ):
            index += 1
        begin = _go_back(first, kind, signals, limits)
        if events and events[-1][0] == kind and begin - events[-1][2] <= joined:
            events[-1] = (kind, events[-1][1], index - 1, events[-1][3])
        else:
            events.append((kind, begin, index - 1, first))
    return events


def _go_back(first: int, kind: str, signals: _Signals, limits: Limits) -> int:
    """First sample of an event that is detected at a later sample."""
    least = 1.0 - limits.drop if kind == "digging_in" else limits.half
    for index in range(first, 0, -1):
        wheel, speed = signals.wheels[index - 1], signals.body[index - 1]
        slides = abs(speed) > limits.excess * abs(wheel) + 0.5 * limits.margin
        slips = abs(wheel) > limits.live and speed * np.sign(wheel) < least * abs(wheel)
        if not (slides if kind == "sliding" else slips):
            return index
    return 0


def _leave_out_usual(events: Sequence[_Event], times: Floats, driven: Flags) -> list[_Event]:
    """The infrequent events: what occurs repeatedly is a property of the ground."""
    driven_s = float(np.sum(np.diff(times)[driven[1:]]))
    counts = Counter(kind for kind, *_ in events)
    return [event for event in events if counts[event[0]] <= max(driven_s / USUAL_S, 1.0)]


def _end_where_stuck(events: Sequence[_Event], times: Floats, incidents: Sequence[Span]) -> list[_Event]:
    """The events up to the time at which the vehicle is stuck, which explains the later ones."""
    for kind, start, end, _ in incidents:
        if kind == "stuck":
            last = int(np.searchsorted(times, start))
            events = [
                (name, a, min(b, max(last, a)) if times[a] < end else b, known)
                for name, a, b, known in events
                if not start <= times[a] < end
            ]
    return list(events)


def _measure_size(kind: str, loss: Floats) -> float:
    """Largest fraction of motion lost, or for a sliding body the largest fraction not made by the wheels."""
    width = min(_WIDTH, loss.size)
    smooth = np.convolve(loss, np.full(width, 1.0 / width), mode="valid")
    if kind == "sliding":
        # Body over wheels is one minus the loss; the fraction beyond the wheels is one minus its inverse.
        return float(np.clip(1.0 - 1.0 / max(float(np.abs(1.0 - smooth).max()), 1.0), 0.0, 1.0))
    return float(np.clip(smooth.max(), 0.0, 1.0))


def _make_row(
    velocities: pl.DataFrame, kind: str, when: tuple[float, float, float], size: float | None
) -> dict[str, object]:
    start, end, known = (float(one) for one in when)
    row = min(int(velocities["t"].search_sorted(start)), velocities.height - 1)
    x, y = (float(velocities[name][row]) for name in ("x", "y"))
    return {"kind": kind, "t_start": start, "t_end": end, "t_known": known, "size": size, "x": x, "y": y}
