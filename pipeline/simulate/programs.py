"""Command programs, from functions of a seed or from files, on held signals."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.core import Floats
from pipeline.simulate.facts import SimulateError, Vehicle, open_stream, unknown_name
from pipeline.simulate.scenario import Commands, Program, Scenario, integrate_cells

# Held signals, first-order lags, rate limits and coloured noise on a uniform grid.
#
# A signal lives on cells of ``step`` seconds: entry k is its mean over [k step, (k+1) step].


def hold_on_grid(
    event_s: Floats, values: Floats, *, delay_s: float, step_s: float, cell_count: int
) -> Floats:
    """Cell means of a signal that keeps each value until the next event, shifted by a delay.

    Exact for any event times: a cell that holds an event gets the time-weighted mean of both values.

    Args:
        event_s: increasing times [s], shape (n,); the signal is zero before the first.
        values: value from that time on, shape (n,).
        delay_s: shift towards later [s].
        step_s: cell width [s].
        cell_count: number of cells.

    Returns:
        Cell means, shape (cell_count,).
    """
    edges = np.arange(cell_count + 1) * step_s - delay_s
    padded = np.concatenate(([0.0], values))
    at_start = np.searchsorted(event_s, edges[:-1], side="right")
    at_end = np.searchsorted(event_s, edges[1:], side="left")
    held = padded[at_start]
    mixed = np.flatnonzero(at_start < at_end)
    if mixed.size:
        knots = np.concatenate((event_s, [max(event_s[-1], edges[-1]) + 1.0]))
        integral = np.concatenate(([0.0], np.cumsum(values * np.diff(knots))))
        area = np.interp(edges[mixed + 1], knots, integral) - np.interp(edges[mixed], knots, integral)
        held[mixed] = area / step_s
    return held


def lag_signal(signal: Floats, *, tau_s: float, step_s: float) -> Floats:
    """First-order lag from rest, exact for a signal constant in each cell: tau dy/dt = u - y.

    Without a time constant it is the signal itself.
    """
    if tau_s <= 0.0:
        return signal
    decay = float(np.exp(-step_s / tau_s))
    at_end = filter_pole(signal * (1.0 - decay), decay)
    return 0.5 * (at_end + np.concatenate(([0.0], at_end[:-1])))


def filter_pole(signal: Floats, pole: float) -> Floats:
    """The recurrence y_k = pole y_(k-1) + u_k from rest."""
    from scipy.signal import lfilter  # noqa: PLC0415 - heavy, and the room is imported by the command line

    return np.asarray(lfilter([1.0], [1.0, -pole], signal), dtype=np.float64)


def follow(signal: Floats, step: Callable[[float, float], float]) -> Floats:
    """Follow a signal from rest, cell by cell: what is there and what is asked give what is there next.

    For what depends on its own past and has no closed form for arbitrary input; floats in a plain list are
    several times faster here than elements of an array.
    """
    now, out = 0.0, []
    for target in signal.tolist():
        now = step(now, target)
        out.append(now)
    return np.array(out)


def limit_rate(signal: Floats, *, per_second: float, step_s: float) -> Floats:
    """Follow a signal from rest with at most ``per_second`` of change a second."""
    largest = per_second * step_s

    def step(now: float, target: float) -> float:
        gap = target - now
        return target if -largest <= gap <= largest else now + (largest if gap > 0.0 else -largest)

    return follow(signal, step)


def make_coloured_noise(
    generator: np.random.Generator, *, size: int, deviation: float, correlation_s: float, step_s: float
) -> Floats:
    """Stationary first-order Gauss-Markov noise (size,), autocorrelation exp(-|t|/correlation_s)."""
    pole = float(np.exp(-step_s / correlation_s))
    white = generator.standard_normal(size)
    drive = white * np.sqrt(1.0 - pole**2)
    if size:
        drive[0] = white[0]
    return filter_pole(drive * deviation, pole)


def walk_in_plane(along: Floats, aside: Floats, heading: Floats, *, step_s: float) -> Floats:
    """Places from the origin on of a body that moves so [m/s], shape (n,), in the plane, shape (n + 1, 3).

    Args:
        along: its speed ahead.
        aside: its speed to the left.
        heading: at the edges of the steps [rad], shape (n + 1,).
        step_s: length of a step [s].
    """
    middle = 0.5 * (heading[:-1] + heading[1:])
    cosine, sine = np.cos(middle), np.sin(middle)
    x = integrate_cells(along * cosine - aside * sine, step_s=step_s)
    y = integrate_cells(along * sine + aside * cosine, step_s=step_s)
    return np.stack((x, y, np.zeros_like(heading)), axis=1)


# Command programs: what a driver or a test protocol asks of the vehicle.
#
# Every program is a function of its seed; a turn is a yaw rate [rad/s] on a differential vehicle and a
# steering angle [rad] on a car.


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


def _steps(time: Floats, space: _Space, *, ahead: float = 1.0, turning: float = 1.0) -> Drawn:
    """Steps drawn uniformly from the command space, as in the DRIVE protocol: both ways, both directions.

    Of speed, or of turning on the spot, where the other is zero.
    """
    count = int(time[-1] // space.step_s) + 1
    speed = space.generator.uniform(-space.speed, space.speed, count)
    turn = space.generator.uniform(-space.turn, space.turn, count)
    which = (time // space.step_s).astype(np.intp)
    return ahead * speed[which], turning * turn[which]


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


def _circle(time: Floats, space: _Space) -> Drawn:
    """One circle for ever, at 60 % of both limits."""
    return np.full(time.size, 0.6 * space.speed), np.full(time.size, 0.6 * space.turn)


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
    """A person with a joystick: quantised steps of uneven length, and zero when released."""
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
    "straight": partial(_steps, turning=0.0),
    "circle": _circle,
    "spins": partial(_steps, ahead=0.0),
    "slalom": _slalom,
    "stop_and_go": _stop_and_go,
    "teleop": _teleop,
}


# Fields of speed and turn; a turn is a steering angle for a car, a yaw rate else.
_STEERED = {
    "ackermann_msgs/msg/AckermannDrive": ("speed", "steering_angle"),
    "ackermann_msgs/msg/AckermannDriveStamped": ("drive.speed", "drive.steering_angle"),
}
_TURNED = {
    "geometry_msgs/msg/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/msg/TwistStamped": ("twist.linear.x", "twist.angular.z"),
}
# Wheel speeds [rad/s], a topic a side.
_SIDE = "std_msgs/msg/Float64"


def read_played(path: Path, vehicle: Vehicle) -> Commands:
    """Body commands of a recording, at the times at which a player would send them.

    Raises:
        SimulateError: ``nothing_to_play``, no topic has commands for this vehicle.
        LogError: the recording cannot be read.
    """
    from pipeline.logs import Wanted, open_log, read_topics  # noqa: PLC0415 - heavy

    types = _STEERED if vehicle.kind == "ackermann" else _TURNED
    index = open_log(path)
    topic = next((channel.topic for channel in index.channels if channel.type_name in types), None)
    sides = sorted(channel.topic for channel in index.channels if channel.type_name == _SIDE)
    if topic is None and len(sides) == 2 and vehicle.kind == "differential":  # noqa: PLR2004 - left and right
        topics = read_topics(index, [Wanted(side) for side in sides])
        left, right = (topics.of(side)[0] for side in sides)
        rates = [np.asarray(one.fields["data"], dtype=np.float64) for one in (left, right)]
        half = vehicle.lever_m * vehicle.controller_track_multiplier
        speed = 0.5 * vehicle.wheel_radius_m * (rates[0] + rates[1])
        turn = 0.5 * vehicle.wheel_radius_m * (rates[1] - rates[0]) / half
        return Commands((left.log_time - left.log_time[0]) * 1e-9, speed, turn, None)
    if topic is None:
        what = f"no topic has commands that a vehicle of kind {vehicle.kind} is driven with"
        hint = f"Give a recording with {' or '.join(types)}, or {_SIDE} for the left and the right wheels."
        raise SimulateError("nothing_to_play", what, where=str(path), hint=hint)
    columns = read_topics(index, [Wanted(topic)]).of(topic)[0]
    speed, turn = (np.asarray(columns.fields[name], dtype=np.float64) for name in types[columns.type_name])
    times = (columns.log_time - columns.log_time[0]) * 1e-9
    sideways = np.zeros_like(speed) if vehicle.moves_sideways else None
    return Commands(times, speed, turn, sideways)
