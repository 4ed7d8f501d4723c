"""Poses out of satellite navigation: fixes on a local plane, or velocities over ground.

A receiver says where its antenna is and perhaps how fast it goes, never where the vehicle looks: that comes
from its course and from what turns with the vehicle (see `course`).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pipeline.core import rigid, timegrid
from pipeline.core.arrays import Flags, Floats, Ints
from pipeline.logs import TopicColumns
from pipeline.stages.extract import reading
from pipeline.stages.extract.course import (
    Turning,
    find_heading,
    follow_track,
    follow_velocity,
    read_over_ground,
)
from pipeline.stages.extract.reading import PoseArrays
from pipeline.stages.finding import Finding
from pipeline.vehicles.message_types import find_type

_SEMI_MAJOR_M: Final = 6378137.0
_FLATTENING: Final = 1.0 / 298.257223563
_ECCENTRICITY_2: Final = _FLATTENING * (2.0 - _FLATTENING)
_FEWEST: Final = 20
_UNIT: Final = 0.1
_ABOUT_S: Final = 0.5
_MOVES_M: Final = 0.05
_PARENT: Final = "enu"
_CHILD: Final = "base_link"


def to_local_plane(latitude: Floats, longitude: Floats, altitude: Floats) -> Floats:
    """Positions east, north and up of the first one [m], shape (n, 3).

    WGS84 to the tangent plane: Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS, 2008, sections 8.2 and 8.3.

    Args:
        latitude: [deg], shape (n,).
        longitude: [deg], shape (n,).
        altitude: over the ellipsoid [m], shape (n,); what is not known is taken to be level.
    """
    if not latitude.size:
        return np.zeros((0, 3))
    level = float(np.nanmedian(altitude)) if np.isfinite(altitude).any() else 0.0
    height = np.where(np.isfinite(altitude), altitude, level)
    phi, lam = np.radians(latitude), np.radians(longitude)
    curvature = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_2 * np.sin(phi) ** 2)
    ring = (curvature + height) * np.cos(phi)
    earth = np.stack(
        (
            ring * np.cos(lam),
            ring * np.sin(lam),
            (curvature * (1.0 - _ECCENTRICITY_2) + height) * np.sin(phi),
        ),
        axis=-1,
    )
    (sp, cp), (sl, cl) = ((float(np.sin(angle[0])), float(np.cos(angle[0]))) for angle in (phi, lam))
    plane = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
    local: Floats = (earth - earth[0]) @ plane.T
    return local


@dataclass(frozen=True)
class Receiver:
    """A topic with its clock.

    Attributes:
        columns: as recorded.
        times: of all of its messages [s], shape (n,).
        order: those that count, in time.
    """

    columns: TopicColumns
    times: Floats
    order: Ints


@dataclass(frozen=True)
class Located:
    """Poses of the vehicle.

    Attributes:
        rows: messages that give one, in time, shape (m,).
        arrays: poses of base_link, shape (m,).
        findings: what was noticed.
    """

    rows: Ints
    arrays: PoseArrays
    findings: tuple[Finding, ...]


def locate_vehicle(
    receiver: Receiver,
    beside: Receiver | None,
    imu: Receiver | None,
    ahead: tuple[Floats, Floats] | None,
    lever: Floats,
) -> Located:
    """Poses of base_link from a receiver of satellites.

    Args:
        receiver: fixes, or velocities over ground where there are none.
        beside: velocities that belong to the fixes.
        imu: gyro, and attitude where it gives one.
        ahead: times [s] and speed ahead [m/s] of the wheels or the command.
        lever: place of the antenna in base_link [m], shape (3,).
    """
    topic = receiver.columns.topic
    track = _read_track(receiver)
    findings = list(track.findings)
    if track.rows.size < _FEWEST:
        nothing = PoseArrays(np.zeros((0, 3)), np.zeros((0, 4)), _PARENT, _CHILD)
        return Located(track.rows[:0], nothing, track.findings)
    times = receiver.times[track.rows]
    if track.velocity is not None:
        course = follow_velocity(times, track.velocity, ahead)
    else:
        clock, moved = (np.zeros(0), np.zeros((0, 2))) if beside is None else _take_distinct(beside)
        over_ground = read_over_ground(times, track.position, clock, moved)
        if over_ground is not None:
            course = follow_velocity(clock, over_ground, ahead)
        else:
            course = follow_track(times, track.position, ahead)
        if beside is not None and over_ground is None:
            text = f"{beside.columns.topic} does not say how {topic} moves over ground: it was not used"
            findings.append(Finding("velocity_disagrees", "warning", text, where=beside.columns.topic))
    if ahead is None:
        text = f"neither wheels nor a command say when the vehicle of {topic} drove backwards: it never did"
        findings.append(Finding("direction_assumed", "warning", text, where=topic))
    heading = find_heading(times, course, [] if imu is None else _list_turnings(imu), lever[:2], topic)
    kept = np.isfinite(heading.yaw)
    quaternion = rigid.quaternions_from_yaw(heading.yaw[kept])
    arm = rigid.rotate(quaternion, np.broadcast_to(lever, (quaternion.shape[0], 3)))
    arrays = PoseArrays(track.position[kept] - arm, quaternion, _PARENT, _CHILD)
    return Located(track.rows[kept], arrays, (*findings, heading.finding))


@dataclass(frozen=True)
class _Track:
    """Where the antenna was [m], shape (n, 3), by which messages, and how fast it went if they say it."""

    rows: Ints
    position: Floats
    velocity: Floats | None = None
    findings: tuple[Finding, ...] = ()


def _read_track(receiver: Receiver) -> _Track:
    """Fixes on a local plane; velocities over ground, summed up."""
    columns, rows = receiver.columns, receiver.order
    if find_type(columns.type_name).fix is None:
        velocity = reading.read_ground_velocity(columns)[rows]
        known = np.isfinite(velocity).all(axis=1)
        rows, velocity = rows[known], velocity[known]
        ways = [timegrid.integrate_rate(receiver.times[rows], velocity[:, axis]) for axis in (0, 1)]
        return _Track(rows, np.stack((*ways, np.zeros(rows.size)), axis=-1), velocity)
    latitude, longitude, altitude, fixed = reading.read_fixes(columns)
    good = rows[fixed[rows]]
    position = to_local_plane(latitude[good], longitude[good], altitude[good])
    lost = rows.size - good.size
    new = _is_new(receiver.times[good], position)
    good, position = good[new], position[new]
    if not lost:
        return _Track(good, position)
    text = f"{lost} messages of {columns.topic} are no fix (a status below 0, or no place): left out"
    finding = Finding("no_fix", "warning", text, where=columns.topic, count=lost)
    return _Track(good, position, findings=(finding,))


def _take_distinct(receiver: Receiver) -> tuple[Floats, Floats]:
    """Times and velocities of messages that do not share their stamp, numbers all."""
    velocity = reading.read_ground_velocity(receiver.columns)[receiver.order]
    times = receiver.times[receiver.order]
    kept = np.isfinite(velocity).all(axis=1) & np.concatenate(([True], np.diff(times) > 0.0))
    return times[kept], velocity[kept]


def _list_turnings(imu: Receiver) -> list[Turning]:
    """What of an IMU turns with the vehicle."""
    times = imu.times[imu.order]
    if times.size < _FEWEST:
        return []
    rates, _ = reading.read_imu(imu.columns)
    rate = np.nan_to_num(rates[imu.order, 2])
    found = [Turning(f"the gyro of {imu.columns.topic}", times, timegrid.integrate_rate(times, rate))]
    attitude = reading.read_attitude(imu.columns)
    if attitude is not None:
        attitude = attitude[imu.order]
        known = np.isfinite(attitude).all(axis=1) & (np.abs(np.linalg.norm(attitude, axis=1) - 1.0) < _UNIT)
        if known.sum() >= _FEWEST:
            yaw = np.unwrap(rigid.euler_from_quaternions(attitude[known])[2])
            found.append(Turning(f"the orientation of {imu.columns.topic}", times[known], yaw))
    return found


def _is_new(times: Floats, position: Floats) -> Flags:
    """Whether a position is no repeat: one that comes again while the antenna moves is of a slow receiver."""
    if times.size < 2:  # noqa: PLR2004 - one position is new
        return np.ones(times.size, dtype=bool)
    way = [timegrid.interpolate_linearly(times + by, times, position[:, :2]) for by in (-_ABOUT_S, _ABOUT_S)]
    moves = np.linalg.norm(way[1] - way[0], axis=1) > _MOVES_M
    again = np.concatenate(([False], np.all(np.diff(position, axis=0) == 0.0, axis=1)))
    new: Flags = ~(again & moves)
    return new
