"""Topics as platforms publish them: a type and its fields, each filled from a quantity of the run."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipeline.core import rigid
from pipeline.core.arrays import Floats
from pipeline.simulate.drivetrain import apply_ideal_model, invert_ideal_model
from pipeline.simulate.facts import SimulateError, open_stream
from pipeline.simulate.messages import Field, Sheet, SimulatedRun
from pipeline.simulate.programs import integrate_cells, make_wishes, walk_in_plane

ORIGIN_DEG = (46.78, -71.27)
_ALTITUDE_M = 90.0
_A_M = 6378137.0
_B_M = 6356752.314245
_ROUNDS = 6


def to_earth(position: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude and longitude [deg] and altitude over the ellipsoid [m], each (n,), of places (n, 3) [m].

    Args:
        position: east, north and up of the origin.
    """
    lat, lon = np.radians(ORIGIN_DEG)
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.cross(up, east)
    centre = _of_geodetic(float(lat), float(lon), _ALTITUDE_M)
    x, y, z = (centre + position @ np.stack((east, north, up))).T
    ring = np.hypot(x, y)
    squeeze = (_B_M / _A_M) ** 2
    latitude = np.arctan2(z, squeeze * ring)
    altitude = np.zeros_like(ring)
    for _ in range(_ROUNDS):
        normal = _A_M**2 / np.hypot(_A_M * np.cos(latitude), _B_M * np.sin(latitude))
        altitude = ring / np.cos(latitude) - normal
        latitude = np.arctan2(z, ring * (squeeze * normal + altitude) / (normal + altitude))
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude


def _of_geodetic(lat: float, lon: float, altitude: float) -> Floats:
    normal = _A_M**2 / np.hypot(_A_M * np.cos(lat), _B_M * np.sin(lat))
    ring = (normal + altitude) * np.cos(lat)
    height = ((_B_M / _A_M) ** 2 * normal + altitude) * np.sin(lat)
    return np.array([ring * np.cos(lon), ring * np.sin(lon), height])


Series = dict[str, Floats]
Source = Literal[
    "command",
    "wish",
    "wheels",
    "odometry",
    "filter",
    "localization",
    "satellites",
    "correction",
    "imu",
    "battery",
    "once",
]

_LATE_S = 0.002
_TURN = 2.0 * np.pi
_COMPASS_OFF_RAD = 0.7
"""An attitude is seldom against the true north."""
_DOPPLER_S = 0.05
_DOPPLER_NOISE_MPS = 0.03
_BATTERY_V, _IDLE_W, _RESISTANCE_N = 36.0, 40.0, 120.0
_ENU_IN_NED = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
_FRD_IN_FLU = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Q:
    """A quantity of the run: ``gain * quantity + offset``, cut to a whole number where one is wanted."""

    name: str
    gain: float = 1.0
    offset: float = 0.0
    whole: bool = False


@dataclass(frozen=True)
class Json:
    """A text with a JSON object of quantities by key."""

    numbers: Mapping[str, Q]


Value = Q | Json | tuple[Q, ...] | str | list[str] | float


@dataclass(frozen=True)
class Published:
    """A topic.

    Attributes:
        topic, type_name: where and what.
        source: whose times and quantities it has: ``command``; ``wheels``; ``odometry`` integrated from them,
            ``filter`` the same with the gyro's heading; ``localization``; ``satellites``, its place on Earth
            and the velocity of its sensor over ground; ``correction``, the transform from
            the localization's frame to the odometry's; ``imu``; ``battery``; ``once`` at the start;
            ``wish``, a body command that the controller never gets.
        fields: by field path a quantity, several for an array, a text of them, or a constant.
        every: one message in so many is published.
        stamp: ``header``; ``none``; or the field that holds the time, ``timestamp`` in microseconds.
    """

    topic: str
    type_name: str
    source: Source
    fields: Mapping[str, Value] = field(default_factory=dict)
    every: int = 1
    stamp: str = "header"


def publish(run: SimulatedRun, topics: tuple[Published, ...]) -> list[Sheet]:
    """Messages of every topic.

    Raises:
        SimulateError: ``encoders_needed``, a topic needs wheels or a gyro that the scenario leaves out.
    """
    known: dict[str, tuple[Floats, Floats, Series]] = {}
    sheets = []
    for one in topics:
        if one.source not in known:
            known[one.source] = _SOURCES[one.source](run)
        stamp, log, series = known[one.source]
        rows = slice(None, None, one.every)
        fields = {path: _fill(value, series, rows) for path, value in one.fields.items()}
        header = None if one.stamp == "none" else stamp[rows]
        sheets.append(Sheet(one.topic, one.type_name, log[rows], header, fields, one.stamp))
    return sheets


def _fill(value: Value, series: Series, rows: slice) -> Field:
    if isinstance(value, Json):
        columns = [_take(each, series, rows).tolist() for each in value.numbers.values()]
        return [json.dumps(dict(zip(value.numbers, row, strict=True))) for row in zip(*columns, strict=True)]
    if isinstance(value, tuple):
        return np.stack([_take(each, series, rows) for each in value], axis=1)
    return _take(value, series, rows) if isinstance(value, Q) else value


def _take(quantity: Q, series: Series, rows: slice) -> Floats:
    values = quantity.gain * series[quantity.name][rows] + quantity.offset
    return np.floor(values) if quantity.whole else values


def _of_command(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    commands, vehicle = run.commands, run.scenario.vehicle
    left, right = invert_ideal_model(vehicle, commands.speed_mps, commands.turn)
    series = {
        "speed": commands.speed_mps,
        "yaw_rate": commands.yaw_rate(vehicle),
        "steering": commands.turn,
        "left": left,
        "right": right,
        "sideways": commands.sideways,
    }
    return commands.time_s, commands.time_s + run.scenario.recording.command_latency_s, series


def _of_wish(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    wished = make_wishes(run.scenario, "wish")
    series = {"speed": wished.speed_mps, "yaw_rate": wished.turn, "sideways": wished.sideways}
    return wished.time_s, wished.time_s, series


def _of_wheels(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    wheels = run.wheels
    if wheels is None:
        raise _missing("encoders")
    speed, rate = apply_ideal_model(run.scenario.vehicle, wheels.left, wheels.right, wheels.steering)
    series = {
        name: getattr(wheels, name) for name in ("left", "right", "left_angle", "right_angle", "steering")
    }
    series |= {"speed": speed, "yaw_rate": rate, "zero": np.zeros_like(speed)}
    series["sideways"] = wheels.sideways_mps(run.scenario.vehicle)
    series |= dict(wheels.corners or {})
    series |= {f"{corner}_angle": angle for corner, angle in (wheels.corner_angles or {}).items()}
    series |= {f"{side}_turns": series[f"{side}_angle"] / _TURN for side in ("left", "right")}
    if run.imu is not None:
        # Where one message holds both.
        for name, values in (("rate", run.imu.rates), ("force", run.imu.accelerations)):
            for i, axis in enumerate("xyz"):
                series[f"{name}_{axis}"] = np.interp(wheels.time_s, run.imu.time_s, values[:, i])
    return wheels.time_s, wheels.time_s + _LATE_S, series


def _of_odometry(run: SimulatedRun, *, gyro: bool = False) -> tuple[Floats, Floats, Series]:
    stamp, log, series = _of_wheels(run)
    rate = series["yaw_rate"]
    if gyro:
        if run.imu is None:
            raise _missing("an inertial unit")
        rate = np.interp(stamp, run.imu.time_s, run.imu.rates[:, 2])
    step = float(np.median(np.diff(stamp)))
    heading = integrate_cells(rate, step_s=step)
    speed, aside = series["speed"], series["sideways"]
    position = walk_in_plane(speed, aside, heading, step_s=step)[:-1]
    named = _name(position, rigid.quaternions_from_yaw(heading[:-1]))
    return stamp, log, named | {"speed": speed, "yaw_rate": rate, "sideways": aside}


def _of_filter(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    return _of_odometry(run, gyro=True)


def _of_localization(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    position, quaternion = run.poses.in_map()
    ned = rigid.multiply_quaternions(
        np.broadcast_to(_ENU_IN_NED, quaternion.shape),
        rigid.multiply_quaternions(quaternion, np.broadcast_to(_FRD_IN_FLU, quaternion.shape)),
    )
    series = _name(position, quaternion) | {f"ned_q{axis}": ned[:, i] for i, axis in enumerate("xyzw")}
    return run.poses.stamp_s, run.poses.log_s, series


def _of_satellites(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """What a receiver says whose antenna is where the localization's sensor is."""
    poses, sensor, path = run.poses, run.scenario.pose, run.truth.path
    latitude, longitude, altitude = to_earth(poses.in_map()[0])
    arm = np.zeros(3)
    if sensor.child_frame != "base_link":
        arm = np.array([sensor.mount_x_m, sensor.mount_y_m, 0.0])
    before, after = (
        position + rigid.rotate(turn, np.broadcast_to(arm, position.shape))
        for position, turn in (
            rigid.interpolate_poses(poses.sampled_s + by, path.time_s, path.position, path.quaternion)
            for by in (-_DOPPLER_S, _DOPPLER_S)
        )
    )
    noise = open_stream(run.scenario.seed, "satellites").standard_normal((poses.stamp_s.size, 2))
    velocity = (after - before)[:, :2] / (2.0 * _DOPPLER_S) + _DOPPLER_NOISE_MPS * noise
    series = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    series |= {"east_speed": velocity[:, 0], "north_speed": velocity[:, 1], "fixed": np.zeros_like(latitude)}
    return poses.stamp_s, poses.log_s, series


def _of_correction(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """The localization over the odometry at the odometry's stamps, as a matcher of every scan gives it."""
    stamp, _, drift = _of_odometry(run)
    position, quaternion = run.poses.in_map()
    at = np.clip(stamp, run.poses.stamp_s[0], run.poses.stamp_s[-1])
    order = np.argsort(run.poses.stamp_s, kind="stable")
    there, turned = rigid.interpolate_poses(at, run.poses.stamp_s[order], position[order], quaternion[order])
    offset = np.stack([drift[axis] for axis in "xyz"], axis=1)
    turn = rigid.multiply_quaternions(
        turned, rigid.invert_quaternions(np.stack([drift[f"q{axis}"] for axis in "xyzw"], axis=1))
    )
    series = _name(there - rigid.rotate(turn, offset), turn)
    return stamp, stamp + run.scenario.pose.latency_s, series


def _of_imu(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    if run.imu is None:
        raise _missing("an inertial unit")
    series = {f"rate_{axis}": run.imu.rates[:, i] for i, axis in enumerate("xyz")}
    series |= {f"force_{axis}": run.imu.accelerations[:, i] for i, axis in enumerate("xyz")}
    path = run.truth.path
    _, turn = rigid.interpolate_poses(run.imu.time_s, path.time_s, path.position, path.quaternion)
    start = np.broadcast_to(rigid.quaternions_from_yaw(np.array([_COMPASS_OFF_RAD])), turn.shape)
    turn = rigid.multiply_quaternions(start, turn)
    series |= {f"attitude_{axis}": turn[:, i] for i, axis in enumerate("xyzw")}
    return run.imu.time_s, run.imu.time_s + _LATE_S, series


def _of_battery(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    """What the wheels draw: an idle load, and rolling resistance over the speed of the rims."""
    stamp, log, series = _of_wheels(run)
    rims = run.scenario.vehicle.wheel_radius_m * (np.abs(series["left"]) + np.abs(series["right"]))
    current = -(_IDLE_W + _RESISTANCE_N * 0.5 * rims) / _BATTERY_V
    return stamp, log, {"voltage": np.full_like(current, _BATTERY_V), "current": current}


def _once(run: SimulatedRun) -> tuple[Floats, Floats, Series]:
    del run
    return np.zeros(1), np.zeros(1), {}


def _name(position: Floats, quaternion: Floats) -> Series:
    named = {axis: position[:, i] for i, axis in enumerate("xyz")}
    return named | {f"q{axis}": quaternion[:, i] for i, axis in enumerate("xyzw")}


def _missing(what: str) -> SimulateError:
    return SimulateError(
        "encoders_needed",
        f"the platform publishes {what}, and the scenario has none",
        where="platform",
        hint="Choose a case with encoders and an inertial unit",
    )


_SOURCES: dict[Source, Callable[[SimulatedRun], tuple[Floats, Floats, Series]]] = {
    "command": _of_command,
    "wish": _of_wish,
    "wheels": _of_wheels,
    "odometry": _of_odometry,
    "filter": _of_filter,
    "localization": _of_localization,
    "satellites": _of_satellites,
    "correction": _of_correction,
    "imu": _of_imu,
    "battery": _of_battery,
    "once": _once,
}
