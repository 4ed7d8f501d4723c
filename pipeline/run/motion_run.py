"""One run as arrays: its poses, commands, wheels and gyro, read from its tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipeline.core import ROUNDING_S, Complex, Flags, Floats, Ints, SlipError, arrays, rigid
from pipeline.run.signals import GROUND_UNOBSERVABLE, IN_BURSTS, DriveSeries, find_fastest_wheel, round_off
from pipeline.sources import Vehicle
from pipeline.store import Manifest


class MotionError(SlipError):
    """Error of a model, an effect, a formula or a fit."""


# Conversion of stored tables to a run.
#
# Only this module converts stored tables to a run. The errors of a recording have been corrected before;
# nothing is corrected here.

_REPEATED_SHARE = 0.2
"""Share of repeated poses above which the period of the stamps is an uncertainty of their time: the
recordings have none, or 0.49 to 0.80."""
_FAR_S = 2.5
"""Distance from every message [s] beyond which nothing is scored: longer than a prediction (2 s)."""
_DEAD = 1e-9
"""Wheel speed [rad/s] below which the wheels of a log never move: rounding."""
_ROLLS = 0.3
"""Wheel speed [rad/s] above which wheels turn: 5 cm/s of a Husky, 9 cm/s of a Warthog."""


@dataclass(frozen=True)
class Track:
    """Poses with new information, in the plane of motion.

    Attributes:
        times: stamps [s], shape (n,).
        segment: number of the segment, shape (n,).
        path: position x + iy [m] in the plane, integrated from body increments, shape (n,).
        heading: accumulated rotation about the body's own z axis [rad], shape (n,).
        attitude: roll, pitch, yaw [rad], yaw unwrapped, shape (n, 3).
        position: x, y in the map [m], shape (n, 2).
        active: inside an interval with live commands, shape (n,).
    """

    times: Floats
    segment: Ints
    path: Complex
    heading: Floats
    attitude: Floats
    position: Floats
    active: Flags


@dataclass(frozen=True)
class GyroFit:
    """Yaw rate = signed_scale * gyro + bias.

    Attributes:
        signed_scale: negative if the gyro has the opposite sign.
        bias: [rad/s].
        yaw_delay_s: delay of the heading of the track relative to the gyro; zero in an aligned recording.
        delay_error_s: standard error of that delay, from stretches of ten seconds.
        residual: robust spread of the residual over that of the turning itself.
        moved_s: delay of the gyro's own stamps: at most half their period, and independent of the clock of
            the poses.
    """

    signed_scale: float
    bias: float
    yaw_delay_s: float
    delay_error_s: float
    residual: float
    moved_s: float = 0.0

    def turn(self, times: Floats, rate: Floats) -> Floats:
        """Integrated angle of the gyro [rad] from its rate [rad/s] at times [s], shape (n,)."""
        return self.signed_scale * arrays.integrate_rate(times, rate) + self.bias * times

    def turn_until(self, at: Floats, gyro: tuple[Floats, Floats]) -> Floats:
        """That angle at times of the poses [s], shape (m,)."""
        return np.interp(at - self.yaw_delay_s, gyro[0], self.turn(*gyro))


@dataclass(frozen=True)
class Alignment:
    """Corrections of the clocks, scales and signs of a recording.

    Attributes:
        hold_s: time from the last command until the controller stops; None without commands.
        command_scale: factor by which the recorded command was multiplied; of commanded sides, their mean.
        command_turn_scale: factor by which the difference of commanded sides was multiplied.
        track_multiplier: factor by which the controller multiplies the track width.
        wheel_delay_s: delay of the encoders relative to the gyro, removed from the wheels.
        latency_spread_s: standard deviation of the latencies removed from the poses.
        outlier_s: duration of contradictions of localization and wheels, except bad stretches.
        gyro: fit of the gyro to the poses; None without a good one.
        heading_delay_s: delay of the reported heading relative to the gyro, removed from the poses.
        body_multiplier: yaw rate of the commanded wheels at the nominal track over that of the body command;
            None without a body command that the wheels obey.
    """

    hold_s: float | None = None
    command_scale: float = 1.0
    command_turn_scale: float = 1.0
    track_multiplier: float = 1.0
    wheel_delay_s: float = 0.0
    latency_spread_s: float = 0.0
    outlier_s: float = 0.0
    gyro: GyroFit | None = None
    heading_delay_s: float = 0.0
    body_multiplier: float | None = None


@dataclass(frozen=True)
class Origin:
    """Where an anchored run has its zero.

    Attributes:
        time_s: in the time of the log [s].
        place: x + iy in the plane of the track as recorded [m].
        heading: there [rad].
    """

    time_s: float = 0.0
    place: complex = 0j
    heading: float = 0.0

    def put_back(self, path: Complex) -> Complex:
        """Places of an anchored run [m] in the plane as recorded."""
        recorded: Complex = self.place + np.exp(1j * self.heading) * path
        return recorded


@dataclass(frozen=True)
class MotionRun:
    """One run.

    Attributes:
        name: of the run.
        sha256: of its recording, empty when unknown.
        terrain: its terrain.
        commands: held commands, with stops after the hold time; None without.
        wheels: measured wheels; None without, or if they never move.
        gyro: times [s] and yaw rate [rad/s], as recorded; None without.
        track: the poses.
        streams: stamps of poses, commands and wheels [s], increasing; a pause is a gap of the recording.
        step_starts: start times of command steps [s].
        excluded: times [s] of samples in bad stretches, of a vehicle at rest, or without a live command.
        duration_s: length of the run, without the time at its ends in which it stands.
        alignment: corrections of the recording.
        repeats_s: period of the published poses [s] if they are repeated until the next one is computed; zero
            if each is new.
        is_on_course: whether its heading is the course over ground, so that it never moves sideways.
        is_drive_alone: whether its poses are the motion of its wheels, since none were recorded.
        in_bursts: whether it stops before the next command, and how long a command acts was found by taking
            it to be as fast as commanded.
        contradicted: dimensions of the vehicle that findings of the run contradict, by name.
        origin: where its zero lies in the recording, see `anchored`.
        lead_s: time that it stands before it drives.
    """

    name: str
    sha256: str
    terrain: str
    commands: DriveSeries | None
    wheels: DriveSeries | None
    gyro: tuple[Floats, Floats] | None
    track: Track
    streams: Floats
    step_starts: Floats
    excluded: Floats
    duration_s: float
    alignment: Alignment
    repeats_s: float = 0.0
    is_on_course: bool = False
    is_drive_alone: bool = False
    in_bursts: bool = False
    contradicted: frozenset[str] = frozenset()
    origin: Origin = Origin()
    lead_s: float = 0.0

    @property
    def anchored(self) -> MotionRun:
        """The run in times from its start, and in a plane from its first pose, in steps of a millionth.

        A search amplifies rounding. Equal drives give equal answers this way, wherever their map lies and
        whenever the recorder was started. Yaw and position in the map remain as they are; of what was stamped
        within one step, the last command and the first pose remain.
        """
        track, alignment, gyro = self.track, self.alignment, self.alignment.gyro
        start, heading = self.start_s, float(track.heading[0])
        path = (track.path - track.path[0]) * np.exp(-1j * heading)
        path = arrays.join_parts(round_off(path.real), round_off(path.imag))
        delays = np.array((alignment.heading_delay_s, alignment.wheel_delay_s, alignment.latency_spread_s))
        late, late_wheels, spread = round_off(delays).tolist()
        if gyro is not None:
            gyro = GyroFit(*round_off(np.array([*vars(gyro).values()])).tolist())

        def shift(times: Floats) -> Floats:
            return round_off(times - start)

        def anchor(series: DriveSeries | None) -> DriveSeries | None:
            if series is None:
                return None
            times = shift(series.times)
            mask = np.diff(times, append=np.inf) > 0.0
            return series.change(times[mask], lambda signal: round_off(signal[mask]))

        moved = replace(
            track,
            times=shift(track.times),
            path=path,
            heading=round_off(track.heading - heading),
            attitude=np.column_stack((round_off(track.attitude[:, :2]), track.attitude[:, 2])),
        )
        is_later = np.diff(moved.times, prepend=-np.inf) > 0.0
        return replace(
            self,
            commands=anchor(self.commands),
            wheels=anchor(self.wheels),
            gyro=None if self.gyro is None else _distinct(shift(self.gyro[0]), self.gyro[1]),
            track=Track(*(values[is_later] for values in vars(moved).values())),
            streams=np.unique(shift(self.streams)),
            step_starts=shift(self.step_starts),
            excluded=shift(self.excluded),
            alignment=replace(
                alignment,
                gyro=gyro,
                heading_delay_s=late,
                wheel_delay_s=late_wheels,
                latency_spread_s=spread,
            ),
            origin=Origin(
                self.origin.time_s + start,
                complex(self.origin.put_back(track.path[:1])[0]),
                self.origin.heading + heading,
            ),
        )

    @property
    def start_s(self) -> float:
        """Start of its first stream [s]."""
        return float(self.streams[0])

    @property
    def gyro_fit(self) -> GyroFit | None:
        """Fit of the gyro to the poses; None without a good one."""
        return self.alignment.gyro

    @property
    def wheel_period_s(self) -> float:
        """Median period of the wheel measurements [s]; zero without wheels."""
        if self.is_drive_alone:
            return float(np.median(np.diff(self.track.times)))
        return 0.0 if self.wheels is None else float(np.median(np.diff(self.wheels.times)))

    def correct_vehicle(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle with the track multiplier of the controller in this recording."""
        return msgspec.structs.replace(vehicle, controller_track_multiplier=self.alignment.track_multiplier)


def load_run(
    tables: Mapping[str, pl.DataFrame], vehicle: Vehicle, *, name: str, sha256: str = ""
) -> MotionRun:
    """Make a run from its aligned tables.

    Args:
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, `findings`, and `slip` (for steps and
            stretches without a live command); those that the log lacks may be missing or empty.
        vehicle: geometry.
        name: of the run.
        sha256: of the recording.

    Raises:
        MotionError: ``not_aligned``, there is no table `alignments`; ``no_poses``, fewer than ten poses carry
            information.
    """
    table = tables.get("alignments")
    if table is None or table.is_empty():
        what = "the results have no table alignments"
        raise MotionError("not_aligned", what, where=name, hint="Analyze the log again with --force.")
    alignment = read_alignment(table)
    commands, wheels = (
        _read_drive(tables.get("commands"), vehicle),
        read_wheels(tables.get("wheels"), vehicle),
    )
    track = read_track(tables["poses"], wheels, name=name)
    gyro = read_gyro(tables.get("imu"), alignment.gyro)
    stamps = [tables["poses"]["t"].to_numpy(), *(d.times for d in (commands, wheels) if d is not None)]
    streams = np.unique(np.concatenate(stamps))
    if commands is not None and alignment.hold_s is not None:
        commands = _stop_when_silent(commands, alignment.hold_s)
    commands = _take_followed(commands, tables.get("commands"))
    steps, excluded = _read_steps(tables.get("slip"), streams)
    begin, end = _find_driving(tables.get("slip"), streams)
    terrains = tables["poses"]["terrain"] if "terrain" in tables["poses"].columns else None
    return MotionRun(
        name=name,
        sha256=sha256,
        terrain=str(terrains[0]) if terrains is not None else "unknown",
        commands=commands,
        wheels=wheels,
        gyro=gyro,
        track=track,
        streams=streams,
        step_starts=steps,
        excluded=excluded,
        duration_s=end - begin,
        alignment=alignment,
        repeats_s=_measure_repeats(tables["poses"]),
        is_on_course=_has_finding(tables.get("findings"), "heading_from_course"),
        is_drive_alone=_has_finding(tables.get("findings"), GROUND_UNOBSERVABLE),
        in_bursts=_has_finding(tables.get("findings"), IN_BURSTS),
        contradicted=_list_contradicted(tables.get("findings")),
        lead_s=begin - float(streams[0]),
    )


def _list_contradicted(findings: pl.DataFrame | None) -> frozenset[str]:
    """The vehicle's dimensions that findings name as contradicted."""
    texts = [] if findings is None or findings.is_empty() else findings["values"].to_list()
    values = [json.loads(text) for text in texts if text and "dimensions" in text]
    return frozenset(name for one in values for name in one.get("dimensions", ()))


def _has_finding(findings: pl.DataFrame | None, name: str) -> bool:
    return findings is not None and not findings.is_empty() and name in findings["id"]


_ALIGNED = (
    *("hold_time", "command_scale", "command_turn_scale", "track_multiplier"),
    *("wheel_delay", "latency_spread", "outlier_time"),
)
"""Columns of table `alignments` that are the first attributes of `Alignment`, in their order."""


def read_alignment(table: pl.DataFrame) -> Alignment:
    """The only row of table `alignments`."""
    row = table.row(0, named=True)
    gyro = None
    if row["gyro_scale"] is not None:
        fitted = row["gyro_scale"], row["gyro_bias"]
        gyro = GyroFit(
            *fitted, 0.0, row["heading_delay_error"], row["gyro_residual"], row.get("gyro_delay") or 0.0
        )
    # Tables of before have no scale of the difference: it was that of the whole.
    row = {"command_turn_scale": row["command_scale"], **row}
    first = Alignment(*(row[name] for name in _ALIGNED))
    return replace(
        first,
        gyro=gyro,
        heading_delay_s=row["heading_delay"] or 0.0,
        body_multiplier=row.get("body_multiplier"),
    )


def tabulate_alignment(alignment: Alignment) -> pl.DataFrame:
    """Table `alignments` of one run, without the columns of the run."""
    from schemas import tabulate  # noqa: PLC0415 - only where tables are written

    firsts = fields(alignment)[: len(_ALIGNED)]
    row = {
        **{name: getattr(alignment, one.name) for name, one in zip(_ALIGNED, firsts, strict=True)},
        "body_multiplier": alignment.body_multiplier,
    }
    fit = alignment.gyro
    if fit is not None and np.isfinite(fit.delay_error_s):
        row |= {
            "gyro_scale": fit.signed_scale,
            "gyro_bias": fit.bias,
            "heading_delay": alignment.heading_delay_s,
            "heading_delay_error": fit.delay_error_s,
            "gyro_residual": fit.residual,
            "gyro_delay": fit.moved_s,
        }
    return tabulate("alignments", [row])


def read_track(poses: pl.DataFrame, wheels: DriveSeries | None, *, name: str) -> Track:
    """Poses of table `poses` with new information, in the plane of motion.

    Args:
        poses: with the column `latency` at the times to which they belong, else at their stamps.
        wheels: measured wheels, which tell a localization that waits from a vehicle at rest.
        name: of the run, for error messages.

    Raises:
        MotionError: ``no_poses``.
    """
    parts: list[Track] = []
    for piece in rigid.cut_segments(poses):
        fresh = select_fresh(piece, wheels)
        fresh = fresh[np.diff(piece["t"][fresh], prepend=-np.inf) > 0.0]
        if fresh.size > 1:
            fresh_columns = {column: values[fresh] for column, values in piece.items()}
            parts.append(_unroll(fresh_columns, parts[-1] if parts else None))
    if sum(part.times.size for part in parts) < 10:  # noqa: PLR2004 - fewer say nothing
        hint = "Check the pose topic with `slip inspect`."
        raise MotionError("no_poses", "fewer than ten poses carry information", where=name, hint=hint)
    return Track(
        *(np.concatenate([getattr(part, field) for part in parts]) for field in Track.__dataclass_fields__)
    )


def select_fresh(piece: Mapping[str, NDArray[Any]], wheels: DriveSeries | None) -> Ints:
    """Indices of a segment's poses that carry information; no repeats while measured wheels turn."""
    fresh = rigid.select_fresh_poses(times := piece["t"], held := piece["held"])
    if wheels is not None:
        turned = np.append(0, np.cumsum(find_fastest_wheel(wheels) > _ROLLS))
        fresh = fresh[~_find_waits(times, held, wheels.times, turned)[fresh]]
    return fresh


def _find_waits(times: Floats, held: Flags, wheel_times: Floats, turned: Ints) -> Flags:
    """Short repeats of a pose while wheels turn: a localization that waits.

    Args:
        times: stamps of a segment's poses [s], shape (n,).
        held: whether each pose repeats the previous one, shape (n,).
        wheel_times: stamps of measured wheels [s], shape (m,).
        turned: number of samples with turning wheels before each stamp, and in total, shape (m + 1,).
    """
    waits = np.zeros(times.size, dtype=bool)
    first, end = np.array(rigid.find_runs(held), dtype=np.int64).reshape(-1, 2).T
    low, high = np.searchsorted(wheel_times, (times[np.maximum(first - 1, 0)], times[end - 1]))
    mostly = 2 * (turned[high] - turned[low]) > high - low
    waits[held] = np.repeat(mostly & (times[end - 1] - times[first] <= rigid.LONGEST_WAIT_S), end - first)
    return waits


def _measure_repeats(poses: pl.DataFrame) -> float:
    """Period of the stamps of table `poses` [s] if many of them repeat the pose before; else zero."""
    held = poses["held"].mean()
    repeated = isinstance(held, float) and held > _REPEATED_SHARE
    return float(np.median(np.diff(poses["t"].to_numpy()))) if repeated else 0.0


def _unroll(piece: Mapping[str, NDArray[Any]], before: Track | None) -> Track:
    """Poses of one segment in the plane of motion; headings continue from the previous segment.

    Headings are shifted by full turns, so that consecutive segments differ by less than one.
    """
    position, quaternion = piece["position"], piece["quaternion"]
    roll, pitch, yaw = rigid.euler_from_quaternions(quaternion)
    if before is not None:
        yaw = yaw + 2.0 * np.pi * np.round((before.heading[-1] - yaw[0]) / (2.0 * np.pi))
    turn = rigid.measure_increments(position, quaternion)[1]
    middle = rigid.slerp(quaternion[:-1], quaternion[1:], np.full(turn.shape[0], 0.5))
    moved = rigid.rotate(rigid.invert_quaternions(middle), np.diff(position, axis=0))
    heading = yaw[0] + np.concatenate(([0.0], np.cumsum(turn[:, 2])))
    along = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(0.5j * (heading[:-1] + heading[1:]))
    path = position[0, 0] + 1j * position[0, 1] + np.concatenate(([0.0], np.cumsum(along)))
    return Track(
        times=piece["t"] - piece["latency"] if "latency" in piece else piece["t"],
        segment=piece["segment"].astype(np.int64),
        path=path,
        heading=heading,
        attitude=np.column_stack((roll, pitch, np.unwrap(yaw))),
        position=position[:, :2],
        active=piece["active"],
    )


def _take_followed(commands: DriveSeries | None, table: pl.DataFrame | None) -> DriveSeries | None:
    """The commands without those that the drive did not follow yet: what it followed before is held."""
    if commands is None or table is None or "followed" not in table.columns:
        return commands
    mask = ~np.isin(commands.times, table.filter(~table["followed"])["t"].to_numpy())
    return commands.change(commands.times[mask], lambda signal: signal[mask])


def read_wheel_times(table: pl.DataFrame) -> Floats:
    """Times of the rows of a table [s]: its stamps minus their delay, if known."""
    times = table["t"].to_numpy()
    return times - table["latency"].to_numpy() if "latency" in table.columns else times


def read_wheels(table: pl.DataFrame | None, vehicle: Vehicle) -> DriveSeries | None:
    """Measured wheels of table `wheels`; None where there are none, or if they never move."""
    wheels = _read_drive(table, vehicle)
    return None if wheels is None or find_fastest_wheel(wheels).max() < _DEAD else wheels


def _read_drive(table: pl.DataFrame | None, vehicle: Vehicle) -> DriveSeries | None:
    """Commands or measured wheels; None where there are none."""
    if table is None or table.is_empty():
        return None
    times = read_wheel_times(table)

    def read(name: str) -> Floats:
        aligned = f"{name}_aligned"
        return table[aligned if aligned in table.columns else name].to_numpy()

    if vehicle.kinematics.has_inputs("speed", "steering"):
        axle = read("speed") / vehicle.wheel_radius_m
        left, right, steering = axle, axle, read("steering")
    else:
        left, right, steering = read("left"), read("right"), np.zeros(times.size)
    sideways = read("sideways") if vehicle.kinematics.has_inputs("sideways") else None
    mask = np.isfinite(left) & np.isfinite(right) & np.isfinite(steering)
    mask &= np.concatenate((np.diff(times) > 0.0, [True]))
    if sideways is not None:
        mask &= np.isfinite(sideways)
        sideways = sideways[mask]
    if mask.sum() < 2:  # noqa: PLR2004 - one value is no series
        return None
    return DriveSeries(times[mask], left[mask], right[mask], steering[mask], sideways)


def read_gyro(imu: pl.DataFrame | None, fit: GyroFit | None = None) -> tuple[Floats, Floats] | None:
    """Times [s] and yaw rates [rad/s] of a gyro as recorded, on the clock of a fit to the poses."""
    if imu is None or imu.is_empty():
        return None
    late = 0.0 if fit is None else fit.moved_s
    return _distinct(imu["t"].to_numpy() - late, imu["rate_z"].to_numpy())


def _distinct(times: Floats, values: Floats) -> tuple[Floats, Floats]:
    mask = np.concatenate(([True], np.diff(times) > 0.0)) & np.isfinite(values)
    return times[mask], values[mask]


def _stop_when_silent(commands: DriveSeries, hold_s: float) -> DriveSeries:
    silent = np.flatnonzero(np.diff(commands.times, append=np.inf) > hold_s)
    stopped = np.insert(commands.times, silent + 1, commands.times[silent] + hold_s)
    return commands.change(stopped, lambda signal: np.insert(signal, silent + 1, 0.0))


def _read_steps(slip: pl.DataFrame | None, streams: Floats) -> tuple[Floats, Floats]:
    """Starts of steps and times of excluded samples, of the whole recording."""
    from schemas.run_tables import COUNTED  # noqa: PLC0415 - only where tables are read

    if slip is None or slip.is_empty():
        return np.zeros(0), np.zeros(0)
    leading = "command" if (slip["input"] == "command").any() else "measured"
    rows = slip.filter(slip["input"] == leading).sort("t")
    step, times = rows["step"].to_numpy(), rows["t"].to_numpy()
    starts = times[np.concatenate(([True], np.diff(step) != 0))]
    excluded = [slip.filter(~COUNTED)["t"].to_numpy(), times[[0, -1]] + (-1e-3, 1e-3)]
    # Motion without a live command has no rows: such stretches are not scored either. Commands before the
    # first one are unknown.
    ends = min(float(streams[0]), times[0]) - 0.05, max(streams[-1], times[-1]) + 0.05
    known = np.concatenate((ends[:1], times, ends[1:]))
    # Rows of any rate are next to each other.
    apart = max(0.2, 1.5 * float(np.median(np.diff(times)))) if times.size > 1 else 0.2
    holes = np.flatnonzero(np.diff(known) > apart + ROUNDING_S)
    for hole in holes.tolist():
        # Nothing is scored far from all streams either, however long they are silent.
        first, last = known[hole] + 0.05, known[hole + 1] - ROUNDING_S
        near = np.concatenate(([first], streams[(streams > first) & (streams < last)], [last]))
        silent = np.flatnonzero(np.diff(near) > 2.0 * _FAR_S)
        begins, stops = [first, *(near[silent + 1] - _FAR_S)], [*(near[silent] + _FAR_S), last]
        for begin, end in zip(begins, stops, strict=True):
            steps = np.arange(np.ceil((begin - first) / 0.05 - 1e-6), np.ceil((end - first) / 0.05))
            excluded.append(first + steps * 0.05)
    return starts, np.unique(np.concatenate(excluded))


def _find_driving(slip: pl.DataFrame | None, streams: Floats) -> tuple[float, float]:
    """Stamps [s] between which a run drives: its ends, without the time in which it stands there."""
    begin, end = float(streams[0]), float(streams[-1])
    if slip is None or slip.is_empty() or slip["standing"].all():
        return begin, end
    times, driven = slip["t"].to_numpy(), slip.filter(~slip["standing"])["t"].to_numpy()
    return (
        float(driven.min()) if driven.min() > times.min() else begin,
        float(driven.max()) if driven.max() < times.max() else end,
    )


_ALIGNED_INPUTS = tuple(f"{name}_aligned" for name in ("left", "right", "sideways", "speed"))
TABLE_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "poses": (
        *("t", "segment", "x", "y", "z", "q_x", "q_y", "q_z", "q_w"),
        *("latency", "held", "active", "terrain"),
    ),
    "alignments": (
        *("hold_time", "command_scale", "command_turn_scale", "track_multiplier", "body_multiplier"),
        *("gyro_scale", "gyro_bias", "heading_delay"),
        *("heading_delay_error", "wheel_delay", "gyro_residual", "latency_spread", "outlier_time"),
    ),
    "commands": ("t", *_ALIGNED_INPUTS, "steering", "followed"),
    "wheels": ("t", *_ALIGNED_INPUTS, "steering_aligned", "latency"),
    "imu": ("t", "rate_z"),
    "slip": ("t", "input", "step", "suspect", "standing"),
}
"""Columns of a run's tables that models need."""


def load_motion_run(manifest: Manifest, vehicle: Vehicle) -> MotionRun:
    """Load the tables of a run as arrays for models.

    Raises:
        MotionError: ``no_poses``.
    """
    tables = {name: manifest.read(name) for name in (*TABLE_COLUMNS, "findings") if name in manifest.tables}
    return make_motion_run(manifest, vehicle, tables)


def make_motion_run(manifest: Manifest, vehicle: Vehicle, tables: Mapping[str, pl.DataFrame]) -> MotionRun:
    """As `load_motion_run`, from tables already in memory, or from a stretch of each.

    Args:
        manifest: the run.
        vehicle: geometry.
        tables: tables by name, with at least the columns of `TABLE_COLUMNS`.

    Raises:
        MotionError: ``no_poses``.
    """
    if "poses" not in tables:
        hint = "Check the pose topic with `slip inspect`."
        raise MotionError(
            "no_poses", "the run has no poses to compare a model with", where=manifest.run, hint=hint
        )
    sha256 = str(manifest.part("log").get("sha256", ""))
    return load_run(tables, vehicle, name=manifest.run, sha256=sha256)
