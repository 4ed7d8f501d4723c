"""Parameters of effects: units, bounds, levels, and their identifiability in recordings."""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import ClassVar, Literal

import msgspec

from pipeline.core import JSON_DIGITS, NORMAL_95, Floats, round_digits
from pipeline.run import MotionError


class Level(enum.Enum):
    """What a parameter of an effect is a property of."""

    VEHICLE = "vehicle"
    TERRAIN = "terrain"
    RUN = "run"


@dataclass(frozen=True)
class Meaning:
    """Interpretation of a parameter that belongs to a level.

    Attributes:
        level: the level.
        name: the term for it at that level.
        text: description for people.
    """

    level: Level
    name: str
    text: str


# Quantities of a vehicle that controllers have as parameters.
#
# An effect declares the quantities of its parameters (`Parameter.quantities`), an export target those of its
# own parameters; neither depends on the other.

Joined = Callable[[Iterable[float]], float]


class Quantity(enum.Enum):
    """A quantity, and how the values of several effects with the same quantity combine into one.

    Attributes:
        unit: SI, `1` for a dimensionless number.
        join: combines the values: gains multiply, delays add up, and the smallest limit applies.
    """

    RADIUS = ("effective over nominal wheel radius", "1", math.prod)
    RADIUS_DIFFERENCE = ("right minus left radius over their mean", "1", math.fsum)
    TRACK = ("effective over nominal track", "1", math.prod)
    WHEELBASE = ("effective over nominal wheelbase", "1", math.prod)
    COMMAND_DELAY = ("dead time of a command", "s", math.fsum)
    SPEED_LAG = ("time constant of the speed", "s", math.fsum)
    TURN_LAG = ("time constant of turning by the difference of wheel speeds", "s", math.fsum)
    STEERING_LAG = ("time constant of the steering angle", "s", math.fsum)
    STEERING_GAIN = ("steering angle over its command", "1", math.prod)
    STEERING_OFFSET = ("steering angle at zero command, left positive", "rad", math.fsum)
    SPEED_LIMIT = ("largest commanded speed", "m/s", min)
    TURN_LIMIT = ("largest commanded yaw rate", "rad/s", min)
    WHEEL_SPEED_LIMIT = ("largest wheel speed", "rad/s", min)
    WHEEL_ACCELERATION_LIMIT = ("largest wheel acceleration", "rad/s^2", min)
    ACCELERATION_LIMIT = ("largest rate of change of the commanded speed", "m/s^2", min)
    TURN_ACCELERATION_LIMIT = ("largest rate of change of the commanded yaw rate", "rad/s^2", min)
    DEADBAND = ("largest commanded rim speed at which a wheel stands still", "m/s", max)

    def __init__(self, about: str, unit: str, join: Joined) -> None:
        self.about = about
        self.unit = unit
        self.join = join


Relative = Literal["", "speed", "turn", "wheel", "duration"]

# Smallest delay between poses, headings and encoders to report [s]: time stamps are no more accurate.
LEAST_DELAY_S = 0.012

STANDING = 0.05
"""Speed and yaw rate [m/s, rad/s] that a run must both exceed to count as driving and turning."""
_NEVER = 0.02
"""Share of the larger of speed and yaw rate; below it the smaller one counts as zero."""

# Share of the largest command above which a limit has no effect.
_REACHED = 0.99
EXCEEDED_SHARE = 0.005
"""Share of the time in which wheels may exceed a limit: allows two wrong windows in a run of some minutes."""
OVERSHOOT = 1.05
"""Largest wheel speed over its limit: allows for rounding of encoders and overshoot of a motor."""


class Asked(msgspec.Struct, frozen=True):
    """The largest motion that a run asks for, by which an effect without a plain number is described.

    Attributes:
        speed_mps: speed that is exceeded for 2 s in all; zero where it hardly drives.
        turn_radps: yaw rate on the spot that is exceeded for 2 s in all; zero where it hardly turns so.
    """

    speed_mps: float = 0.0
    turn_radps: float = 0.0


@dataclass(frozen=True)
class Largest:
    """Largest commanded values and the distribution of motion over time: the references of relative starts.

    Attributes:
        speed, turn, wheel: speed [m/s], yaw rate [rad/s], wheel speed [rad/s].
        difference: of the wheel speeds [rad/s].
        moments: times [s] at the tenths of the distance of the fastest wheel, shape (11,).
        sideways: speed to the left or right [m/s].
        turns: times [s] at the tenths of the turning; None for `moments`.
        rim: speed of the rim of a wheel [m/s]; 0 if not known.
        is_one_speed: whether the fastest wheel is commanded one speed only, apart from standing.
    """

    speed: float
    turn: float
    wheel: float
    difference: float
    moments: Floats
    sideways: float = 0.0
    turns: Floats | None = None
    rim: float = 0.0
    is_one_speed: bool = False

    @property
    def fastest(self) -> float:
        """Largest speed [m/s], forward or sideways."""
        return max(self.speed, self.sideways)

    @property
    def moves_both_ways(self) -> bool:
        """Whether a run both drives and turns."""
        return min(self.fastest, self.turn) > STANDING

    @property
    def is_one_motion(self) -> bool:
        """Whether the run drives straight only, or turns on the spot only."""
        return min(self.fastest, self.turn) < _NEVER * max(self.fastest, self.turn)

    def take(self, share: float, of: Relative) -> float:
        """A share of the largest command; the number itself where ``of`` is empty.

        Args:
            share: of the largest value; for `duration` the share of the driving done until that time.
            of: which value.
        """
        if of == "duration":
            return float(self.moments[round(share * (self.moments.size - 1))])
        whole = {"speed": self.speed, "turn": self.turn, "wheel": self.wheel}
        return share * whole.get(of, 1.0)

    def is_within(self, time_s: float) -> bool:
        """Whether at least a seventh of the driving, and of the turning, lies on each side of a time."""
        known = (self.moments,) if self.turns is None else (self.moments, self.turns)
        return all(
            0.5 * (tenths[1] + tenths[2]) <= time_s <= 0.5 * (tenths[-3] + tenths[-2]) for tenths in known
        )

    def reaches(self, limit: float, of: Relative) -> bool:
        """Whether commands exceeded a limit of `speed`, `turn` or `wheel` speed."""
        return limit <= self.take(_REACHED, of)


@dataclass(frozen=True)
class Conditions:
    """What the recordings of a search can identify.

    Attributes:
        largest: largest commanded values.
        encoders: whether every run has measured wheel speeds.
        gyro: whether every run has a good gyro as heading and clock.
        least_delay_s: delay or lag that the sampling of the wheels can cause by itself [s].
        exceeded: half-second means that measured wheels exceed in `EXCEEDED_SHARE` of the time: `speed`,
            `turn`, `wheel`.
        slope_rad: half of the range of pitch over nine tenths of the time; zero where it was not recorded.
        course: whether the heading of a run is its course over ground, which no position can precede.
        bursts: whether a run was taken to be as fast as commanded, to find how long a command acts.
    """

    largest: Largest
    encoders: bool = False
    gyro: bool = False
    least_delay_s: float = 0.0
    exceeded: Mapping[str, float] = field(default_factory=dict)
    slope_rad: float = 0.0
    course: bool = False
    bursts: bool = False

    def attain(self, limit: float, of: Relative) -> bool:
        """Whether commands exceeded a limit, and measured wheels, if any, reached it."""
        return self.largest.reaches(limit, of) and limit <= OVERSHOOT * self.exceeded.get(of, math.inf)


_MARGIN = 1e-6
"""Distance from a bound, relative to the size of the bounds, within which fits stop."""


def stands_at_bound(value: float, bounds: tuple[float, float]) -> bool:
    """Whether a fitted value is at a bound."""
    low, high = bounds
    margin = _MARGIN * (abs(low) + abs(high)) if math.isfinite(low + high) else 0.0
    return not low + margin < value < high - margin


def cut_interval(low: float, high: float, bounds: tuple[float, float]) -> tuple[float, float]:
    """An interval clipped to the bounds of its parameter; NaN stays NaN."""
    least, most = bounds
    return max(low, least), min(high, most)


class Excitation(enum.Enum):
    """Excitation that a run must contain to identify an effect."""

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
    """How a parameter is searched: from one start, several, or on a shrinking grid if it is not smooth."""

    DIRECT = "direct"
    STARTS = "starts"
    GRID = "grid"


@dataclass(frozen=True)
class Least:
    """The smallest deviation of a parameter to report.

    Attributes:
        size: distance from the neutral value, in the parameter's unit.
        reason: cause of an apparent deviation of this size, however narrow the interval is.
        sampled: multiple of the delay caused by sampling the wheels that must be reached, too.
    """

    STAMPS: ClassVar[str] = "stamps have errors of this size"
    MOUNTING: ClassVar[str] = "mounting errors of sensors have this size"
    DATA_SHEET: ClassVar[str] = "tolerance of data sheets"
    GROUND: ClassVar[str] = "terrain varies by this much within a run"

    size: float
    reason: str
    sampled: float = 0.0


WARTHOG_RUNS = "nine runs of a Warthog on five terrains"
WARTHOG_LAGS = "six runs of a Warthog on three terrains"


@dataclass(frozen=True)
class Spread:
    """Variation of a parameter from run to run of a vehicle on one ground.

    Attributes:
        size: standard deviation, in the parameter's unit.
        source: where it was measured.
    """

    size: float
    source: str = WARTHOG_RUNS


USUAL_SPREAD = 0.25
"""Standard deviation between runs on one ground, relative to the typical size, where none was measured."""


@dataclass(frozen=True)
class Plausible:
    """Range wider than observed on any vehicle; a value outside has another cause.

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
        unit: SI, `1` for a dimensionless number.
        bounds: smallest and largest value.
        neutral: value at which the effect vanishes; NaN for a parameter that only locates the effect.
        about: what it is.
        typical: a typical value.
        search: search method; several starts if `starts` is given, unless it is a grid.
        starts: start values, or the first grid.
        relative_to: reference of the starts: the largest commanded `speed`, `turn` or `wheel` speed,
            or the run's `duration`; empty where they are absolute values.
        step: step of numerical derivatives.
        least: smallest size to report; None for any size, or where `Effect.is_degenerate` decides.
        plausible: the observed range; None for all within the bounds.
        physical: the range of estimates that a fleet counts, where single runs may be beyond the observed one
            without another cause; None for the observed one.
        one_sign: whether only positive values are physical: the other sign is a clock error or chance.
        instead_of: the parameter that this one replaces once it is given; this one is not searched.
        quantities: quantities of controllers that it determines; empty where there are none.
        between_runs: variation from run to run; None where it was not measured.
        level: what it is a property of by its nature, as a controller's gain of the vehicle; None if open.
        of_sides: whether it is a difference of left and right, of which a vehicle is built to have none.
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
    physical: tuple[float, float] | None = None
    one_sign: bool = False
    instead_of: str = ""
    quantities: tuple[Quantity, ...] = ()
    between_runs: Spread | None = None
    level: Level | None = None
    of_sides: bool = False

    def __post_init__(self) -> None:
        if self.starts and self.search is Search.DIRECT:
            object.__setattr__(self, "search", Search.STARTS)

    @property
    def usual_size(self) -> float:
        """Typical distance from the neutral value, in its unit."""
        return abs(self.typical - (self.neutral if math.isfinite(self.neutral) else 0.0))

    @property
    def spread(self) -> Spread:
        """Spread between runs: the measured one, or a default from the median of other parameters."""
        usual = f"a quarter of its usual size, the median over the numbers of {WARTHOG_RUNS}"
        return self.between_runs or Spread(USUAL_SPREAD * self.usual_size, usual)

    def round(self, value: float, digits: int = JSON_DIGITS) -> float:
        """A value of so many digits, as in model files by default, unless that moves it out of its bounds."""
        low, high = self.bounds
        rounded = round_digits(value, digits)
        return rounded if low <= rounded <= high and value != self.neutral else value

    def nearest_plausible(self, value: float) -> float:
        """The value of the observed range that is nearest to a value; that itself without such a range."""
        shown = self.plausible
        return value if shown is None else min(max(value, shown.low), shown.high)

    def is_physical(self, value: float, error: float) -> bool:
        """Whether an estimate can be physics: within bounds, and within its error in the physical range.

        Beside a bound that is neutral, as a lag of zero, chance may put it within its error.

        Args:
            value: the estimate.
            error: its standard error.
        """
        low, high = cut_interval(value - NORMAL_95 * error, value + NORMAL_95 * error, self.bounds)
        if low > high or (self.neutral not in self.bounds and not self.bounds[0] < value < self.bounds[1]):
            return False
        shown = self.plausible
        least, most = self.physical or ((shown.low, shown.high) if shown else self.bounds)
        return low <= most and high >= least

    def is_wide(self, value: float, low: float, high: float) -> bool:
        """Whether an interval is as wide as the number is large, or as a typical one if that is larger."""
        neutral = self.neutral if math.isfinite(self.neutral) else 0.0
        return high - low >= max(abs(value - neutral), abs(self.typical - neutral))

    def is_large(self, value: float) -> bool:
        """Whether a value is as far from neutral as a typical one; of a limit, none is.

        A difference of the sides is large beyond the tolerance of data sheets.
        """
        if self.of_sides and self.least is not None:
            return abs(value - self.neutral) >= self.least.size
        return abs(value - self.neutral) >= abs(self.typical - self.neutral) < math.inf

    def is_one_sided(self, low: float, high: float) -> bool:
        """Whether an interval reaches a bound that is not the neutral value: the runs give one limit only."""
        least, most = self.bounds
        return low <= least < self.neutral or high >= most > self.neutral


@dataclass(frozen=True)
class Part:
    """A parameter of an effect that is searched as a parameter of another effect.

    Attributes:
        name: of the parameter.
        effect, parameter: the effect and parameter that are searched instead.
        factor: by which the estimate of that parameter is multiplied.
    """

    name: str
    effect: str
    parameter: str
    factor: float


def is_of_one_run(parameters: Iterable[Parameter]) -> bool:
    """Whether an effect with these parameters starts at a time within one recording, unlike in other runs."""
    return any(parameter.relative_to == "duration" for parameter in parameters)


_TOKEN = re.compile(r"\s*(?:([A-Za-z]+|1)(?:\s*(?:\^|\*\*)\s*(-?\d{1,2}))?|([*/]))\s*")
_LONGEST = 60
"""Largest number of characters of a unit: more than any SI unit in use."""


@dataclass(frozen=True)
class Unit:
    """Powers of metre, second and kilogram, and the original text of a parsed unit."""

    metre: Fraction = Fraction(0)
    second: Fraction = Fraction(0)
    kilogram: Fraction = Fraction(0)
    written: str = field(default="", compare=False)

    def __mul__(self, other: Unit) -> Unit:
        return Unit(self.metre + other.metre, self.second + other.second, self.kilogram + other.kilogram)

    def __truediv__(self, other: Unit) -> Unit:
        return self * other.power(Fraction(-1))

    def power(self, exponent: Fraction) -> Unit:
        """The unit to a power."""
        return Unit(self.metre * exponent, self.second * exponent, self.kilogram * exponent)

    def __str__(self) -> str:
        if self.written:
            return self.written
        above = _write(("m", self.metre), ("kg", self.kilogram), ("s", self.second))
        below = _write(("m", -self.metre), ("kg", -self.kilogram), ("s", -self.second))
        return f"{above or '1'}/{below}" if below else above or "1"


def _write(*parts: tuple[str, Fraction]) -> str:
    return "*".join(name if power == 1 else f"{name}^{power}" for name, power in parts if power > 0)


PLAIN = Unit()
_METRE, _SECOND, _KILOGRAM = Unit(metre=Fraction(1)), Unit(second=Fraction(1)), Unit(kilogram=Fraction(1))
_NEWTON = _KILOGRAM * _METRE / (_SECOND * _SECOND)
_KNOWN = {
    "1": PLAIN,
    "rad": PLAIN,
    "m": _METRE,
    "s": _SECOND,
    "kg": _KILOGRAM,
    "N": _NEWTON,
    "J": _NEWTON * _METRE,
    "W": _NEWTON * _METRE / _SECOND,
    "Hz": PLAIN / _SECOND,
}


def parse_unit(text: str, where: str) -> Unit:
    """Parse a unit such as ``m/s^2`` or ``N*m``; a ``/`` divides by the next factor only.

    Args:
        text: the unit.
        where: file and line, for the error message.

    Raises:
        MotionError: ``bad_unit``.
    """
    unit, position, divide, expect = PLAIN, 0, False, True
    while position < len(text) <= _LONGEST:
        match = _TOKEN.match(text, position)
        if match is None or (match.group(3) is None) != expect:
            break
        position = match.end()
        if match.group(3) is not None:
            divide, expect = match.group(3) == "/", True
            continue
        name, power = match.group(1), match.group(2)
        if name not in _KNOWN:
            break
        factor = _KNOWN[name].power(Fraction(int(power or 1)))
        unit, expect = (unit / factor if divide else unit * factor), False
    else:
        if not expect:
            return replace(unit, written=text.strip())
    hint = f"Write products and powers of {', '.join(_KNOWN)}, for example m/s^2."
    raise MotionError("bad_unit", f"{text[:_LONGEST]!r} is not a unit", where=where, hint=hint)
