"""The held-out stretch of a task: where it starts anew, where it truly ends, how well that can be predicted.

A window begins at a measured pose and ends `HORIZON_S` later. Its floor is the error of whoever knows the
physics exactly: what is left are the noise of the first pose and the random motion within the window.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.simulate import Disturbance, Ground, Scenario, SimulatedRun, simulate_run
from pipeline.simulate.run import record_truth

Floats = NDArray[np.float64]

HORIZON_S = 2.0
"""How far a pose is predicted: the horizon of the project's errors, a planner's next manoeuvre."""
_BEGINS_S = 0.5
_RESTS_S = 2.0  # the programs stand still for so long at the end
_DENSE_HZ = 100.0


@dataclass(frozen=True)
class HeldOut:
    """Windows of the held-out stretch.

    Attributes:
        starts_s, ends_s: stamps of their first and last poses [s], shape (n,).
        starts: x [m], y [m], yaw [rad] as measured, shape (n, 3).
        ends: the same as they truly are at the end, shape (n, 3).
        floor, ideal: errors of position [m] and yaw [rad] of the true physics and of the ideal model.
    """

    starts_s: Floats
    ends_s: Floats
    starts: Floats
    ends: Floats
    floor: tuple[float, float]
    ideal: tuple[float, float]


def cut_windows(run: SimulatedRun, log_s: float) -> HeldOut:
    """The windows of a run after the log's end [s], one after the other."""
    stamps, last_s = run.poses.stamp_s, run.scenario.duration_s - _RESTS_S
    position, quaternion = run.poses.in_map()
    begun = np.arange(log_s + _BEGINS_S, last_s - HORIZON_S, HORIZON_S)
    rows = np.unique(np.searchsorted(stamps, begun))
    rows = rows[rows < stamps.size]
    rows = rows[stamps[rows] + HORIZON_S <= last_s]
    measured = np.column_stack((position[rows, :2], read_yaw(quaternion[rows])))
    starts_s, ends_s = stamps[rows], stamps[rows] + HORIZON_S
    quiet = _report_without_noise(run)
    before, after = _look_up(quiet, starts_s), _look_up(quiet, ends_s)
    # A localization that jumped turned and moved its map: what follows is told in the map of the first pose.
    shift = np.column_stack((run.poses.correction[rows, :2], run.poses.correction_yaw[rows]))
    ends = compose(shift, after)
    known = compose(compose(measured, relate(before, after)), _drift_at_random(run, starts_s, ends_s))
    ideal = compose(measured, _drive_ideally(run.scenario, starts_s, ends_s))
    return HeldOut(starts_s, ends_s, measured, ends, measure_error(known, ends), measure_error(ideal, ends))


def measure_error(told: Floats, true: Floats) -> tuple[float, float]:
    """Root mean square errors of position [m] and of yaw [rad]."""
    away = told - true
    turned = np.angle(np.exp(1j * away[:, 2]))
    return float(np.sqrt(np.mean(np.sum(away[:, :2] ** 2, axis=1)))), float(np.sqrt(np.mean(turned**2)))


def read_yaw(quaternion: Floats) -> Floats:
    """Yaw [rad] of attitudes (x, y, z, w), shape (n,)."""
    x, y, z, w = quaternion.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def compose(first: Floats, second: Floats) -> Floats:
    """Motions in the plane one after the other, each x, y, yaw, shape (n, 3)."""
    cosine, sine = np.cos(first[:, 2]), np.sin(first[:, 2])
    x = first[:, 0] + cosine * second[:, 0] - sine * second[:, 1]
    y = first[:, 1] + sine * second[:, 0] + cosine * second[:, 1]
    return np.column_stack((x, y, first[:, 2] + second[:, 2]))


def relate(first: Floats, second: Floats) -> Floats:
    """The motion from one pose to the other, in the frame of the first, shape (n, 3)."""
    cosine, sine = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y = (second[:, :2] - first[:, :2]).T
    return np.column_stack((cosine * x + sine * y, cosine * y - sine * x, second[:, 2] - first[:, 2]))


def walk(times: Floats, velocity: Floats) -> tuple[Floats, Floats]:
    """Times and poses (n + 1, 3) of a body with velocities (v_x, v_y, v_w) between neighbouring times."""
    step = np.diff(times)
    yaw = np.concatenate(([0.0], np.cumsum(velocity[:, 2] * step)))
    turn = np.exp(0.5j * (yaw[:-1] + yaw[1:]))
    place = np.concatenate(([0.0], np.cumsum((velocity[:, 0] + 1j * velocity[:, 1]) * turn * step)))
    return times, np.column_stack((place.real, place.imag, yaw))


def _report_without_noise(run: SimulatedRun) -> tuple[Floats, Floats]:
    """What a perfect sensor at the same place, with the same clock, would have reported."""
    sensor = replace(
        run.scenario.pose,
        rate_hz=_DENSE_HZ, update_hz=None, noise_m=0.0, noise_rad=0.0, noise_z_m=0.0, noise_tilt_rad=0.0,
        drift_m=0.0, drift_rad=0.0, jitter_s=0.0, stamp_jitter_s=0.0, dropouts=0, jumps=0,
    )  # fmt: skip
    poses = record_truth(replace(run.scenario, pose=sensor), run.truth).poses
    yaw = np.unwrap(read_yaw(poses.quaternion))
    return poses.stamp_s, np.column_stack((poses.position[:, :2], yaw))


def _look_up(poses: tuple[Floats, Floats], at: Floats) -> Floats:
    times, values = poses
    return np.column_stack([np.interp(at, times, column) for column in values.T])


def _drift_at_random(run: SimulatedRun, starts_s: Floats, ends_s: Floats) -> Floats:
    """What is to be added to the true end of each window to have the end without random motion, (n, 3)."""
    path, drive = run.truth.path, run.truth.drive
    random = np.zeros_like(path.velocity)
    if run.scenario.disturbance != Disturbance():
        middle = 0.5 * (path.time_s[:-1] + path.time_s[1:])
        calm = simulate_run(replace(run.scenario, disturbance=Disturbance())).truth.motion.velocity
        cells = (np.arange(calm.shape[0]) + 0.5) * drive.step_s
        random = _look_up((cells, run.truth.motion.velocity - calm), middle)
    moved = walk(path.time_s, path.velocity)
    calm_moves = walk(path.time_s, path.velocity - random)
    true = relate(_look_up(moved, starts_s), _look_up(moved, ends_s))
    without = relate(_look_up(calm_moves, starts_s), _look_up(calm_moves, ends_s))
    return relate(true, without)


def _drive_ideally(scene: Scenario, starts_s: Floats, ends_s: Floats) -> Floats:
    """The motion of the ideal vehicle in each window, shape (n, 3)."""
    ideal = replace(scene, effects={}, extra=None, machinery=None, disturbance=Disturbance(), ground=Ground())
    moved = simulate_run(ideal).truth.path
    poses = walk(moved.time_s, moved.velocity)
    return relate(_look_up(poses, starts_s), _look_up(poses, ends_s))
