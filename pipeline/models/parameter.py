"""The numbers of an effect: units, bounds, how they are searched, and what of them is worth a name."""

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

from pipeline.models.conditions import Relative
from pipeline.models.quantity import Quantity


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

    size: float
    reason: str
    sampled: float = 0.0


WARTHOG_RUNS = "nine runs of a Warthog on five grounds"


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
        plausible: what vehicles show; None for all within the bounds.
        one_sign: whether physics has positive values only: the other sign is a clock or chance.
        instead_of: the parameter that counts no more once this one is given; this one is not searched.
        quantities: what it is to a controller; none where no controller knows of it.
        between_runs: how much it changes from run to run; None where no recordings told.
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
