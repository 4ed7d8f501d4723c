"""What encoders and the inertial unit report of the true motion."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core import rigid
from pipeline.core.arrays import Floats
from pipeline.simulate.drivetrain import Drive, move_by_corners
from pipeline.simulate.path import Path
from pipeline.simulate.scenario import Encoders, Imu
from pipeline.simulate.signals import integrate_cells
from pipeline.simulate.streams import open_stream
from pipeline.simulate.vehicles import Vehicle

_GRAVITY_MPS2 = 9.80665
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
    left_angle, right_angle = drive.wheel_angles()
    if drive.corners is not None:
        shaken = generator.standard_normal((4, time.size)) * encoders.noise_radps
        speeds, angles = {}, {}
        for (place, wheel), more in zip(drive.corners.items(), shaken, strict=True):
            speeds[place] = encoders.gain * (np.interp(at, middle, wheel) + more)
            turned = integrate_cells(wheel, step_s=drive.step_s)
            angles[place] = encoders.gain * np.interp(at, edges, turned)
        (left, right), (left_angle, right_angle) = (
            [0.5 * (readings[f"front_{side}"] + readings[f"rear_{side}"]) for side in ("left", "right")]
            for readings in (speeds, angles)
        )
        straight = np.zeros_like(time)
        return WheelReadings(time, left, right, left_angle, right_angle, straight, speeds, angles)
    return WheelReadings(
        time,
        encoders.gain * (np.interp(at, middle, drive.left) + noise[0]),
        encoders.gain * (np.interp(at, middle, drive.right) + noise[1]),
        encoders.gain * np.interp(at, edges, left_angle),
        encoders.gain * np.interp(at, edges, right_angle),
        np.interp(at, middle, drive.steering) + _STEERING_SHARE * noise[2],
    )


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
    upright = np.broadcast_to(np.array([0.0, 0.0, _GRAVITY_MPS2]), (time.size, 3))
    forces: Floats = rigid.rotate(
        rigid.invert_quaternions(path.quaternion[_nearest(time, step, path.time_s.size - 1)]), upright
    )
    forces[:, 0] += change[:, 0] - v_w * v_y
    forces[:, 1] += change[:, 1] + v_w * v_x
    return forces
