"""Poses from satellite navigation, with the heading estimated from the course over ground.

A receiver gives the position of its antenna and possibly its velocity, but no heading: the heading comes from
the course and from sensors that turn with the vehicle (see `Course`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Flags, Floats, Ints, arrays, fit_robustly, rigid, robust_spread
from pipeline.recording import topic_values
from pipeline.recording.findings import Finding
from pipeline.recording.topic_values import FEWEST_MESSAGES, Located, PoseArrays, Receiver
from pipeline.run import MOVING_MPS, STILL_MPS
from pipeline.sources import find_type

# Heading of a vehicle from its course over ground, and possibly from a sensor that turns with it.
#
# A sensor that turns with the vehicle (an IMU's orientation, a gyro) gives the heading up to an offset, which
# the course over ground determines over a minute. Without such a sensor the course is the heading: it is
# unknown at standstill and does not show sideways slip.

T = TypeVar("T", np.float64, np.complex128)

_WINDOW_S: Final = 1.0
"""Span [s] over which velocities are derived from positions, and turning is compared."""
_NOISES: Final = 5.0
"""Least speed of a valid course [its standard deviations]: the course is then accurate to 0.2 rad."""
_FEWEST_STEPS: Final = 3  # of a course: one of two points is noise, and three leave no residual
_AROUND_S: Final = (-1.0, -0.5, 0.0, 0.5)
"""Times [s] about a course at which the drive's direction must be equal: a drive lags behind its command."""
_ALIGN_S: Final = 30.0
"""Half the span [s] over which a sensor is aligned with the course: a fix's noise averages out, and a gyro's
drift is linear."""
_SCALES: Final = (0.7, 1.4)  # of a sensor over a course: a third off is another axis or unit
_GYRO_SCALE: Final = 0.1
"""Largest scale error of a gyro (data sheets of MEMS state 1 to 3 %); that of a course is larger."""
_LEAST_TURNING: Final = 0.03  # rms [rad] of the course's change per second, below which no sensor is aligned
_MOST_REST: Final = 0.5
"""Fraction of the course's turning that a sensor may leave unexplained; above it, it is on another body."""
_ROUNDS: Final = 5  # of alternating two linear problems: a skid and an offset
_AGREES: Final = 0.5
"""Fraction of the positions' displacement that velocities over ground may leave unexplained."""


@dataclass(frozen=True)
class Turning:
    """A sensor that turns with the vehicle.

    Attributes:
        name: description for messages.
        times: [s], increasing, shape (n,).
        angle: rotation since the first sample, of any sign and scale [rad], shape (n,).
    """

    name: str
    times: Floats
    angle: Floats


@dataclass(frozen=True)
class Course:
    """Motion of the antenna.

    Attributes:
        times: [s], strictly increasing, shape (n,).
        velocity: east and north [m/s], shape (n, 2).
        direction: 1 where the vehicle drives ahead, -1 backwards, 0 where unknown, shape (n,).
        slowest: speed below which the direction of motion is noise [m/s].
        window_s: span over which it is smoothed [s]; zero of velocities that a receiver gives.
    """

    times: Floats
    velocity: Floats
    direction: Floats
    slowest: float
    window_s: float = 0.0

    def angles(self) -> tuple[Floats, Flags]:
        """Heading of a vehicle without sideways slip [rad], and where it is known."""
        east, north = self.velocity.T
        known: Flags = (np.hypot(east, north) > self.slowest) & (self.direction != 0.0)
        return np.arctan2(north, east) + np.where(self.direction < 0.0, np.pi, 0.0), known


@dataclass(frozen=True)
class Heading:
    """Headings at the positions [rad], NaN where unknown, and the finding on them."""

    yaw: Floats
    finding: Finding


def follow_track(
    times: Floats, position: Floats, ahead: tuple[Floats, Floats] | None, window_s: float = _WINDOW_S
) -> Course:
    """The course from positions.

    Args:
        times: [s], strictly increasing, shape (n,), n >= 2.
        position: [m], shape (n, 3).
        ahead: times [s] and forward speed [m/s] of the wheels or the command.
        window_s: span over which it is derived [s].
    """
    velocity = arrays.differentiate_locally(times, times, position[:, :2], window_s)
    count = max(arrays.count_steps(times, window_s), 4)
    noise = estimate_noise(position[:, :2]) * np.sqrt(12.0 / count) / window_s
    slowest = max(MOVING_MPS, _NOISES * noise)
    return Course(times, velocity, _find_direction(times, ahead), slowest, window_s)


def follow_closely(whole: Course, position: Floats, ahead: tuple[Floats, Floats] | None) -> Course:
    """The course over the shortest span that leaves it known in most of the driving; see `follow_track`.

    Where the course is the heading itself, a span smooths turns, and a lesser turn is an effect.

    Args:
        whole: the course over the usual span.
        position: as of `follow_track`.
        ahead: as of `follow_track`.
    """
    times = whole.times
    speed = np.linalg.norm(whole.velocity, axis=1)
    usual = float(np.median(speed[speed > whole.slowest])) if (speed > whole.slowest).any() else 0.0
    period = float(np.median(np.diff(times)))
    for steps in range(_FEWEST_STEPS, int(_WINDOW_S / period)):
        course = follow_track(times, position, ahead, steps * period)
        if course.slowest < 0.5 * usual:
            return course
    return whole


def follow_velocity(times: Floats, velocity: Floats, ahead: tuple[Floats, Floats] | None) -> Course:
    """The course from velocities over ground [m/s], shape (n, 2); else as `follow_track`."""
    slowest = max(MOVING_MPS, _NOISES * estimate_noise(velocity))
    return Course(times, velocity, _find_direction(times, ahead), slowest)


def estimate_noise(series: Floats) -> float:
    """Standard deviation of the white noise in a series (n, 2), by its second differences."""
    if series.shape[0] < 3:  # noqa: PLR2004 - a second difference needs three
        return 0.0
    return float(np.median(np.abs(np.diff(series, n=2, axis=0))) / (0.6745 * np.sqrt(6.0)))


def _find_direction(times: Floats, ahead: tuple[Floats, Floats] | None) -> Floats:
    """Driving direction about each time: ahead (1), backwards (-1), or ambiguous (0)."""
    if ahead is None:
        return np.ones(times.size)
    clock, speed = ahead
    signs = np.where(np.abs(speed) > STILL_MPS, np.sign(speed), 0.0)
    held = [signs[np.maximum(np.searchsorted(clock, times + by, side="right") - 1, 0)] for by in _AROUND_S]
    same = np.all(np.stack(held) == held[0], axis=0)
    return np.where(same, held[0], 0.0)


def read_over_ground(times: Floats, position: Floats, clock: Floats, velocity: Floats) -> Floats | None:
    """Velocities east and north [m/s], shape (m, 2); None if they contradict the positions.

    Some drivers publish north before east; some publish velocities of the body.

    Args:
        times: of the positions [s], shape (n,).
        position: east, north, up [m], shape (n, 3).
        clock: of the velocities [s], shape (m,).
        velocity: as published [m/s], shape (m, 2).
    """
    inside = (clock > times[0]) & (clock < times[-1])
    if inside.sum() < topic_values.FEWEST_MESSAGES:
        return None
    moved = arrays.differentiate_locally(clock[inside], times, position[:, :2], _WINDOW_S)
    size = float(np.sqrt(np.mean(moved**2)))
    rests = [
        float(np.sqrt(np.median(np.sum((order[inside] - moved) ** 2, axis=1))))
        for order in (velocity, velocity[:, ::-1])
    ]
    if not min(rests) < _AGREES * size:
        return None
    return velocity if rests[0] <= rests[1] else velocity[:, ::-1]


def find_heading(
    times: Floats,
    course: Course,
    turnings: Sequence[Turning],
    lever: Floats,
    topic: str,
    follow_alone: Callable[[], Course] | None = None,
) -> Heading:
    """The heading at some times.

    Args:
        times: [s], shape (n,).
        course: motion of the antenna.
        turnings: sensors, the best first.
        lever: position of the antenna on the vehicle, ahead and left [m], shape (2,).
        topic: for the finding.
        follow_alone: finds the course to take where no sensor turns with the vehicle, if it is another.
    """
    fits = [(turning, fit) for turning in turnings if (fit := _fit_sensor(turning, course)) is not None]
    if not fits:
        return _take_course(times, course if follow_alone is None else follow_alone(), topic)
    turning, (scale, bias, _) = min(fits, key=lambda one: one[1][2])

    def turned(at: Floats) -> Floats:
        return scale * np.interp(at, turning.times, turning.angle) + bias * at

    if lever.any():
        # In a turn the antenna's direction of motion differs from that of the vehicle's centre.
        arm = np.exp(1j * _put_on_course(course.times, turned, course)) * complex(*lever)
        swing = 1j * arm * _turn_rate(turned, course.times)
        middle = course.velocity - np.stack((swing.real, swing.imag), axis=-1)
        course = replace(course, velocity=middle)
    yaw = _put_on_course(times, turned, course)
    silent = np.abs(turning.times[arrays.nearest_indices(times, turning.times)] - times) > arrays.SILENT_S
    yaw[silent] = np.nan
    values = {"value": float(silent.mean()), "sensor": turning.name}
    return Heading(yaw, Finding("heading_from_imu", "info", topic, values))


def _fit_sensor(turning: Turning, course: Course) -> tuple[float, float, float] | None:
    """Scale, bias [rad/s] and residual [rad] of a sensor against the course; None if they disagree.

    No delay of the course is estimated: outward skid in turns would appear as one.
    """
    angle, known = course.angles()
    steps = arrays.count_steps(course.times, _WINDOW_S)
    first = np.flatnonzero(known[:-steps] & known[steps:])
    start, end = course.times[first], course.times[first + steps]
    inside = (start > turning.times[0]) & (end < turning.times[-1]) & (end - start < 2.0 * _WINDOW_S)
    first, start, end = first[inside], start[inside], end[inside]
    if first.size < topic_values.FEWEST_MESSAGES:
        return None
    turned = rigid.wrap_angle(angle[first + steps] - angle[first])
    size = float(np.sqrt(np.mean(turned**2)))
    moved = np.diff(np.interp(np.stack((start, end)), turning.times, turning.angle), axis=0)[0]
    made = fit_robustly(np.column_stack((moved, end - start)), turned, measure=robust_spread)
    (scale, bias), rest = made.gains.tolist(), made.scale
    if abs(abs(scale) - 1.0) < _GYRO_SCALE:
        # The course also contains the skid: its estimate of a gyro's scale is no better than the nominal one.
        scale = float(np.copysign(1.0, scale))
        bias = float(np.median((turned - scale * moved) / (end - start)))
    if size < _LEAST_TURNING or rest > _MOST_REST * size or not _SCALES[0] < abs(scale) < _SCALES[1]:
        return None
    return scale, bias, rest


def _put_on_course(times: Floats, turned: Callable[[Floats], Floats], course: Course) -> Floats:
    """A sensor's angle with the offset that aligns it with the course, by a mean over a minute.

    The part of the course proportional to the yaw rate is fitted jointly, so that it does not bias the mean:
    outward skid, an antenna ahead of the centre, a late receiver.

    Args:
        times: times at which the heading is evaluated [s].
        turned: the sensor's angle [rad] at any times.
        course: of the antenna.
    """
    angle, known = course.angles()
    clock = course.times[known]
    # The accuracy of a course increases with the speed.
    weight = np.sum(course.velocity[known] ** 2, axis=1)
    off = angle[known] - turned(clock)
    rate = _turn_rate(turned, clock)
    low, high = (np.searchsorted(clock, clock + by * _ALIGN_S) for by in (-1.0, 1.0))

    def add_up(series: NDArray[T]) -> NDArray[T]:
        total = np.concatenate((np.zeros(1), np.cumsum(weight * series)))
        inside: NDArray[T] = total[high] - total[low]
        return inside

    varying: Floats = rate - add_up(rate) / add_up(np.ones_like(rate))
    skid, offset = 0.0, np.zeros_like(rate)
    for _ in range(_ROUNDS):
        offset = np.angle(add_up(np.exp(1j * (off - skid * rate))))
        rest = rigid.wrap_angle(off - skid * rate - offset)
        skid += float(np.sum(weight * rest * varying)) / max(float(np.sum(weight * varying**2)), 1e-12)
    return turned(times) + np.interp(times, clock, np.unwrap(offset))


def _turn_rate(turned: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Yaw rate over the window of a course [rad/s]."""
    half = 0.5 * _WINDOW_S
    return (turned(at + half) - turned(at - half)) / _WINDOW_S


def _take_course(times: Floats, course: Course, topic: str) -> Heading:
    """The course as the heading."""
    angle, known = course.angles()
    clock = course.times[known]
    yaw = np.full(times.size, np.nan)
    if clock.size > 1:
        near = clock[arrays.nearest_indices(times, clock)]
        period = float(np.median(np.diff(course.times)))
        yaw = np.where(
            np.abs(near - times) < 1.5 * period, np.interp(times, clock, np.unwrap(angle[known])), np.nan
        )
    share = float(np.mean(~np.isfinite(yaw)))
    values = {"value": share, "window_s": course.window_s}
    return Heading(yaw, Finding("heading_from_course", "warning", topic, values))


_SEMI_MAJOR_M: Final = 6378137.0  # WGS 84
_FLATTENING: Final = 1.0 / 298.257223563  # WGS 84
_ECCENTRICITY_2: Final = _FLATTENING * (2.0 - _FLATTENING)  # WGS 84
_UNIT: Final = 0.1  # deviation of an orientation's length from one: a sensor without orientation gives zeros
_MOVES_M: Final = 0.05  # [m] per second: an antenna below it is at rest and may repeat its position
_PARENT: Final = "enu"
_CHILD: Final = "base_link"


def to_local_plane(latitude: Floats, longitude: Floats, altitude: Floats) -> Floats:
    """Positions east, north and up of the first one [m], shape (n, 3).

    WGS84 to the tangent plane: Hofmann-Wellenhof, Lichtenegger, Wasle, GNSS, 2008, sections 8.2 and 8.3.

    Args:
        latitude: [deg], shape (n,).
        longitude: [deg], shape (n,).
        altitude: above the ellipsoid [m], shape (n,); unknown values are taken as level.
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


def locate_vehicle(
    receiver: Receiver,
    beside: Receiver | None,
    turnings: Sequence[Turning],
    ahead: tuple[Floats, Floats] | None,
    lever: Floats,
) -> Located:
    """Poses of base_link from a satellite receiver.

    Args:
        receiver: fixes, or velocities over ground if there are none.
        beside: velocities that belong to the fixes.
        turnings: sensors that turn with the vehicle.
        ahead: times [s] and forward speed [m/s] of the wheels or the command.
        lever: position of the antenna in base_link [m], shape (3,).
    """
    topic = receiver.columns.topic
    track = _read_track(receiver)
    findings = list(track.findings)
    if track.rows.size < topic_values.FEWEST_MESSAGES:
        nothing = PoseArrays(np.zeros((0, 3)), np.zeros((0, 4)), _PARENT, _CHILD)
        return Located(track.rows[:0], nothing, track.findings)
    times, follow_alone = receiver.times[track.rows], None
    if track.velocity is not None:
        course = follow_velocity(times, track.velocity, ahead)
    else:
        clock, moved = (np.zeros(0), np.zeros((0, 2))) if beside is None else _take_distinct(beside)
        over_ground = read_over_ground(times, track.position, clock, moved)
        if over_ground is not None:
            course = follow_velocity(clock, over_ground, ahead)
        else:
            course = follow_track(times, track.position, ahead)
            follow_alone = partial(follow_closely, course, track.position, ahead)
        if beside is not None and over_ground is None:
            findings.append(Finding("velocity_disagrees", "warning", beside.columns.topic, {"topic": topic}))
    if ahead is None:
        findings.append(Finding("direction_assumed", "warning", topic))
    heading = find_heading(times, course, turnings, lever[:2], topic, follow_alone)
    headed = np.isfinite(heading.yaw)
    quaternion = rigid.quaternions_from_yaw(heading.yaw[headed])
    arm = rigid.rotate(quaternion, np.broadcast_to(lever, (quaternion.shape[0], 3)))
    arrays = PoseArrays(track.position[headed] - arm, quaternion, _PARENT, _CHILD)
    return Located(track.rows[headed], arrays, (*findings, heading.finding))


@dataclass(frozen=True)
class _Track:
    """Positions of the antenna [m], shape (n, 3), their messages, and velocities if recorded."""

    rows: Ints
    position: Floats
    velocity: Floats | None = None
    findings: tuple[Finding, ...] = ()


def _read_track(receiver: Receiver) -> _Track:
    """Fixes on a local plane, or integrated velocities over ground."""
    columns, rows = receiver.columns, receiver.order
    if find_type(columns.type_name).fix is None:
        velocity = topic_values.read_ground_velocity(columns)[rows]
        known = np.isfinite(velocity).all(axis=1)
        rows, velocity = rows[known], velocity[known]
        ways = [arrays.integrate_rate(receiver.times[rows], velocity[:, axis]) for axis in (0, 1)]
        return _Track(rows, np.stack((*ways, np.zeros(rows.size)), axis=-1), velocity)
    latitude, longitude, altitude, fixed = topic_values.read_fixes(columns)
    good = rows[fixed[rows]]
    position = to_local_plane(latitude[good], longitude[good], altitude[good])
    lost = rows.size - good.size
    new = is_new(receiver.times[good], position)
    good, position = good[new], position[new]
    if not lost:
        return _Track(good, position)
    finding = Finding("no_fix", "warning", columns.topic, {"count": lost})
    return _Track(good, position, findings=(finding,))


def _take_distinct(receiver: Receiver) -> tuple[Floats, Floats]:
    """Times and finite velocities of messages with distinct stamps."""
    velocity = topic_values.read_ground_velocity(receiver.columns)[receiver.order]
    times = receiver.times[receiver.order]
    mask = np.isfinite(velocity).all(axis=1) & np.concatenate(([True], np.diff(times) > 0.0))
    return times[mask], velocity[mask]


def list_turnings(imu: Receiver) -> list[Turning]:
    """Signals of an IMU that turn with the vehicle."""
    times = imu.times[imu.order]
    if times.size < topic_values.FEWEST_MESSAGES:
        return []
    rates, _ = topic_values.read_imu(imu.columns)
    rate = rates[imu.order, 2]
    read = np.isfinite(rate)
    turnings = []
    if read.sum() >= topic_values.FEWEST_MESSAGES:
        angle = arrays.integrate_rate(times[read], rate[read])
        turnings.append(Turning(f"the gyro of {imu.columns.topic}", times[read], angle))
    attitude = topic_values.read_attitude(imu.columns)
    if attitude is not None:
        attitude = attitude[imu.order]
        known = np.isfinite(attitude).all(axis=1) & (np.abs(np.linalg.norm(attitude, axis=1) - 1.0) < _UNIT)
        if known.sum() >= topic_values.FEWEST_MESSAGES:
            yaw = np.unwrap(rigid.euler_from_quaternions(attitude[known])[2])
            turnings.append(Turning(f"the orientation of {imu.columns.topic}", times[known], yaw))
    return turnings


def read_headings(number: Receiver, field: str) -> list[Turning]:
    """A number that may be a heading, in radians and in degrees: the course tells which, and its sense."""
    values, times = topic_values.numbers(number.columns, field)[number.order], number.times[number.order]
    known = np.isfinite(values)
    if known.sum() < topic_values.FEWEST_MESSAGES:
        return []
    name, angles = number.columns.topic, (values[known], np.radians(values[known]))
    return [Turning(name, times[known], np.unwrap(angle)) for angle in angles]


def is_new(times: Floats, position: Floats) -> Flags:
    """Whether a position is new: one repeated while the antenna moves comes from a slow receiver."""
    if times.size < 2:  # noqa: PLR2004 - one position is new
        return np.ones(times.size, dtype=bool)
    positions = [
        arrays.interpolate_linearly(times + by, times, position[:, :2])
        for by in (-0.5 * _WINDOW_S, 0.5 * _WINDOW_S)
    ]
    moves = np.linalg.norm(positions[1] - positions[0], axis=1) > _MOVES_M
    again = np.concatenate(([False], np.all(np.diff(position, axis=0) == 0.0, axis=1)))
    new: Flags = ~(again & moves)
    return new


def head_positions(
    arrays: PoseArrays, receiver: Receiver, turnings: Sequence[Turning], ahead: tuple[Floats, Floats] | None
) -> Located | None:
    """Poses of a position-only topic, with the course as heading, or a gyro aligned with the course.

    Args:
        arrays: poses of all messages.
        receiver: the topic with its clock.
        turnings: sensors that turn with the vehicle.
        ahead: times [s] and forward speed [m/s] of the wheels or the command.

    Returns:
        The poses with a known heading; None if there are too few, as for a vehicle at rest.
    """
    rows, topic = (
        receiver.order[np.isfinite(arrays.position[receiver.order]).all(axis=1)],
        receiver.columns.topic,
    )
    rows = rows[is_new(receiver.times[rows], arrays.position[rows])]
    times, position = receiver.times[rows], arrays.position[rows]
    course = follow_track(times, position, ahead)
    follow_alone = partial(follow_closely, course, position, ahead)
    heading = find_heading(times, course, turnings, np.zeros(2), topic, follow_alone)
    headed = np.isfinite(heading.yaw)
    if headed.sum() < FEWEST_MESSAGES:
        return None
    alone = Finding("no_heading", "warning", topic, {"count": int(arrays.position.shape[0])})
    quaternion = rigid.quaternions_from_yaw(heading.yaw[headed])
    made = PoseArrays(position[headed], quaternion, arrays.parent, arrays.child)
    return Located(rows[headed], made, (alone, heading.finding))
