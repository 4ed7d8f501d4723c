"""The numbers of an effect: units, bounds, levels, and what recordings can show of them."""

import enum
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from pipeline.core.arrays import Floats


class Level(enum.Enum):
    """What a number of an effect belongs to."""

    VEHICLE = "vehicle"
    TERRAIN = "terrain"
    RUN = "run"


@dataclass(frozen=True)
class Reading:
    """What a number stands for if it belongs to a level.

    Attributes:
        level: the level.
        name: what it is called then.
        text: what it is then, in words.
    """

    level: Level
    name: str
    text: str


# What a number of an effect is to a controller: quantities of a vehicle that controllers know.
#
# An effect says which quantities its numbers are (`Parameter.quantities`), a target which of its parameters
# takes which quantity; neither knows the other.

Joined = Callable[[Iterable[float]], float]


class Quantity(enum.Enum):
    """A quantity, and how the numbers of several effects that are the same quantity join into one.

    Attributes:
        unit: SI, `1` for a plain number.
        join: of the numbers: effects multiply a gain, add up a delay, and the smallest limit holds.
    """

    RADIUS = ("effective over nominal wheel radius", "1", math.prod)
    RADIUS_DIFFERENCE = ("right radius less left radius over their mean", "1", math.fsum)
    TRACK = ("effective over nominal track", "1", math.prod)
    COMMAND_DELAY = ("dead time of a command", "s", math.fsum)
    SPEED_LAG = ("time constant of the speed", "s", math.fsum)
    TURN_LAG = ("time constant of turning by the difference of wheel speeds", "s", math.fsum)
    STEERING_LAG = ("time constant of the steering angle", "s", math.fsum)
    STEERING_GAIN = ("steering angle over its command", "1", math.prod)
    STEERING_OFFSET = ("steering angle, left positive, at which straight ahead is asked", "rad", math.fsum)
    SPEED_LIMIT = ("largest commanded speed", "m/s", min)
    TURN_LIMIT = ("largest commanded yaw rate", "rad/s", min)
    WHEEL_SPEED_LIMIT = ("largest wheel speed", "rad/s", min)
    WHEEL_ACCELERATION_LIMIT = ("largest wheel acceleration", "rad/s^2", min)
    DEADBAND = ("largest nominal speed at the rim for which a wheel stands still", "m/s", max)

    def __init__(self, about: str, unit: str, join: Joined) -> None:
        self.about = about
        self.unit = unit
        self.join = join


class TwinRole(enum.Enum):
    """What an effect is to a body on wheels that servos drive, the exported twin.

    The servos' own numbers come first, then those of the wheels, of the contact and of the centre of mass.
    """

    DELAY = "dead time before the servos"
    WHEEL_LIMIT = "largest wheel speed of the servos"
    SPEED_LAG = "time constant of all driven wheels"
    SIDE_LAGS = "time constants of the left and of the right wheels"
    SPEED_GAIN = "wheel speed over its command"
    SIDE_GAIN = "gain of the right wheels less that of the left ones"
    STEERING_LAG = "time constant of the steering"
    STEERING_GAIN = "steering angle over its command"
    STEERING_OFFSET = "steering angle at which straight ahead is asked"
    STEERING_MOUNT = "steering angle at which straight ahead is measured"
    RADIUS = "effective over nominal wheel radius"
    RADIUS_DIFFERENCE = "right radius less left radius over their mean"
    TRACK = "effective over nominal track"
    CREEP = "time constant by which the body follows its wheels"
    CREEP_ASIDE = "time constant of creep along the axles"
    CREEP_OF_STEERED = "creep along the steered axle that grows with speed"
    CENTRE_AHEAD = "centre of rotation ahead of base_link"
    CENTRE_ASIDE = "centre of rotation left of base_link"


Relative = Literal["", "speed", "turn", "wheel", "duration"]

# Of poses, headings and encoders against each other [s]: below it they are stamped no better.
LEAST_DELAY_S = 0.012

_STANDING = 0.05
"""Speed [m/s, rad/s] that a run must reach in both to count as driving and turning."""
_NEVER = 0.02
"""Share of the larger of speed and yaw rate, below which a run never drove, or never turned."""
# Above this share of the largest that was asked for, a limit cuts nothing off.
_REACHED = 0.99
EXCEEDED_SHARE = 0.005
"""Share of the time in which wheels may exceed a limit: two windows of a run of some minutes may be wrong."""
OVERSHOOT = 1.05
"""Wheels run over their limit by no more: rounding of encoders and a motor that overshoots."""


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
        exceeded: what measured wheels exceed for half a second in `EXCEEDED_SHARE` of the time: `speed`,
            `turn`, `wheel`.
        slope_rad: half of what pitch varies by for nine tenths of the time; zero where it was not recorded.
    """

    largest: Largest
    encoders: bool = False
    gyro: bool = False
    least_delay_s: float = 0.0
    exceeded: Mapping[str, float] = field(default_factory=dict)
    slope_rad: float = 0.0

    def attain(self, limit: float, of: Relative) -> bool:
        """Whether commands went beyond a limit, and measured wheels, where there are any, came up to it."""
        return self.largest.reaches(limit, of) and limit <= OVERSHOOT * self.exceeded.get(of, math.inf)


UNDETERMINED = "undetermined"
"""Behind a fitted number that its runs leave open."""
_MARGIN = 1e-6
"""Of the size of the bounds: fits stop that close to them."""


def stands_at_bound(value: float, bounds: tuple[float, float]) -> bool:
    """Whether a number stopped because it may go no further."""
    low, high = bounds
    margin = _MARGIN * (abs(low) + abs(high)) if math.isfinite(low + high) else 0.0
    return not low + margin < value < high - margin


def cut_interval(low: float, high: float, bounds: tuple[float, float]) -> tuple[float, float]:
    """An interval within what the number can be; NaN stays NaN."""
    least, most = bounds
    return max(low, least), min(high, most)


class Excitation(enum.Enum):
    """What a run must contain for an effect to leave a trace of its own."""

    DRIVING = "driving"
    TURNING = "turning both ways"
    SPEED_SPREAD = "several speeds"
    BOTH_SIGNS = "driving forward and backward"
    CHANGES = "changes of command"
    SLOPE = "slopes in several directions"
    LARGE = "commands near the limits"
    SMALL = "commands near zero"
    LONG = "a run of several minutes"
    STEERING = "steering to both sides"
    SIDEWAYS = "driving sideways"


class Search(enum.Enum):
    """How a parameter is found: from one start, from several, or on a shrinking grid if it is not smooth."""

    DIRECT = "direct"
    STARTS = "starts"
    GRID = "grid"


@dataclass(frozen=True)
class Least:
    """The smallest size of a number that is worth a name.

    Attributes:
        size: distance from the neutral value, in the parameter's unit.
        reason: what makes as much of nothing, however small the interval is.
        sampled: how many times the delay that sampling the wheels feigns is the least, too.
    """

    STAMPS: ClassVar[str] = "stamps are off by as much"
    MOUNTING: ClassVar[str] = "sensors are mounted no better"
    DATA_SHEET: ClassVar[str] = "a data sheet allows as much"
    GROUND: ClassVar[str] = "one ground varies by as much within a run"

    size: float
    reason: str
    sampled: float = 0.0


WARTHOG_RUNS = "nine runs of a Warthog on five grounds"
WARTHOG_LAGS = "six runs of a Warthog on three grounds (`make run-spreads`)"


@dataclass(frozen=True)
class Spread:
    """How much a number changes from run to run of a vehicle on one ground.

    Attributes:
        size: standard deviation, in the parameter's unit.
        source: where it was measured.
    """

    size: float
    source: str = WARTHOG_RUNS


USUAL_SPREAD = 0.25
"""Standard deviation between runs of a ground, over the usual size of a number, where none was measured."""


@dataclass(frozen=True)
class Plausible:
    """The range that vehicles show, wider than was ever seen: outside, a name stands for something else.

    Attributes:
        low, high: ends of the range, in the parameter's unit.
        source: where it comes from.
    """

    low: float
    high: float
    source: str


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    Attributes:
        name: as in the formula.
        unit: SI, `1` for a plain number.
        bounds: smallest and largest value.
        neutral: value at which the effect changes nothing; NaN for a number that only says where it acts.
        about: what it is.
        typical: a usual size.
        search: how it is found; with `starts` from these, unless it says a grid.
        starts: values to start or to begin the grid from.
        relative_to: what the starts are shares of: the largest commanded `speed`, `turn` or `wheel` speed,
            or the run's `duration`; empty where they are values.
        step: change used for numerical derivatives.
        least: smallest size worth a name; None where every size is, or where `Effect.is_degenerate` tells.
        plausible: the observed range; None for all within the bounds.
        one_sign: whether physics has positive values only: the other sign is a clock or chance.
        instead_of: the parameter that counts no more once this one is given; this one is not searched.
        quantities: what it is to a controller; none where no controller knows of it.
        between_runs: how much it changes from run to run; None where no recordings told.
        level: whose it is by its nature, as a controller's gain is the vehicle's; None where runs must tell.
    """

    name: str
    unit: str
    bounds: tuple[float, float]
    neutral: float
    about: str
    typical: float
    search: Search = Search.DIRECT
    starts: tuple[float, ...] = ()
    relative_to: Relative = ""
    step: float = 1e-4
    least: Least | None = None
    plausible: Plausible | None = None
    one_sign: bool = False
    instead_of: str = ""
    quantities: tuple[Quantity, ...] = ()
    between_runs: Spread | None = None
    level: Level | None = None

    def __post_init__(self) -> None:
        if self.starts and self.search is Search.DIRECT:
            object.__setattr__(self, "search", Search.STARTS)

    @property
    def usual_size(self) -> float:
        """How far from doing nothing it usually is, in its unit."""
        return abs(self.typical - (self.neutral if math.isfinite(self.neutral) else 0.0))

    @property
    def spread(self) -> Spread:
        """Between runs: what is known of it, else the median of what was measured of other numbers."""
        usual = f"a quarter of its usual size, the median over the numbers of {WARTHOG_RUNS}"
        return self.between_runs or Spread(USUAL_SPREAD * self.usual_size, usual)


@dataclass(frozen=True)
class Part:
    """A number of an effect that is searched as that of another effect.

    Attributes:
        name: of the number.
        effect, parameter: under which it is searched.
        factor: what that is multiplied with.
    """

    name: str
    effect: str
    parameter: str
    factor: float


def is_of_one_run(parameters: Iterable[Parameter]) -> bool:
    """Whether an effect with these acts from a moment of one recording on: another run shows none of them."""
    return any(parameter.relative_to == "duration" for parameter in parameters)
