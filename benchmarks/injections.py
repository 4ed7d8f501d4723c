"""What is injected into recordings: faults of sensors and wiring, and effects with their formulas.

Each change takes the tables of a run as they were extracted and returns changed ones. It uses numpy and
polars alone: nothing here knows how the tool looks for what is injected. The examination of a log reads what
is changed as every stage does. Faults of the wiring and of messages are written into logs (`front`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import polars as pl
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Tables = Mapping[str, pl.DataFrame]
Change = Callable[[Tables, "Drive"], Tables]
_AT_REST_S = 1.0


@dataclass(frozen=True)
class Drive:
    """Geometry of the differential drive: wheel radius and track width [m]."""

    radius_m: float
    track_m: float


@dataclass(frozen=True)
class Injection:
    """A change and what must come of it.

    Attributes:
        name: in the table.
        change: of the extracted tables.
        findings: any of them tells of the fault; empty where none is expected.
        numbers: by ``effect.parameter`` the number that must be named, from that of the unchanged recording
            (or from the neutral one); of several effects, which are one to first order, any will do.
        beside: by such a number one that multiplies it where it is named, and is part of it where it is not.
        along: numbers of further effects that the change makes: their names are no extra ones where these
            are right.
        same: the answer must stay what it was.
        both: needs the way from command to wheels.
        moved: by how much a finding's number changes that the unchanged recording has, too; None where any
            other number tells.
    """

    name: str
    change: Change
    findings: tuple[str, ...] = ()
    numbers: Mapping[str, Callable[[float], float]] = field(default_factory=dict)
    beside: Mapping[str, str] = field(default_factory=dict)
    along: Mapping[str, Callable[[float], float]] = field(default_factory=dict)
    same: bool = False
    both: bool = False
    moved: float | None = None


def list_injections() -> list[Injection]:
    """All of them."""
    shift = _add
    return [
        Injection(
            "left encoder x .95", _on("wheels", lambda t: _scale(t, left=0.95)), ("wheel_scale",),
            {"wheel_asymmetry.e": shift(-0.051)},
            # Wheels that are read slower than they turn are so to their commands, too.
            along={"side_gain.e": shift(0.051), "drive_gain.g": lambda g: 0.975 * g}, both=True,
        ),
        Injection(
            "wheels x 1.05", _on("wheels", lambda t: _scale(t, 1.05, 1.05)), ("wheel_radius_wrong",),
            {"wheel_radius.k": lambda k: k / 1.05},
        ),
        Injection(
            "commands x 1.5", _on("commands", lambda t: _scale(t, 1.5, 1.5)), ("command_scale",),
            # Wheels that reach a share of every command are that, too.
            {"drive_gain.g": lambda g: g / 1.5}, both=True,
        ),
        Injection(
            "commands .2 s early", _on("commands", lambda t: _later(t, -0.2)), ("command_delay",),
            {"transport_delay.d": shift(0.2)}, moved=0.2, both=True,
        ),
        Injection(
            "commands .8 s late", _on("commands", lambda t: _later(t, 0.8)),
            ("command_corrected", "command_late"), both=True,
        ),
        Injection("gyro negated", _on("imu", lambda t: t.with_columns(-pl.col("rate_z"))), same=True),
        Injection("map turned and moved", _map_moved, same=True),
        Injection("recorder started 12.8 s earlier", _all_later, same=True),
        Injection("poses at 5 Hz", _on("poses", _thin), same=True),
        Injection("1 cm of noise", _on("poses", _noisy), same=True),
        Injection(
            "poses .15 s late", _on("poses", lambda t: _later(t, 0.15)), (), {"clock_offset.d": shift(0.15)}
        ),
        Injection(
            "heading .1 s late", _heading_late, (),
            {"heading_skew.d": shift(0.1), "lateral_skid.c": shift(-0.1)},
        ),
        Injection("poses from the wheels", _from_wheels(0.5), ("pose_from_wheels",)),
        Injection("poses from the wheels, Euler's", _from_wheels(1.0), ("pose_from_wheels",)),
        Injection(
            "misalignment 3 deg", _misaligned, ("pose_angle",),
            {"yaw_misalignment.psi": shift(math.radians(3.0))}, moved=-math.radians(3.0),
        ),
        Injection(
            "lever arm .3 m", _lever, ("pose_lever",),
            {"icr_offset.x_icr": shift(-0.3), "lever_arm.l_x": shift(0.3)}, moved=0.3,
        ),
        Injection(
            "turning about a point .15 m ahead", _moved(lambda m: (0.0, -0.15 * m.w, 0.0)), ("pose_lever",),
            {"icr_offset.x_icr": shift(0.15), "lever_arm.l_x": shift(-0.15)}, moved=-0.15,
        ),
        Injection(
            "skid .1 s", _moved(lambda m: (0.0, -0.1 * m.v * m.w, 0.0)), (),
            {"lateral_skid.c": shift(0.1), "heading_skew.d": shift(-0.1)},
        ),
        Injection(
            "resistance .15 s", _moved(lambda m: (-0.15 * m.v * np.abs(m.w), 0.0, 0.0)), (),
            {"turning_resistance.k": shift(0.15)},
        ),
        Injection(
            "speed slip .03 s/m", _moved(lambda m: (-0.03 * m.v * np.abs(m.v), 0.0, 0.0)), (),
            {"speed_slip.k": shift(0.03)},
        ),
        Injection(
            "track x 1.2", _moved(lambda m: (0.0, 0.0, m.w / 1.2 - m.w)), (),
            # Contact friction contains a wider track.
            {"effective_track.k": lambda k: 1.2 * k, "contact_friction.k": lambda k: 1.2 * k},
        ),
        Injection(
            "track at speed +.05", _moved(lambda m: (0.0, 0.0, 0.05 * np.abs(m.v) * m.w)), (),
            {"speed_track.k": shift(0.05)},
        ),
        Injection(
            "gains .8 and .7 half-way", _moved(_half_way), (),
            {"terrain_change.k_v": lambda k: 0.8 * k, "terrain_change.k_w": lambda k: 0.7 * k},
            {"terrain_change.k_v": "wheel_radius.k"},
        ),
    ]  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """What an effect acts on, between each pose and the next or at each sample of the gyro, of shape (n,).

    Attributes:
        v: forward speed of the ideal vehicle by its measured wheels [m/s].
        w: yaw rate of poses or gyro [rad/s].
        done: share of the run that is over, of what is looked at of it.
    """

    v: Floats
    w: Floats
    done: Floats


def _add(change: float) -> Callable[[float], float]:
    return lambda value: value + change


def _on(name: str, change: Callable[[pl.DataFrame], pl.DataFrame]) -> Change:
    """A change of one table, where the run has it."""

    def changed(tables: Tables, _: Drive) -> Tables:
        has_any = name in tables and not tables[name].is_empty()
        return {**tables, name: change(tables[name])} if has_any else tables

    return changed


def _scale(table: pl.DataFrame, left: float = 1.0, right: float = 1.0) -> pl.DataFrame:
    changed = table.with_columns(pl.col("left") * left, pl.col("right") * right)
    if "body_x" not in table.columns:
        return changed
    # Only scaled alike: what the controller was told goes with what it made of it.
    return changed.with_columns(pl.col("body_x") * left, pl.col("body_w") * left)


def _later(table: pl.DataFrame, late_s: float) -> pl.DataFrame:
    nanoseconds = round(late_s * 1e9)
    return table.with_columns(pl.col("t") + late_s, pl.col("stamp") + nanoseconds)


def _all_later(tables: Tables, _: Drive) -> Tables:
    """All times count from an earlier start, no multiple of the stretches that anything is divided into."""
    return {
        name: _later(table, 12.8) if {"t", "stamp"} <= set(table.columns) else table
        for name, table in tables.items()
    }


def _thin(poses: pl.DataFrame) -> pl.DataFrame:
    """New poses no nearer to each other than a fifth of a second, and none that repeats another."""
    kept, last = [], -np.inf
    for time, held in poses.select("t", "held").iter_rows():
        kept.append(not held and time - last >= 0.199)
        last = time if kept[-1] else last
    return poses.filter(pl.Series(kept))


def _noisy(poses: pl.DataFrame) -> pl.DataFrame:
    noise = np.random.default_rng(5).normal(0.0, 0.01, (2, poses.height))
    # A pose that is repeated is repeated with its noise.
    fresh = np.maximum.accumulate(np.where(poses["held"].to_numpy(), 0, np.arange(poses.height)))
    return poses.with_columns(pl.col("x") + noise[0][fresh], pl.col("y") + noise[1][fresh])


def _read_yaw(poses: pl.DataFrame) -> Floats:
    x, y, z, w = (poses[f"q_{axis}"].to_numpy() for axis in "xyzw")
    yaw: Floats = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def _turn(poses: pl.DataFrame, angle: Floats | float, *, in_map: bool) -> pl.DataFrame:
    """Poses whose attitude is turned about the map's z axis, or about their own."""
    x, y, z, w = (poses[f"q_{axis}"].to_numpy() for axis in "xyzw")
    sine, cosine = np.sin(0.5 * np.asarray(angle)), np.cos(0.5 * np.asarray(angle))
    side = 1.0 if in_map else -1.0
    turned = {
        "q_x": cosine * x - side * sine * y,
        "q_y": cosine * y + side * sine * x,
        "q_z": cosine * z + sine * w,
        "q_w": cosine * w - sine * z,
    }
    return poses.with_columns(pl.Series(name, values) for name, values in turned.items())


def _map_moved(tables: Tables, _: Drive) -> Tables:
    poses = tables["poses"]
    place = (poses["x"].to_numpy() + 1j * poses["y"].to_numpy()) * np.exp(1.2j) + (100.0 - 50.0j)
    turned = _turn(poses, 1.2, in_map=True)
    return {**tables, "poses": turned.with_columns(pl.Series("x", place.real), pl.Series("y", place.imag))}


def _misaligned(tables: Tables, _: Drive) -> Tables:
    return {**tables, "poses": _turn(tables["poses"], math.radians(3.0), in_map=False)}


def _lever(tables: Tables, _: Drive) -> Tables:
    poses = tables["poses"]
    arm = 0.3 * np.exp(1j * _read_yaw(poses))
    moved = poses.with_columns(pl.col("x") + arm.real, pl.col("y") + arm.imag)
    return {**tables, "poses": moved}


def _heading_late(tables: Tables, _: Drive) -> Tables:
    poses = tables["poses"]
    change = np.zeros(poses.height)
    for rows in _list_segments(poses):
        times, yaw = poses["t"].to_numpy()[rows], np.unwrap(_read_yaw(poses)[rows])
        fresh = ~poses["held"].to_numpy()[rows] | (np.arange(rows.size) == 0)
        waited = times - np.maximum.accumulate(np.where(fresh, times, -np.inf))
        # A pose that a slow localization repeats is not of its own moment, one of a vehicle at rest is.
        known = fresh | (waited > _AT_REST_S)
        change[rows] = np.interp(times - 0.1, times[known], yaw[known]) - yaw
    return {**tables, "poses": _turn(poses, change, in_map=True)}


def _from_wheels(share: float) -> Change:
    """Poses that are integrated wheels under another name, looked up between their steps as tf2 does.

    Every one of them is new while the wheels turn, however slow the localization was in whose place they are.

    Args:
        share: of each turn before a step is taken: a half goes along the arc, a whole one is Euler's way.
    """

    def change(tables: Tables, drive: Drive) -> Tables:
        wheels, poses = tables["wheels"], tables["poses"]
        times = wheels["t"].to_numpy()
        left, right = (drive.radius_m * wheels[side].to_numpy() for side in ("left", "right"))
        step = np.diff(times)
        yaw = np.concatenate(([0.0], np.cumsum((right - left)[:-1] / drive.track_m * step)))
        along = (1.0 - share) * yaw[:-1] + share * yaw[1:]
        walked = 0.5 * (left + right)[:-1] * step * np.exp(1j * along)
        place = np.concatenate(([0.0], np.cumsum(walked)))
        at = poses["t"].to_numpy()
        seen = np.interp(at, times, yaw)
        none = np.zeros(at.size)
        columns = {
            "x": np.interp(at, times, place.real), "y": np.interp(at, times, place.imag), "z": none,
            "q_x": none, "q_y": none, "q_z": np.sin(0.5 * seen), "q_w": np.cos(0.5 * seen),
        }  # fmt: skip
        repeats = np.all([np.diff(values, prepend=np.nan) == 0.0 for values in columns.values()], axis=0)
        made = poses.with_columns(
            pl.Series("held", repeats), *(pl.Series(name, values) for name, values in columns.items())
        )
        return {**tables, "poses": made}

    return change


def _half_way(motion: Motion) -> tuple[Floats, float, Floats]:
    later = motion.done > 0.5
    return -0.2 * motion.v * later, 0.0, -0.3 * motion.w * later


def _moved(push: Callable[[Motion], tuple[Floats | float, Floats | float, Floats | float]]) -> Change:
    """A body velocity v_x, v_y, v_w added to the motion: poses are integrated again, the gyro follows.

    Poses and gyro are each changed by their own turning, because the latency of poses varies; the wheels'
    speed is taken as much earlier as their turning comes before that of poses, or of the gyro.
    """

    def change(tables: Tables, drive: Drive) -> Tables:
        poses, wheels = tables["poses"], tables["wheels"]
        times, yaw = poses["t"].to_numpy(), _read_yaw(poses)
        place = poses["x"].to_numpy() + 1j * poses["y"].to_numpy()
        moments, left, right = (wheels[name].to_numpy() for name in ("t", "left", "right"))
        looked_at = np.cumsum(poses["active"].to_numpy()) / poses["active"].sum()
        # Between two poses that are new: those between them repeat the one before.
        held = poses["held"].to_numpy()
        segments = [(rows, rows[~held[rows] | (np.arange(rows.size) == 0)]) for rows in _list_segments(poses)]
        spans = np.concatenate([np.column_stack((times[new][:-1], times[new][1:])) for _, new in segments])
        turns = np.concatenate([np.diff(np.unwrap(yaw[new])) for _, new in segments])
        late, _ = _match(moments, right - left, spans, turns)
        driven = 0.5 * drive.radius_m * (left + right)
        speed = np.interp(spans.mean(axis=1) - late, moments, driven)
        turned, new_place, first = np.zeros(times.size), place.copy(), 0
        for rows, fresh in segments:
            mine = slice(first, first + fresh.size - 1)
            first = mine.stop
            step, angle = np.diff(times[fresh]), np.unwrap(yaw[fresh])
            done = np.interp(spans[mine].mean(axis=1), times, looked_at)
            motion = Motion(speed[mine], turns[mine] / step, done)
            x, y, w = (np.broadcast_to(np.asarray(part, dtype=float), step.shape) for part in push(motion))
            own = np.diff(place[fresh]) * np.exp(-1j * 0.5 * (angle[1:] + angle[:-1]))
            added = np.concatenate(([0.0], np.cumsum(w * step)))
            heading = angle + added
            walked = (own + (x + 1j * y) * step) * np.exp(1j * 0.5 * (heading[1:] + heading[:-1]))
            path = place[fresh[0]] + np.concatenate(([0.0], np.cumsum(walked)))
            owner = np.searchsorted(fresh, rows, side="right") - 1
            turned[rows], new_place[rows] = added[owner], path[owner]
        moved = _turn(poses, turned, in_map=True).with_columns(
            pl.Series("x", new_place.real), pl.Series("y", new_place.imag)
        )
        if "imu" not in tables or tables["imu"].is_empty():
            return {**tables, "poses": moved}
        imu = tables["imu"]
        seen, rate = (imu[name].to_numpy() for name in ("t", "rate_z"))
        behind, sign = _match(seen, rate, spans, turns)
        speed = np.interp(seen + behind - late, moments, driven)
        more = push(Motion(speed, sign * rate, np.interp(seen + behind, times, looked_at)))[2]
        felt = rate + sign * more
        return {**tables, "poses": moved, "imu": imu.with_columns(pl.Series("rate_z", felt))}

    return change


def _match(times: Floats, rate: Floats, spans: Floats, turns: Floats) -> tuple[float, float]:
    """How much later than a yaw rate the turning of poses is stamped [s], and the rate's sign in it.

    Args:
        times, rate: of wheels or gyro, shape (m,); any multiple of the yaw rate will do.
        spans: stamps of each pose and the next, shape (n, 2).
        turns: by which the heading differs between them, shape (n,).
    """
    angle = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(times))))
    step = np.diff(spans)[:, 0]
    wanted = np.clip(turns / step, -3.0, 3.0)
    lags = np.arange(-0.2, 1.2, 0.01)
    alike = [
        np.corrcoef(np.diff(np.interp(spans - lag, times, angle))[:, 0] / step, wanted)[0, 1] for lag in lags
    ]
    best = int(np.argmax(np.abs(alike)))
    return float(lags[best]), float(np.sign(alike[best]))


def _list_segments(poses: pl.DataFrame) -> list[NDArray[np.int64]]:
    segment = poses["segment"].to_numpy()
    return [np.flatnonzero(segment == number) for number in np.unique(segment)]
