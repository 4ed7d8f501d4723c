"""What recordings can show of an effect: what was asked for, and which sensors tell of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pipeline.core.arrays import Floats

Relative = Literal["", "speed", "turn", "wheel", "duration"]

# Of poses, headings and encoders against each other [s]: below it they are stamped no better.
LEAST_DELAY_S = 0.012

_STANDING = 0.05
_NEVER = 0.02
# Above this share of the largest that was asked for, a limit cuts nothing off.
_REACHED = 0.99


@dataclass(frozen=True)
class Largest:
    """What relative starts are shares of: the largest that was commanded, and when it was.

    Attributes:
        speed, turn, wheel: speed [m/s], yaw rate [rad/s], wheel speed [rad/s].
        difference: of the wheel speeds [rad/s].
        moments: times [s] before which the tenths of the way of the fastest wheel lie, shape (11,).
        sideways: speed to the left or right [m/s].
        turns: the moments of the turning, where it has others.
    """

    speed: float
    turn: float
    wheel: float
    difference: float
    moments: Floats
    sideways: float = 0.0
    turns: Floats | None = None

    @property
    def fastest(self) -> float:
        """Largest speed [m/s], ahead or to a side."""
        return max(self.speed, self.sideways)

    @property
    def moves_both_ways(self) -> bool:
        """Whether a run both drives and turns."""
        return min(self.fastest, self.turn) > _STANDING

    @property
    def is_one_motion(self) -> bool:
        """Driven straight only, or turned on the spot only."""
        return min(self.fastest, self.turn) < _NEVER * max(self.fastest, self.turn)

    def take(self, share: float, of: Relative) -> float:
        """A share of what was asked for; the number itself where it is no share.

        Args:
            share: of the largest; for the `duration` the part of the driving that is done by then.
            of: which.
        """
        if of == "duration":
            return float(self.moments[round(share * (self.moments.size - 1))])
        whole = {"speed": self.speed, "turn": self.turn, "wheel": self.wheel}
        return share * whole.get(of, 1.0)

    def is_within(self, time_s: float) -> bool:
        """Whether there is driving, and turning, on both sides of a moment: a seventh of each."""
        known = (self.moments,) if self.turns is None else (self.moments, self.turns)
        return all(
            0.5 * (tenths[1] + tenths[2]) <= time_s <= 0.5 * (tenths[-3] + tenths[-2]) for tenths in known
        )

    def reaches(self, limit: float, of: Relative) -> bool:
        """Whether commands went beyond a limit of `speed`, `turn` or `wheel` speed."""
        return limit <= self.take(_REACHED, of)


@dataclass(frozen=True)
class Conditions:
    """What the recordings of a search can show.

    Attributes:
        largest: what was asked for.
        encoders: whether every run has measured wheels.
        gyro: whether every run has a good gyro as heading and clock.
        least_delay_s: delays and lags below it are a matter of sampling the wheels [s].
        exceeded: what measured wheels exceed for a good part of the time: `speed`, `turn`, `wheel`.
    """

    largest: Largest
    encoders: bool = False
    gyro: bool = False
    least_delay_s: float = 0.0
    exceeded: Mapping[str, float] = field(default_factory=dict)
