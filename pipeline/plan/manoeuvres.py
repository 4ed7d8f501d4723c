"""The library of manoeuvres: short sequences of body commands that end where they began.

Every manoeuvre drives a way and then drives it back: commands of the way back are those of the way there, in
reverse order and with the other sign of the speed. An ideal vehicle retraces its path, so that manoeuvres can
follow each other in any order inside a small area, and each has both signs of everything.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.plan.limits import Limits, is_steered
from pipeline.vehicles import Vehicle

RATE_HZ = 20.0
LEAD_S = 3.0
"""Zero commands before anything moves [s]."""
REST_S = 1.0
"""Zero commands after every manoeuvre [s]: what follows late has settled before the next begins."""
_SHARES = (0.25, 0.5, 1.0)
_SMALL = 0.06
_HOLDS_S = (1.5, 4.0)
_SWEEP_S = 8.0
_SWEEP_HZ = (0.15, 1.2)


@dataclass(frozen=True)
class Commands:
    """Body commands, each held until the next.

    Attributes:
        speed: [m/s], shape (n,), one every 1 / `RATE_HZ` seconds.
        turn: yaw rate [rad/s], or steering angle [rad] on a car, shape (n,).
    """

    speed: Floats
    turn: Floats

    @property
    def times(self) -> Floats:
        """Since the first command [s], shape (n,)."""
        return np.arange(self.speed.size) / RATE_HZ

    @property
    def duration_s(self) -> float:
        """Until the last command has ended."""
        return self.speed.size / RATE_HZ


@dataclass(frozen=True)
class Manoeuvre:
    """A name that says what is driven, and the commands, the rest at the end included."""

    name: str
    commands: Commands


def wait(seconds: float) -> Commands:
    """Zero commands."""
    zeros = np.zeros(round(seconds * RATE_HZ))
    return Commands(zeros, zeros)


def join(pieces: Sequence[Commands]) -> Commands:
    """One after the other."""
    return Commands(np.concatenate([p.speed for p in pieces]), np.concatenate([p.turn for p in pieces]))


def list_manoeuvres(vehicle: Vehicle, limits: Limits) -> tuple[Manoeuvre, ...]:
    """All manoeuvres of a vehicle within its limits; one on the spot is none for a car."""
    steered = is_steered(vehicle)
    found: list[Manoeuvre] = []

    def add(name: str, *stages: tuple[float, float, float], end: str = "") -> None:
        there = hold_within(stages, vehicle, limits)
        # What is reached: short stages and narrow limits leave some targets far away.
        fast, turning = (
            float(v[np.abs(v).argmax()]) for v in (there.speed, np.copysign(there.turn, stages[0][1]))
        )
        reached = [f"{fast:.2g} m/s"] if fast else []
        reached += [f"{turning:.2g} {unit}"] if turning else []
        found.append(Manoeuvre(f"{name} {', '.join(reached)}{end}", _go_and_return(there, steered=steered)))

    speed, turn = limits.speed_mps, limits.turn
    unit = "rad" if steered else "rad/s"
    for share in (_SMALL, *_SHARES):
        for hold in _HOLDS_S:
            add("straight at", (share * speed, 0.0, hold), end=f", {hold:g} s")
            if not steered:
                add("spin at", (0.0, share * turn, hold), end=f", {hold:g} s")
                add("spin at", (0.0, -share * turn, hold), end=f", {hold:g} s")
    for fast in _SHARES:
        for round_ in (_SMALL, *_SHARES):
            for side in (1.0, -1.0):
                at = (fast * speed, side * round_ * turn)
                for hold in _HOLDS_S:
                    add("arc at", (*at, hold), end=f", {hold:g} s")
                add("S at", (*at, 2.0), (at[0], -at[1], 2.0))
    for share in _SHARES:
        add(
            "steps of speed to",
            (0.3 * share * speed, 0.0, 1.5),
            (share * speed, 0.0, 1.5),
            (0.0, 0.0, 1.0),
        )
        sweep = _sweep(share * speed, turn)
        there = _limit(*sweep, vehicle, limits)
        found.append(
            Manoeuvre(f"sine sweep at {share * speed:.2g} m/s", _go_and_return(there, steered=steered))
        )
    # Targets that are not reached make the same drive several times.
    different = {(one.commands.speed.tobytes(), one.commands.turn.tobytes()): one for one in found}
    return tuple(different.values())


def hold_within(stages: Sequence[tuple[float, float, float]], vehicle: Vehicle, limits: Limits) -> Commands:
    """Targets of (speed, turn, seconds) held one after the other."""
    counts = [round(seconds * RATE_HZ) for _, _, seconds in stages]
    return _limit(
        np.repeat([speed for speed, _, _ in stages], counts),
        np.repeat([turn for _, turn, _ in stages], counts),
        vehicle,
        limits,
    )


def _sweep(speed: float, turn: float) -> tuple[Floats, Floats]:
    """Constant speed while the turn swings faster and faster."""
    time = np.arange(round(_SWEEP_S * RATE_HZ)) / RATE_HZ
    low, high = _SWEEP_HZ
    phase = 2.0 * np.pi * (low * time + 0.5 * (high - low) * time**2 / _SWEEP_S)
    return np.full(time.size, speed), turn * np.sin(phase)


def _limit(speed: Floats, turn: Floats, vehicle: Vehicle, limits: Limits) -> Commands:
    """Targets brought within the limits: ramps from and to standing, slower turns where it is fast."""
    rate = limit_yaw_rate(speed, vehicle, limits)
    held = np.clip(turn, -rate, rate)
    # The slowest ramp down has room after the last target.
    slowest = max(limits.speed_mps / limits.acceleration_mps2, limits.turn / limits.turn_rate)
    room = np.zeros(int(np.ceil(RATE_HZ * slowest)) + 1)
    speeds = _ramp(np.append(speed, room), limits.acceleration_mps2 / RATE_HZ)
    turns = _ramp(np.append(held, room), limits.turn_rate / RATE_HZ)
    rate = limit_yaw_rate(speeds, vehicle, limits)
    # A turn that its own ramp leaves behind is cut at most where a slower speed allows more anyway.
    turns = np.clip(turns, -rate, rate)
    last = np.flatnonzero((speeds != 0.0) | (turns != 0.0))
    end = int(last[-1]) + 2 if last.size else 1
    return Commands(speeds[:end], turns[:end])


def limit_yaw_rate(speed: Floats, vehicle: Vehicle, limits: Limits) -> Floats:
    """The largest turn at each speed: the vehicle's own, and what the lateral acceleration allows."""
    fast = np.maximum(np.abs(speed), 1e-6)
    rate = np.minimum(limits.lateral_mps2 / fast, limits.yaw_rate_radps)
    if not is_steered(vehicle):
        return np.minimum(rate, limits.turn)
    return np.minimum(np.arctan(rate * (vehicle.wheelbase_m or 1.0) / fast), limits.turn)


def _ramp(target: Floats, step: float) -> Floats:
    """Follow a target from zero by at most a step a command."""
    values = np.empty_like(target)
    value = 0.0
    for index, wanted in enumerate(target.tolist()):
        value += min(max(wanted - value, -step), step)
        values[index] = value
    return values


def _go_and_return(there: Commands, *, steered: bool) -> Commands:
    """There and back: a yaw rate changes its sign with the speed, a steering angle stays."""
    sign = 1.0 if steered else -1.0
    back = Commands(-there.speed[::-1], sign * there.turn[::-1])
    return join((there, back, wait(REST_S)))
