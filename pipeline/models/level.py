"""Whose a number is: the vehicle's, the ground's, or a run's own. One run cannot tell; several can."""

import enum
from dataclasses import dataclass


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
