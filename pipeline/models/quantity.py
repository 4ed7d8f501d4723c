"""What a number of an effect is to a controller: quantities of a vehicle that controllers know.

An effect says which quantities its numbers are (`Parameter.quantities`), a target which of its parameters
takes which quantity; neither knows the other.
"""

import enum
import math
from collections.abc import Callable, Iterable

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
