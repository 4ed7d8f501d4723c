"""Command programs: what a driver or a test protocol asks of the vehicle.

Every program is a function of its seed; a turn is a yaw rate [rad/s] on a differential vehicle and a
steering angle [rad] on a car.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.simulate.errors import SimulateError, unknown_name
from pipeline.simulate.scenario import Program, Scenario
from pipeline.simulate.signals import make_coloured_noise
from pipeline.simulate.streams import open_stream
from pipeline.simulate.vehicles import Vehicle


@dataclass(frozen=True)
class Commands:
    """Body commands at their own stamps.

    Attributes:
        time_s: increasing, shape (n,).
        speed_mps: shape (n,).
        turn: yaw rate [rad/s] or steering angle [rad], shape (n,).
        sideways_mps: speed to the left, shape (n,); None on a vehicle that cannot.
    """

    time_s: Floats
    speed_mps: Floats
    turn: Floats
    sideways_mps: Floats | None = None

    @property
    def sideways(self) -> Floats:
        """Speed to the left [m/s], zero on a vehicle that cannot, shape (n,)."""
        return np.zeros_like(self.speed_mps) if self.sideways_mps is None else self.sideways_mps

    def yaw_rate(self, vehicle: Vehicle) -> Floats:
        """The yaw rate that is asked for [rad/s], which a car's steering stands for."""
        if vehicle.kind != "ackermann":
            return self.turn
        return self.speed_mps * np.tan(self.turn) / vehicle.wheelbase_m


@dataclass(frozen=True)
class _Space:
    """The command space a program draws from, and the random numbers it draws with."""

    speed: float
    turn: float
    step_s: float
    rate_hz: float
    generator: np.random.Generator


Drawn = tuple[Floats, Floats]


def make_commands(
    program: Program, vehicle: Vehicle, *, duration_s: float, generator: np.random.Generator
) -> Commands:
    """Draw the commands of a run.

    Args:
        program: which manoeuvre, and how much of the command space.
        vehicle: limits of that space.
        duration_s: length of the run.
        generator: source of randomness.

    Raises:
        SimulateError: ``unknown_program``, or ``wrong_vehicle`` for spins with a car.
    """
    if program.name not in _PROGRAMS:
        raise unknown_name("program", program.name, sorted(_PROGRAMS))
    car = vehicle.kind == "ackermann"
    if car and program.name == "spins":
        raise SimulateError(
            "wrong_vehicle", "a car cannot spin on the spot", where="spins", hint="Choose circle or slalom"
        )
    space = _Space(
        speed=vehicle.max_speed_mps * program.speed_scale,
        turn=(vehicle.max_steering_rad if car else vehicle.max_turn_radps) * program.turn_scale,
        step_s=program.step_s,
        rate_hz=program.rate_hz,
        generator=generator,
    )
    count = max(int(duration_s * program.rate_hz), 2)
    time = np.arange(count) / program.rate_hz
    speed, turn = _PROGRAMS[program.name](time, space)
    sideways = None
    if vehicle.moves_sideways:
        # Sideways motion is asked for as turning is, at other moments of the same steps.
        _, sideways = _PROGRAMS[program.name](
            time, replace(space, turn=vehicle.max_sideways_mps * program.speed_scale)
        )
        sideways = np.nan_to_num(sideways)
    stamps = _jitter_stamps(time, program, generator)
    live = np.isfinite(speed)
    resting = (time < program.lead_s) | (time > duration_s - program.lead_s)
    moving = np.where(resting | ~live, 0.0, 1.0)
    speed, turn = np.nan_to_num(speed) * moving, np.nan_to_num(turn) * moving
    if sideways is not None:
        sideways = (sideways * moving)[live]
    return Commands(stamps[live], speed[live], turn[live], sideways)


def make_wishes(scenario: Scenario, purpose: str) -> Commands:
    """Smooth commands of a planner that the vehicle is not driven by; `purpose` names their random stream."""
    generator = open_stream(scenario.seed, purpose)
    smooth = Program("smooth", rate_hz=10.0)
    return make_commands(smooth, scenario.vehicle, duration_s=scenario.duration_s, generator=generator)


def _jitter_stamps(time: Floats, program: Program, generator: np.random.Generator) -> Floats:
    # Half the period bounds the jitter: the order of commands is never swapped.
    bound = 0.45 / program.rate_hz
    noise = np.clip(generator.standard_normal(time.size) * program.jitter_s, -bound, bound)
    # A phase keeps commands off the instants of the poses, as on any robot.
    phase = 0.37 / program.rate_hz
    return time + phase + noise


def _steps(time: Floats, space: _Space) -> Drawn:
    """Steps drawn uniformly from the command space, as in the DRIVE protocol: both ways, both directions."""
    count = int(time[-1] // space.step_s) + 1
    speed = space.generator.uniform(-space.speed, space.speed, count)
    turn = space.generator.uniform(-space.turn, space.turn, count)
    which = (time // space.step_s).astype(np.intp)
    return speed[which], turn[which]


def _ramps(time: Floats, space: _Space) -> Drawn:
    """Speed ramps up and down, forward and backward, while the turn goes through slower ramps."""
    return (
        space.speed * _triangle(time / (4.0 * space.step_s)),
        space.turn * _triangle(time / (4.0 * space.step_s) * 0.381966),
    )


def _triangle(cycles: Floats) -> Floats:
    return 2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * cycles))


def _smooth(time: Floats, space: _Space) -> Drawn:
    """Slowly varying random speed, mostly forward, and turn."""
    step = 1.0 / space.rate_hz
    speed = make_coloured_noise(
        space.generator, size=time.size, deviation=1.0, correlation_s=space.step_s, step_s=step
    )
    turn = make_coloured_noise(
        space.generator, size=time.size, deviation=1.0, correlation_s=space.step_s / 2.0, step_s=step
    )
    window = np.hanning(max(int(space.rate_hz), 3))
    window /= window.sum()
    speed, turn = np.convolve(speed, window, "same"), np.convolve(turn, window, "same")
    return space.speed * np.tanh(0.6 * speed + 0.4), space.turn * np.tanh(0.8 * turn)


def _straight(time: Floats, space: _Space) -> Drawn:
    """Steps of speed only, both directions."""
    speed, turn = _steps(time, space)
    return speed, turn * 0.0


def _circle(time: Floats, space: _Space) -> Drawn:
    """One circle for ever, at 60 % of both limits."""
    return np.full(time.size, 0.6 * space.speed), np.full(time.size, 0.6 * space.turn)


def _spins(time: Floats, space: _Space) -> Drawn:
    """Steps of turning on the spot, both ways."""
    speed, turn = _steps(time, space)
    return speed * 0.0, turn


def _slalom(time: Floats, space: _Space) -> Drawn:
    """Steady forward speed, sinusoidal turn."""
    return (
        np.full(time.size, 0.7 * space.speed),
        0.8 * space.turn * np.sin(2.0 * np.pi * time / (2.0 * space.step_s)),
    )


def _stop_and_go(time: Floats, space: _Space) -> Drawn:
    """Every other step stands still."""
    speed, turn = _steps(time, space)
    going = np.where((time // space.step_s) % 2 == 0, 0.0, 1.0)
    return speed * going, turn * going


def _teleop(time: Floats, space: _Space) -> Drawn:
    """A person with a joystick: quantised steps of uneven length, and nothing at all when released."""
    edges = np.cumsum(space.generator.uniform(0.3, 1.0, time.size) * space.step_s)
    which = np.searchsorted(edges, time)
    speed = np.clip(space.generator.normal(0.4, 0.5, time.size), -1.0, 1.0)[which]
    turn = np.clip(space.generator.normal(0.0, 0.5, time.size), -1.0, 1.0)[which]
    released = space.generator.uniform(size=time.size)[which] < 0.15  # noqa: PLR2004 - share of idle time
    window = np.hanning(max(int(0.4 * space.rate_hz), 3))
    window /= window.sum()
    pushed = np.convolve(speed, window, "same"), np.convolve(turn, window, "same")
    speed, turn = (np.round(axis * 32.0) / 32.0 for axis in pushed)
    return np.where(released, np.nan, space.speed * speed), np.where(released, np.nan, space.turn * turn)


_PROGRAMS: dict[str, Callable[[Floats, _Space], Drawn]] = {
    "drive_steps": _steps,
    "ramps": _ramps,
    "smooth": _smooth,
    "straight": _straight,
    "circle": _circle,
    "spins": _spins,
    "slalom": _slalom,
    "stop_and_go": _stop_and_go,
    "teleop": _teleop,
}
