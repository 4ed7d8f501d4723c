"""Kinds of vehicles, one file each: what their drive is told, and how they would move if nothing slipped.

A kind is found by being in this folder: its file's name is its name in configurations, and the file holds one
class derived from `Kinematics`. Frames follow REP-103: x ahead, y left, w counterclockwise.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from pipeline.sources.configuration import Vehicle

if TYPE_CHECKING:
    Floats: TypeAlias = NDArray[np.float64]
    Inputs: TypeAlias = Mapping[str, Floats]
    Body: TypeAlias = tuple[Floats, Floats, Floats]

USUAL_KIND = "differential"


@dataclass(frozen=True)
class Quantity:
    """An input of the drive, or a number of the geometry.

    Attributes:
        name: column of the tables `commands` and `wheels`, or field of a vehicle.
        unit: of its values.
        about: what it is, in a few words.
        required: whether a vehicle of the kind must have it.
    """

    name: str
    unit: str
    about: str
    required: bool = True


class Kinematics(ABC):
    """The ideal motion of one kind of vehicle.

    Arrays have shape (n,). Inputs come by name; there may be more of them than the kind asks for. A body
    velocity or command is (x [m/s], y [m/s], w [rad/s]) of base_link.

    Attributes:
        inputs: what the drive is told, and what its encoders say.
        geometry: what of a vehicle's numbers the kind uses.
        known_joints: whether single wheels, told apart by their names, tell the inputs.
    """

    inputs: ClassVar[tuple[Quantity, ...]]
    geometry: ClassVar[tuple[Quantity, ...]]
    known_joints: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """The ideal body velocity of inputs."""

    @abstractmethod
    def inverse(self, body: Body, vehicle: Vehicle) -> dict[str, Floats]:
        """The inputs that a controller gives the drive to reach a body command, within the drive's limits."""

    def asked(self, inputs: Inputs, vehicle: Vehicle) -> Body:
        """The body command that a controller had turned into inputs: the inverse of `inverse`."""
        return self.forward(inputs, vehicle)

    def lever_m(self, vehicle: Vehicle) -> float:
        """How far base_link lies ahead of the point that moves straight ahead when nothing slips [m]."""
        del vehicle
        return 0.0

    def turning_width_m(self, vehicle: Vehicle) -> float:
        """Over which a difference of speed between the sides turns the vehicle [m]; one where unknown."""
        return vehicle.track_width_m or 1.0

    def has_inputs(self, *names: str) -> bool:
        """Whether the drive is told all of these."""
        return set(names) <= {quantity.name for quantity in self.inputs}


def list_kinds() -> tuple[str, ...]:
    """The kinds there are a file for, the usual one first."""
    names = (module.name for module in pkgutil.iter_modules(__path__))
    return tuple(sorted(names, key=lambda kind: (kind != USUAL_KIND, kind)))


@functools.cache
def find_kinematics(kind: str) -> Kinematics:
    """The kinematics of a kind of vehicle.

    Raises:
        LookupError: there is no file of that name, or not one class in it.
    """
    if kind not in list_kinds():
        raise LookupError(f"no kind of vehicle is called {kind!r}; there are {', '.join(list_kinds())}")
    module = importlib.import_module(f"{__name__}.{kind}")
    (kind_class,) = (
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Kinematics) and value.__module__ == module.__name__
    )
    made: Kinematics = kind_class()
    return made
