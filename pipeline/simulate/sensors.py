"""What encoders, the inertial unit and the localization report of the true motion."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.core import (
    GRAVITY_MPS2,
    Floats,
    interpolate_poses,
    multiply_quaternions,
    quaternions_from_vectors,
    quaternions_from_yaw,
    rigid,
    rotate,
)
from pipeline.simulate.drivetrain import move_by_corners
from pipeline.simulate.facts import Effects, Vehicle, open_stream, spread_times
from pipeline.simulate.path import Path
from pipeline.simulate.programs import make_coloured_noise
from pipeline.simulate.scenario import Drive, Encoders, Imu, PoseSensor, integrate_cells

_GYRO_WINDOW_S = 0.01
_ACCELEROMETER_WINDOW_S = 0.05
_STEERING_SHARE = 0.01


@dataclass(frozen=True)
class WheelReadings:
    """Encoders at their own times.

    Attributes:
        time_s: when they were read, shape (n,).
        left, right: wheel speeds [rad/s], shape (n,).
        left_angle, right_angle: turned angles [rad], shape (n,).
        steering: steering angle [rad], shape (n,).
        corners, corner_angles: speeds [rad/s] and angles [rad] of four wheels that move the vehicle sideways,
            by place; None on a vehicle that cannot.
    """

    time_s: Floats
    left: Floats
    right: Floats
    left_angle: Floats
    right_angle: Floats
    steering: Floats
    corners: Mapping[str, Floats] | None = None
    corner_angles: Mapping[str, Floats] | None = None

    def sideways_mps(self, vehicle: Vehicle) -> Floats:
        """Ideal speed to the left [m/s], zero on a vehicle that cannot, shape (n,)."""
        return np.zeros_like(self.left) if self.corners is None else move_by_corners(vehicle, self.corners)[1]


@dataclass(frozen=True)
class ImuReadings:
    """The inertial unit at its own times.

    Attributes:
        time_s: shape (n,).
        rates: angular velocity [rad/s] about the sensor's axes, shape (n, 3).
        accelerations: specific force [m/s^2] along the sensor's axes, shape (n, 3).
    """

    time_s: Floats
    rates: Floats
    accelerations: Floats


def read_encoders(encoders: Encoders, drive: Drive, *, duration_s: float, seed: int) -> WheelReadings:
    """Sample the wheels with noise and delay."""
    generator = open_stream(seed, "encoders")
    time = np.arange(0.29 / encoders.rate_hz, duration_s, 1.0 / encoders.rate_hz)
    at = time - encoders.delay_s
    middle = (np.arange(drive.left.size) + 0.5) * drive.step_s
    edges = np.arange(drive.left.size + 1) * drive.step_s
    noise = generator.standard_normal((3, time.size)) * encoders.noise_radps

    def read(wheel: Floats, added: Floats) -> tuple[Floats, Floats]:
        turned = integrate_cells(wheel, step_s=drive.step_s)
        speed = encoders.gain * (np.interp(at, middle, wheel) + added)
        return speed, encoders.gain * np.interp(at, edges, turned)

    if drive.corners is None:
        (left, left_angle), (right, right_angle) = read(drive.left, noise[0]), read(drive.right, noise[1])
        steering = np.interp(at, middle, drive.steering) + _STEERING_SHARE * noise[2]
        return WheelReadings(time, left, right, left_angle, right_angle, steering)
    shaken = generator.standard_normal((4, time.size)) * encoders.noise_radps
    corners = {
        corner: read(wheel, added)
        for (corner, wheel), added in zip(drive.corners.items(), shaken, strict=True)
    }
    speeds, angles = ({corner: one[i] for corner, one in corners.items()} for i in (0, 1))
    (left, right), (left_angle, right_angle) = (
        [0.5 * (readings[f"front_{side}"] + readings[f"rear_{side}"]) for side in ("left", "right")]
        for readings in (speeds, angles)
    )
    straight = np.zeros_like(time)
    return WheelReadings(time, left, right, left_angle, right_angle, straight, speeds, angles)


def read_imu(imu: Imu, path: Path, *, duration_s: float, seed: int) -> ImuReadings:
    """Sample angular velocity and specific force with the sensor's errors."""
    step = float(path.time_s[1] - path.time_s[0])
    time = np.arange(0.61 / imu.rate_hz, duration_s, 1.0 / imu.rate_hz)
    mounting = rigid.quaternions_from_euler(
        np.array([imu.tilt_roll_rad]), np.array([imu.tilt_pitch_rad]), np.array([0.0])
    )
    to_sensor = np.broadcast_to(rigid.invert_quaternions(mounting), (time.size, 4))
    rates = rigid.rotate(to_sensor, _turn_rates(path, time, step))
    forces = rigid.rotate(to_sensor, _specific_forces(path, time, step))
    rates[:, 2] = imu.sign * (imu.scale * rates[:, 2] + imu.bias_radps)
    rates += open_stream(seed, "gyro").standard_normal(rates.shape) * imu.noise_radps
    forces += open_stream(seed, "accelerometer").standard_normal(forces.shape) * imu.noise_mps2
    return ImuReadings(time, rates, forces)


def _nearest(time: Floats, step: float, last: int) -> NDArray[np.intp]:
    return np.clip(np.rint(time / step).astype(np.intp), 0, last)


def _turn_rates(path: Path, time: Floats, step: float) -> Floats:
    half = max(round(0.5 * _GYRO_WINDOW_S / step), 1)
    last = path.time_s.size - 1
    centre = _nearest(time, step, last)
    before, after = np.maximum(centre - half, 0), np.minimum(centre + half, last)
    turned = rigid.multiply_quaternions(
        rigid.invert_quaternions(path.quaternion[before]), path.quaternion[after]
    )
    return rigid.rotation_vectors(turned) / ((after - before) * step)[:, None]


def _specific_forces(path: Path, time: Floats, step: float) -> Floats:
    half = max(round(0.5 * _ACCELEROMETER_WINDOW_S / step), 1)
    last = path.velocity.shape[0] - 1
    centre = _nearest(time, step, last)
    before, after = np.maximum(centre - half, 0), np.minimum(centre + half, last)
    change = (path.velocity[after] - path.velocity[before]) / ((after - before) * step)[:, None]
    v_x, v_y, v_w = path.velocity[centre].T
    upright = np.broadcast_to(np.array([0.0, 0.0, GRAVITY_MPS2]), (time.size, 3))
    forces: Floats = rigid.rotate(
        rigid.invert_quaternions(path.quaternion[_nearest(time, step, path.time_s.size - 1)]), upright
    )
    forces[:, 0] += change[:, 0] - v_w * v_y
    forces[:, 1] += change[:, 1] + v_w * v_x
    return forces


_DRIFT_STEP_S = 0.1
_STRETCH_S = 2.0


@dataclass(frozen=True)
class Poses:
    """Reported poses.

    Attributes:
        sampled_s: true time at which each pose held, shape (n,).
        stamp_s: what its header says, in true time before the clock's own faults [s], shape (n,).
        log_s: when it reached the recorder [s], shape (n,).
        position: base_link in ``odom`` [m], shape (n, 3).
        quaternion: attitude in ``odom``, shape (n, 4).
        correction_yaw: rotation of ``odom`` in ``map`` [rad], shape (n,); steps where the localization jumps.
        correction: translation of ``odom`` in ``map`` [m], shape (n, 3).
    """

    sampled_s: Floats
    stamp_s: Floats
    log_s: Floats
    position: Floats
    quaternion: Floats
    correction_yaw: Floats
    correction: Floats

    def in_map(self) -> tuple[Floats, Floats]:
        """Positions (n, 3) and quaternions (n, 4) in the ``map`` frame."""
        turn = quaternions_from_yaw(self.correction_yaw)
        return self.correction + rotate(turn, self.position), multiply_quaternions(turn, self.quaternion)


def report_poses(sensor: PoseSensor, path: Path, effects: Effects, *, duration_s: float, seed: int) -> Poses:
    """Sample the path as the localization does.

    Args:
        sensor: rates, noise and faults.
        path: true motion (or wheel odometry, when that is what calls itself localization).
        effects: heading_skew, yaw_misalignment, lever_arm and clock_offset act here.
        duration_s: length of the run.
        seed: the run's.
    """
    published, sampled = _choose_times(sensor, duration_s, seed)
    position, quaternion = _sample_path(path, effects, sampled)
    position, quaternion = _mount_frame(sensor, position, quaternion)
    position = _stretch_map(sensor, position)
    position, quaternion = _add_noise(sensor, sampled, position, quaternion, seed)
    which = np.searchsorted(sampled, published, side="right") - 1
    late = open_stream(seed, "pose latency").standard_normal(published.size) * sensor.latency_jitter_s
    blur = open_stream(seed, "pose stamps").standard_normal(published.size) * sensor.stamp_jitter_s
    poses = Poses(
        sampled_s=sampled[which],
        stamp_s=published + effects.value("clock_offset", "d") + blur,
        log_s=published + np.maximum(sensor.latency_s + late, 0.0),
        position=position[which],
        quaternion=quaternion[which],
        correction_yaw=np.zeros(published.size),
        correction=np.zeros((published.size, 3)),
    )
    poses = _add_jumps(sensor, poses, duration_s, seed)
    poses = _rotate_stretches(sensor, poses, duration_s, seed)
    poses = _invalidate(sensor, poses, seed)
    return _drop_out(sensor, poses, duration_s, seed)


def _choose_times(sensor: PoseSensor, duration_s: float, seed: int) -> tuple[Floats, Floats]:
    generator = open_stream(seed, "pose times")
    published = np.arange(0.0, duration_s, 1.0 / sensor.rate_hz)
    bound = 0.45 / sensor.rate_hz
    jitter = np.clip(generator.standard_normal(published.size) * sensor.jitter_s, -bound, bound)
    published = np.clip(published + jitter, 0.0, duration_s)
    if sensor.update_hz is None:
        return published, published
    scans = np.arange(0.0, duration_s, 1.0 / sensor.update_hz)
    return published, np.unique(np.minimum.reduce((scans, np.full(scans.size, published[-1]))))


def _sample_path(path: Path, effects: Effects, at: Floats) -> tuple[Floats, Floats]:
    position, quaternion = interpolate_poses(at, path.time_s, path.position, path.quaternion)
    arm = np.array([effects.value("lever_arm", "l_x"), effects.value("lever_arm", "l_y"), 0.0])
    if effects.is_active("lever_arm"):
        position = position + rotate(quaternion, np.broadcast_to(arm, position.shape))
    if effects.is_active("heading_skew"):
        late = at - effects.value("heading_skew", "d")
        _, quaternion = interpolate_poses(late, path.time_s, path.position, path.quaternion)
    if effects.is_active("yaw_misalignment"):
        twist = quaternions_from_yaw(np.full(at.size, effects.value("yaw_misalignment", "psi")))
        quaternion = multiply_quaternions(quaternion, twist)
    return position, quaternion


def _mount_frame(sensor: PoseSensor, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
    if sensor.child_frame == "base_link":
        return position, quaternion
    arm = np.broadcast_to(np.array([sensor.mount_x_m, sensor.mount_y_m, 0.0]), position.shape)
    twist = quaternions_from_yaw(np.full(position.shape[0], sensor.mount_yaw_rad))
    return position + rotate(quaternion, arm), multiply_quaternions(quaternion, twist)


def _stretch_map(sensor: PoseSensor, position: Floats) -> Floats:
    """Positions in a map that is longer along one direction than the world."""
    along = np.array([np.cos(sensor.map_stretch_rad), np.sin(sensor.map_stretch_rad), 0.0])
    return position + sensor.map_stretch * np.outer(position @ along, along)


def _add_noise(
    sensor: PoseSensor, at: Floats, position: Floats, quaternion: Floats, seed: int
) -> tuple[Floats, Floats]:
    white = open_stream(seed, "pose noise").standard_normal((at.size, 6))
    position = position + white[:, :3] * np.array([sensor.noise_m, sensor.noise_m, sensor.noise_z_m])
    shake = white[:, 3:] * np.array([sensor.noise_tilt_rad, sensor.noise_tilt_rad, sensor.noise_rad])
    quaternion = multiply_quaternions(quaternion, quaternions_from_vectors(shake))
    if sensor.drift_m == 0.0 and sensor.drift_rad == 0.0:
        return position, quaternion
    generator = open_stream(seed, "pose drift")
    grid = np.arange(0.0, at[-1] + 2.0 * _DRIFT_STEP_S, _DRIFT_STEP_S)

    def wander(deviation: float) -> Floats:
        noise = make_coloured_noise(
            generator,
            size=grid.size,
            deviation=deviation,
            correlation_s=sensor.drift_s,
            step_s=_DRIFT_STEP_S,
        )
        return np.interp(at, grid, noise)

    slow = np.stack((wander(sensor.drift_m), wander(sensor.drift_m), np.zeros(at.size)), axis=1)
    turned = multiply_quaternions(quaternions_from_yaw(wander(sensor.drift_rad)), quaternion)
    return position + slow, turned


def _add_jumps(sensor: PoseSensor, poses: Poses, duration_s: float, seed: int) -> Poses:
    generator = open_stream(seed, "pose jumps")
    yaw, shift = poses.correction_yaw.copy(), poses.correction.copy()
    for at in spread_times(sensor.jumps, duration_s=duration_s, generator=generator).tolist():
        after = np.flatnonzero(poses.sampled_s >= at)
        if after.size == 0:
            continue
        direction = generator.uniform(0.0, 2.0 * np.pi)
        turn = sensor.jump_rad * generator.choice([-1.0, 1.0])
        here = poses.in_map()[0][after[0]]
        # The correction turns the map about the robot, so that the jump has the asked size wherever it is.
        moved = np.array([np.cos(direction), np.sin(direction), 0.0]) * sensor.jump_m
        by = quaternions_from_yaw(np.full(after.size, turn))
        shift[after] = here + moved + rotate(by, shift[after] - here)
        yaw[after] += turn
        poses = replace(poses, correction_yaw=yaw.copy(), correction=shift.copy())
    return poses


def _rotate_stretches(sensor: PoseSensor, poses: Poses, duration_s: float, seed: int) -> Poses:
    generator = open_stream(seed, "pose stretches")
    turn = np.zeros(poses.stamp_s.size)
    for start in spread_times(sensor.rotated_stretches, duration_s=duration_s, generator=generator).tolist():
        turn[(poses.sampled_s >= start) & (poses.sampled_s < start + _STRETCH_S)] = 0.5 * np.pi
    if not turn.any():
        return poses
    return replace(poses, quaternion=multiply_quaternions(poses.quaternion, quaternions_from_yaw(turn)))


def _invalidate(sensor: PoseSensor, poses: Poses, seed: int) -> Poses:
    if sensor.invalid == 0:
        return poses
    generator = open_stream(seed, "pose faults")
    which = generator.choice(poses.stamp_s.size, size=min(sensor.invalid, poses.stamp_s.size), replace=False)
    position, quaternion = poses.position.copy(), poses.quaternion.copy()
    position[which[::2]] = np.nan
    quaternion[which[1::2]] = 0.0
    return replace(poses, position=position, quaternion=quaternion)


def _drop_out(sensor: PoseSensor, poses: Poses, duration_s: float, seed: int) -> Poses:
    mask = np.ones(poses.stamp_s.size, dtype=bool)
    starts = spread_times(
        sensor.dropouts, duration_s=duration_s, generator=open_stream(seed, "pose dropouts")
    )
    for start in starts.tolist():
        mask &= (poses.stamp_s < start) | (poses.stamp_s >= start + sensor.dropout_s)
    return Poses(**{name: series[mask] for name, series in vars(poses).items()})
