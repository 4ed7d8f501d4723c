"""Slopes under poses in the plane, by the orientation of an IMU, or by its accelerations alone.

A localization in the plane, or a receiver's course, knows a heading and no slope: where the ground is not
level, roll and pitch are those of the IMU, and the height follows from them along the path. Its specific
force, which is gravity and the acceleration of the body, tells which way it is mounted. Of an IMU without
orientations, roll and pitch are those of its specific force less the acceleration of the poses.
"""

import numpy as np

from pipeline.core import Complex, Flags, Floats, arrays, join_parts, rigid
from pipeline.recording import topic_values

_LEVEL_RAD = 1e-3
"""Range of roll and pitch [rad] below which poses are in the plane: rounding is less, and any ground more."""
_LEAST_RAD = np.radians(3.0)
"""Half of the range of roll or pitch over nine tenths of the time from which on an IMU tells a slope: on a
level floor, starts and stops feign a degree or two."""
_UNIT = 0.1
"""Deviation of an orientation's length from one: a sensor without one gives zeros."""
_UPRIGHT = 0.9
"""Share of the specific force that is upward where an orientation belongs to it: the rest is acceleration."""
_WINDOW_S = 1.0
"""Span over which accelerations are compared [s]: shorter ones are noise of the poses."""
_FOLLOWS = 0.3
"""Least share of a body's acceleration that its IMU's is explained by, where that tells its mounting."""
_ONE_WAY = 0.5
"""Length of the mean direction of the driving above which one direction prevails."""
_PARTS, _SURE = 8, 3.0
"""Parts of the way by which the error of a mounting is estimated, and how many errors it must be."""
_ASKEW, _MOST_OFF = 0.25, 0.5
"""Largest standard error of a turn that tells a mounting, 14 degrees, and of its size: poses smooth it."""
_TURNED_RAD = np.radians(30.0)
"""Least angle of a mounting [rad]: nobody mounts an IMU askew by less and says nothing, and noise may."""


def lean(
    times: Floats, position: Floats, quaternion: Floats, imu: topic_values.Receiver, turn: Floats | None
) -> tuple[Floats, Floats, float, float] | None:
    """Poses in the plane with the slopes of an IMU; None where poses or IMU give no reason.

    Args:
        times: of the poses [s], shape (n,).
        position: shape (n, 3) [m].
        quaternion: shape (n, 4).
        imu: orientations, or specific forces alone, with their clock.
        turn: orientation of the body in the IMU's frame, shape (4,); None where nothing says it.

    Returns:
        Positions, quaternions, the largest slope over nine tenths of the time, and the angle from ahead to
        the IMU's x axis where only its accelerations tell it, else zero [rad].
    """
    roll, pitch, yaw = rigid.euler_from_quaternions(quaternion)
    if max(_span(roll), _span(pitch)) > _LEVEL_RAD:
        return None
    at, force, attitude = _read(imu)
    if at.size < topic_values.FEWEST_MESSAGES:
        return None
    body, inside = _measure_acceleration(times, position, yaw, at)
    if attitude is not None:
        made = _lean_by_attitude(attitude, force, at, turn, body, inside)
    else:
        made = _lean_by_force(force[inside], at[inside], turn, body)
        at, inside = at[inside], inside[inside]
    if made is None:
        return None
    tilts, angle = made
    # A filter that takes accelerations for gravity leans where the body speeds up.
    if _share(_smooth(at[inside], (1j * tilts[0] - tilts[1])[inside]), body) > _FOLLOWS:
        return None
    tilts -= _find_offsets(at, tilts, times, position, yaw)[:, None]
    low, high = np.quantile(tilts, (0.05, 0.95), axis=1)
    if float((high - low).max()) < 2.0 * _LEAST_RAD:
        return None
    roll, pitch = (np.interp(times, at, tilt) for tilt in tilts)
    leaning = rigid.quaternions_from_euler(roll, pitch, yaw)
    if _span(position[:, 2]) == 0.0:
        across = rigid.rotate(leaning, np.broadcast_to([0.0, 0.0, 1.0], position.shape))
        slope = -across[:, :2] / across[:, 2:]
        risen = (0.5 * (slope[1:] + slope[:-1]) * np.diff(position[:, :2], axis=0)).sum(axis=1)
        height = position[0, 2] + np.append(0.0, np.cumsum(np.nan_to_num(risen)))
        position = np.column_stack((position[:, :2], np.where(np.isfinite(position[:, 2]), height, np.nan)))
    return position, leaning, float(np.abs([low, high]).max()), angle


def _read(imu: topic_values.Receiver) -> tuple[Floats, Floats, Floats | None]:
    """Times [s], specific forces (m, 3) and orientations (m, 4) of an IMU; None if it has no orientations."""
    at, force = imu.times[imu.order], topic_values.read_imu(imu.columns)[1][imu.order]
    attitude = topic_values.read_attitude(imu.columns)
    if attitude is not None:
        attitude = attitude[imu.order]
        known = np.isfinite(attitude).all(axis=1) & (np.abs(np.linalg.norm(attitude, axis=1) - 1.0) < _UNIT)
        # A sensor without one repeats the first that it had.
        if known.sum() >= topic_values.FEWEST_MESSAGES and np.ptp(attitude[known], axis=0).any():
            return at[known], force[known], attitude[known]
    known = np.isfinite(force).all(axis=1)
    return at[known], force[known], None


def _lean_by_attitude(
    attitude: Floats, force: Floats, at: Floats, turn: Floats | None, body: Complex, inside: Flags
) -> tuple[Floats, float] | None:
    """Roll and pitch of the body [rad], shape (2, m), and the angle of the mounting, by orientations."""
    angle = 0.0
    if turn is None:
        if not _is_of_force(attitude, force):
            return None
        roll, pitch, _ = rigid.euler_from_quaternions(attitude)
        level = rigid.rotate(rigid.quaternions_from_euler(roll, pitch, np.zeros(roll.size)), force)
        felt = _smooth(at[inside], (level[:, 0] + 1j * level[:, 1])[inside])
        # A turned sensor feels what the body does, turned back.
        turned = float(np.angle(np.vdot(felt, body)))
        angle = turned if _share(felt, body) > _FOLLOWS and abs(turned) > _TURNED_RAD else 0.0
        turn = rigid.quaternions_from_yaw(np.array([-angle]))[0]
    return np.array(rigid.euler_from_quaternions(rigid.multiply_quaternions(attitude, turn[None]))[:2]), angle


def _lean_by_force(
    force: Floats, at: Floats, turn: Floats | None, body: Complex
) -> tuple[Floats, float] | None:
    """Roll and pitch of the body [rad], shape (2, m), and the angle of the mounting, by specific forces.

    None where they are not those of gravity, or where nothing shows how their sensor is mounted.
    """
    size = np.median(np.linalg.norm(force, axis=1)) if at.size >= topic_values.FEWEST_MESSAGES else 0.0
    if abs(size / rigid.GRAVITY_MPS2 - 1.0) > _UNIT:
        return None
    if turn is not None:
        force = rigid.rotate(np.broadcast_to(rigid.invert_quaternions(turn[None]), (at.size, 4)), force)
    means = np.column_stack([_average(at, part) for part in force.T])
    if means[:, 2].mean() < _UPRIGHT * rigid.GRAVITY_MPS2:
        return None
    level = means[:, 0] + 1j * means[:, 1]
    angle = 0.0
    if turn is None:
        # Slopes change slowly, and what speeds up and slows down does not.
        late = arrays.count_steps(at, _WINDOW_S)
        gain, error = _measure_gain(level[late:] - level[:-late], body[late:] - body[:-late])
        if error > _ASKEW * abs(gain) or not 1.0 - _MOST_OFF < abs(gain) < 1.0 + _MOST_OFF:
            return None
        angle = float(-np.angle(gain))
        angle = angle if abs(angle) > _TURNED_RAD else 0.0
        level = level * np.exp(1j * angle)
    gravity = level - body
    return np.array((np.arctan2(gravity.imag, means[:, 2]), np.arctan2(-gravity.real, means[:, 2]))), angle


def _measure_gain(felt: Complex, body: Complex) -> tuple[complex, float]:
    """What a sensor feels over what a body does, a turn where it is mounted askew, and its standard error."""
    parts = np.arange(body.size) * _PARTS // max(body.size, 1)
    both, own = (
        np.array([np.vdot(body[parts == number], one[parts == number]) for number in range(_PARTS)])
        for one in (felt, body)
    )
    if not own.sum().real > 0.0:
        return 0.0, np.inf
    # The ground of one part of the way is not that of another (jackknife).
    others = (both.sum() - both) / np.maximum((own.sum() - own).real, 1e-12)
    spread = float(np.mean(np.abs(others - others.mean()) ** 2))
    return complex(both.sum() / own.sum().real), float(np.sqrt((_PARTS - 1.0) * spread))


def _is_of_force(attitude: Floats, force: Floats) -> bool:
    """Whether orientations (n, 4) turn specific forces (n, 3) upward; of no force nothing is known."""
    size = np.linalg.norm(np.nan_to_num(force), axis=1)
    if float(np.median(size)) < 1.0:
        return True
    return float(np.median(rigid.rotate(attitude, force)[:, 2] / np.maximum(size, 1.0))) > _UPRIGHT


def _measure_acceleration(times: Floats, position: Floats, yaw: Floats, at: Floats) -> tuple[Complex, Flags]:
    """Mean acceleration of the body ahead + 1j * left over windows, and about which of some times.

    Args:
        times: of the poses [s], shape (n,).
        position: of the poses [m], shape (n, 3).
        yaw: of the poses [rad], shape (n,).
        at: times in the middle of the windows [s], shape (m,).
    """
    good = np.isfinite(position).all(axis=1) & np.isfinite(yaw) & (np.diff(times, prepend=-np.inf) > 0.0)
    times, plane = times[good], position[good, :2]
    inside: Flags = np.zeros(at.size, dtype=bool)
    if times.size < topic_values.FEWEST_MESSAGES:
        return np.zeros(0, dtype=np.complex128), inside
    inside = (at > times[0] + _WINDOW_S) & (at < times[-1] - _WINDOW_S) & (np.diff(at, prepend=-np.inf) > 0.0)
    at = at[inside]
    # The change of the velocity over a window is the mean of the acceleration.
    velocity = arrays.differentiate_locally(times, times, plane, _WINDOW_S)
    moved = arrays.differentiate_locally(at, times, velocity, _WINDOW_S) if at.size else np.zeros((0, 2))
    headings = np.exp(-1j * np.interp(at, times, yaw[good]))
    return np.asarray(join_parts(*moved.T) * headings), inside


def _smooth(at: Floats, values: Complex) -> Complex:
    """Means over windows as those of the acceleration, less their own mean, shape (m,)."""
    if at.size < topic_values.FEWEST_MESSAGES:
        return np.zeros(at.size, dtype=np.complex128)
    known = np.nan_to_num(values)
    means = join_parts(_average(at, known.real), _average(at, known.imag))
    return np.asarray(means - means.mean())


def _average(at: Floats, values: Floats) -> Floats:
    """Means over windows as those of the acceleration, shape (m,)."""
    summed = arrays.integrate_rate(at, values)[:, None]
    return np.asarray(arrays.differentiate_locally(at, at, summed, 2.0 * _WINDOW_S)[:, 0])


def _share(one: Complex, other: Complex) -> float:
    """Part of one series that another one explains, turned and scaled, from 0 to 1."""
    power = float((np.vdot(one, one) * np.vdot(other, other)).real)
    return float(abs(np.vdot(one, other)) ** 2) / power if power > 0.0 else 0.0


def _find_offsets(at: Floats, tilts: Floats, times: Floats, position: Floats, yaw: Floats) -> Floats:
    """Roll and pitch of the mounting [rad], shape (2,): what does not turn with the heading.

    A slope that is driven one way and the other leans the body one way and the other. Zero where it is
    driven one way.
    """
    steps = np.abs(np.diff(position[:, 0] + 1j * position[:, 1], append=np.nan))
    far = float(np.nanquantile(steps, 0.99)) if np.isfinite(steps).any() else 0.0
    # Every metre counts once, and a jump is none.
    weight = np.sqrt(np.where(np.isfinite(steps) & np.isfinite(yaw), np.minimum(steps, far), 0.0))
    ahead = np.exp(1j * np.nan_to_num(yaw))
    total = float(weight @ weight)
    if total <= 0.0 or abs(complex((weight**2) @ ahead)) > _ONE_WAY * total:
        return np.zeros(2)
    roll, pitch = (np.interp(times, at, tilt) for tilt in tilts)
    one, none = np.ones(ahead.size), np.zeros(ahead.size)
    # Of the offsets of roll and pitch, and of the mean gradient to the east and north.
    columns = np.vstack((
        np.column_stack((one, none, -ahead.imag, ahead.real)),
        np.column_stack((none, one, -ahead.real, -ahead.imag)),
    ))  # fmt: skip
    wanted, both = np.concatenate((roll, pitch)), np.tile(weight, 2)
    part = np.tile(np.cumsum(weight**2) * (_PARTS / total) // 1.0, 2)

    def solve(rows: Flags) -> Floats:
        weighed = both * rows
        made = np.linalg.lstsq(columns * weighed[:, None], wanted * weighed, rcond=None)[0][:2]
        return np.asarray(made, dtype=np.float64)

    # The ground of one part of the way is not that of another (jackknife).
    offsets = solve(np.ones(both.size, dtype=bool))
    others = np.array([solve(part != number) for number in range(_PARTS)])
    error = np.sqrt((_PARTS - 1.0) * np.mean((others - others.mean(axis=0)) ** 2, axis=0))
    return np.where(np.abs(offsets) > _SURE * error, offsets, 0.0)


def _span(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if known.size else 0.0
