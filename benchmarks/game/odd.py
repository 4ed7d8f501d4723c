"""Physics that no catalogue has: what `diagnose` must flag as unexplained, not name for something else."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.simulate import Drive, Ground, State, Vehicle
from pipeline.simulate.programs import follow

Floats = NDArray[np.float64]
Push = Callable[[State], tuple[float, float, float]]

_PLANE = Ground()


@dataclass(frozen=True)
class Odd:
    """One cause.

    Attributes:
        about: what it does.
        channels: on which it acts.
        make: its physics for a vehicle, what it adds to the velocity of the body.
        drive: the same of what acts on the drivetrain: what it makes of wheels and steering.
        alike: effects of the catalogue that say the same.
        ground: on which it shows.
    """

    about: str
    channels: str
    make: Callable[[Vehicle], Push] | None = None
    drive: Callable[[Vehicle, Drive], Drive] | None = None
    alike: tuple[str, ...] = ()
    ground: Ground = _PLANE


def _crosswind(vehicle: Vehicle) -> Push:
    size = 0.1 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        moving = min(abs(state.v0) / 0.1, 1.0)
        return size * math.cos(state.yaw) * moving, -size * math.sin(state.yaw) * moving, 0.0

    return push


def _reverse_slip(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        return (-0.25 * state.v0 if state.v0 < 0.0 else 0.0), 0.0, 0.0

    return push


def _right_turns(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        return 0.0, 0.0, (-0.3 * state.w0 if state.w0 < 0.0 else 0.0)

    return push


def _oval_wheel(vehicle: Vehicle) -> Push:
    def push(state: State) -> tuple[float, float, float]:
        uneven = 0.12 * math.sin(state.left_angle)
        rim = vehicle.wheel_radius_m * state.left_speed
        return 0.5 * uneven * rim, 0.0, -uneven * rim / vehicle.track_width_m

    return push


def _grass_patch(vehicle: Vehicle) -> Push:
    del vehicle

    def push(state: State) -> tuple[float, float, float]:
        inside = math.sin(state.x / 1.5) > 0.0
        return (-0.25 * state.v0 if inside else 0.0), 0.0, 0.0

    return push


def _magnetic_floor(vehicle: Vehicle) -> Push:
    size = 0.08 * vehicle.max_turn_radps

    def push(state: State) -> tuple[float, float, float]:
        moving = min(abs(state.v0) / 0.1, 1.0)
        return 0.0, 0.0, size * math.sin(2.0 * state.yaw) * moving

    return push


def _turn_climb(vehicle: Vehicle) -> Push:
    size = 0.12 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        return 0.0, size * math.tanh(2.0 * state.w0) * abs(state.w0) / (0.3 + abs(state.w0)), 0.0

    return push


def _fast_left(vehicle: Vehicle) -> Push:
    threshold = 0.4 * vehicle.max_speed_mps

    def push(state: State) -> tuple[float, float, float]:
        over = max(abs(state.v0) - threshold, 0.0)
        return 0.0, 0.25 * over, 0.0

    return push


def _sinkage(vehicle: Vehicle) -> Push:
    """Ruts deepen on the way: wheels that dig in lose ever more of their speed."""
    way, deep = 0.0, 150.0 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        nonlocal way
        way = 0.0 if state.t < state.dt else way + abs(state.v0) * state.dt
        lost = 0.3 * (1.0 - math.exp(-way / deep))
        return -lost * state.v0, 0.0, -lost * state.w0

    return push


def _saturating_skid(vehicle: Vehicle) -> Push:
    most = 0.05 * min(vehicle.max_speed_mps, 2.0)

    def push(state: State) -> tuple[float, float, float]:
        return 0.0, -most * math.tanh(0.3 * state.v0 * state.w0 / most), 0.0

    return push


def _crests(vehicle: Vehicle) -> Push:
    """Wheels that the ground falls away from grip less: the speed ahead falls short where pitch grows."""
    del vehicle
    before = 0.0

    def push(state: State) -> tuple[float, float, float]:
        nonlocal before
        falls = (state.pitch - before) / state.dt * math.copysign(1.0, state.v0) / max(abs(state.v0), 0.05)
        before = state.pitch
        return -0.35 * state.v0 * min(max(falls / 0.1, 0.0), 1.0), 0.0, 0.0

    return push


def _lock_sides(vehicle: Vehicle, drive: Drive) -> Drive:
    """Within 0.2 s of a change of speed by a quarter of the largest the axle locks for 2 s."""
    mean, difference = 0.5 * (drive.left + drive.right), drive.right - drive.left
    hard = 0.25 * vehicle.max_speed_mps / vehicle.wheel_radius_m
    before = round(0.2 / drive.step_s)
    jump = np.abs(mean - np.concatenate((np.zeros(before), mean[:-before]))) > hard
    last = np.maximum.accumulate(np.where(jump, np.arange(mean.size), -mean.size))
    locked = np.arange(mean.size) - last < 2.0 / drive.step_s
    difference = np.where(locked, 0.3, 1.0) * difference
    return replace(drive, left=mean - 0.5 * difference, right=mean + 0.5 * difference)


def _wind_up(vehicle: Vehicle, drive: Drive) -> Drive:
    """Proportional and integral speed control of a motor of 0.5 s whose voltage is limited."""
    fastest = vehicle.max_speed_mps + 0.5 * vehicle.track_width_m * vehicle.max_turn_radps
    top, step_s = fastest / vehicle.wheel_radius_m, drive.step_s

    def regulate(asked: Floats) -> Floats:
        gathered = 0.0

        def step(now: float, goal: float) -> float:
            nonlocal gathered
            gathered += 3.0 * (goal - now) * step_s
            voltage = min(max(goal + (goal - now) + gathered, -top), top)
            return now + (voltage - now) * step_s / 0.5

        return follow(asked, step)

    return replace(drive, left=regulate(drive.left), right=regulate(drive.right))


ODD: dict[str, Odd] = {
    "crosswind": Odd("a steady wind pushes in one direction of the world", "xy", _crosswind),
    "reverse_slip": Odd("wheels slip in reverse only", "x", _reverse_slip),
    "right_turns": Odd("turning right falls short, turning left does not", "w", _right_turns),
    "oval_wheel": Odd("the left wheel is out of round", "xw", _oval_wheel),
    "grass_patch": Odd(
        "stripes of grass across the map slow it down", "x", _grass_patch, alike=("terrain_change",)
    ),
    "magnetic_floor": Odd(
        "the floor turns the vehicle towards two directions of the world", "w", _magnetic_floor
    ),
    "turn_climb": Odd(
        "sideways motion that saturates with the yaw rate", "y", _turn_climb, alike=("icr_offset",)
    ),
    "fast_left": Odd("above a speed the vehicle is pushed to the left", "y", _fast_left),
}
DRAWN = tuple(sorted(ODD))
"""What a seed may draw; the rest is asked for by name, so that every seed draws what it always drew."""
# Real, but without a name of their own: `time_drift` and `lateral_skid` say what sinkage and a skid that
# saturates do to a planner; what an integrator or a lock does takes three numbers or more of one controller,
# and is flagged; of crests the tilt of poses tells too little.
ODD |= {
    "locked_axle": Odd("after a hard start both sides turn together for a while", "w", drive=_lock_sides),
    "wind_up": Odd("the integrator of the speed loop winds up", "xw", drive=_wind_up),
    "sinkage": Odd("wheels dig in on the way", "xw", _sinkage, alike=("time_drift",)),
    "saturating_skid": Odd("skid sideways that saturates", "y", _saturating_skid, alike=("lateral_skid",)),
    "crests": Odd(
        "wheels lose grip over crests", "x", _crests, ground=Ground(hill_m=0.25, hill_length_m=10.0)
    ),
}
