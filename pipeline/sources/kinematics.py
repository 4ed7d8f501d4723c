"""Kinds of vehicles: the inputs of their drive, and their ideal motion without slip.

A kind is a class derived from `Kinematics` and listed in `KINDS`; configurations use the name of the class in
lower case. Frames follow REP-103: x ahead, y left, w counterclockwise.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Inputs: TypeAlias = Mapping[str, Floats]
    Body: TypeAlias = tuple[Floats, Floats, Floats]


@dataclass(frozen=True)
class Quantity:
    """An input of the drive, or a number of the geometry.

    Attributes:
        name: column of the tables `commands` and `wheels`, or field of a vehicle.
        unit: of its values.
        about: short description.
        required: whether a vehicle of the kind must have it.
    """

    name: str
    unit: str
    about: str
    required: bool = True


class Geometry(Protocol):
    """What kinematics need of a vehicle; lengths in metres, angles in radians."""

    @property
    def wheel_radius_m(self) -> float:
        """Radius of the wheels."""

    @property
    def track_width_m(self) -> float | None:
        """Distance between the centres of the left and right wheels."""

    @property
    def wheelbase_m(self) -> float | None:
        """Distance between the axles."""

    @property
    def base_to_rear_axle_m(self) -> float:
        """Distance of base_link ahead of the rear axle."""

    @property
    def max_steering_rad(self) -> float | None:
        """Largest steering angle."""

    @property
    def controller_track_multiplier(self) -> float:
        """Factor on the track width in the controller."""


class Kinematics(ABC):
    """Ideal motion of one kind of vehicle.

    Arrays have shape (n,). Inputs are given by name; extra ones are allowed. A body velocity or command is
    (x [m/s], y [m/s], w [rad/s]) of base_link.

    Attributes:
        inputs: inputs of the drive, which its encoders also measure.
        geometry: vehicle parameters that the kind uses.
        known_joints: whether single wheels, identified by their names, determine the inputs.
    """

    inputs: ClassVar[tuple[Quantity, ...]]
    geometry: ClassVar[tuple[Quantity, ...]]
    known_joints: ClassVar[bool] = True

    @abstractmethod
    def forward(self, inputs: Inputs, vehicle: Geometry) -> Body:
        """Ideal body velocity of inputs."""

    @abstractmethod
    def inverse(self, body: Body, vehicle: Geometry) -> dict[str, Floats]:
        """Inputs that a controller sends to the drive for a body command, within the drive's limits."""

    def asked(self, inputs: Inputs, vehicle: Geometry) -> Body:
        """Body command that a controller converted into inputs: the inverse of `inverse`."""
        return self.forward(inputs, vehicle)

    def lever_m(self, vehicle: Geometry) -> float:
        """Distance of base_link ahead of the point that moves straight ahead without slip [m]."""
        del vehicle
        return 0.0

    def turning_width_m(self, vehicle: Geometry) -> float:
        """Width that converts a speed difference of the sides into a yaw rate [m]; one if unknown."""
        return vehicle.track_width_m or 1.0

    def has_inputs(self, *names: str) -> bool:
        """Whether the drive has all of these inputs."""
        return set(names) <= {quantity.name for quantity in self.inputs}


class Differential(Kinematics):
    """Differential drive: one wheel speed per side; the difference turns the vehicle.

        v_x = r (left + right) / 2        v_y = 0        v_w = r (right - left) / b

    Source: Samson, Baril, Lépine and Pomerleau 2024, eq. 2.
    """

    inputs: ClassVar[tuple[Quantity, ...]] = (
        Quantity("left", "rad/s", "speed of the left wheels"),
        Quantity("right", "rad/s", "speed of the right wheels"),
    )
    geometry: ClassVar[tuple[Quantity, ...]] = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, between the middles of the left and right wheels"),
        Quantity("controller_track_multiplier", "1", "the controller's track over b", required=False),
    )

    def forward(self, inputs: Inputs, vehicle: Geometry) -> Body:
        """See the formula above."""
        return self._roll(inputs, vehicle, self.turning_width_m(vehicle))

    def asked(self, inputs: Inputs, vehicle: Geometry) -> Body:
        """As `forward`, with the geometry that the controller uses."""
        return self._roll(inputs, vehicle, self._controller_width_m(vehicle))

    def inverse(self, body: Body, vehicle: Geometry) -> dict[str, Floats]:
        """Wheel speeds of a body command with the controller's geometry; sideways motion is ignored."""
        forward, _, turning = body
        half = turning * self._controller_width_m(vehicle) / 2.0
        radius = vehicle.wheel_radius_m
        return {"left": (forward - half) / radius, "right": (forward + half) / radius}

    def _controller_width_m(self, vehicle: Geometry) -> float:
        return self.turning_width_m(vehicle) * vehicle.controller_track_multiplier

    def _roll(self, inputs: Inputs, vehicle: Geometry, width_m: float) -> Body:
        left, right, radius = inputs["left"], inputs["right"], vehicle.wheel_radius_m
        forward, turning = left + right, right - left
        # These are the longest sums of the models' signals: computing in place halves the time.
        forward *= 0.5 * radius
        turning *= radius
        turning /= width_m
        return forward, np.broadcast_to(0.0, np.shape(forward)), turning


_SLOW_MPS = 1e-3


class Ackermann(Kinematics):
    """Ackermann steering: the kinematic bicycle with its reference point at the rear axle.

        v_x = speed        v_y = arm v_w        v_w = speed tan(steering) / l

    arm [m] is the distance of base_link ahead of the rear axle.

    Source: Becker et al. 2023.
    """

    inputs = (
        Quantity("speed", "m/s", "speed at the rear axle"),
        Quantity("steering", "rad", "steering angle, left positive"),
    )
    geometry = (
        Quantity("wheel_radius_m", "m", "of the driven wheels"),
        Quantity("wheelbase_m", "m", "l, between the axles"),
        Quantity("base_to_rear_axle_m", "m", "arm", required=False),
        Quantity("max_steering_rad", "rad", "largest steering angle", required=False),
    )

    def forward(self, inputs: Inputs, vehicle: Geometry) -> Body:
        """See the formula above."""
        speed = inputs["speed"]
        turning = speed * np.tan(inputs["steering"]) / (vehicle.wheelbase_m or 1.0)
        return speed, vehicle.base_to_rear_axle_m * turning, turning

    def inverse(self, body: Body, vehicle: Geometry) -> dict[str, Floats]:
        """Speed and steering angle of a body command; straight ahead at standstill."""
        forward, _, turning = body
        moving = np.abs(forward) > _SLOW_MPS
        ratio = np.where(moving, turning / np.where(moving, forward, 1.0), 0.0)
        steering = np.arctan((vehicle.wheelbase_m or 1.0) * ratio)
        if vehicle.max_steering_rad is not None:
            steering = np.clip(steering, -vehicle.max_steering_rad, vehicle.max_steering_rad)
        return {"speed": forward, "steering": steering}

    def lever_m(self, vehicle: Geometry) -> float:
        """The arm of the formula above."""
        return vehicle.base_to_rear_axle_m


class Mecanum(Differential):
    """Mecanum drive: four wheels with rollers at 45 degrees, which also allow sideways motion.

        v_x = r (left + right) / 2        v_y = r sideways        v_w = r (right - left) / (b + l)

    left and right are the means of a side. With front_left = left - sideways, rear_left = left + sideways,
    front_right = right + sideways and rear_right = right - sideways these are the least-squares motion of any
    four wheel speeds; their fourth combination only causes scrubbing.

    Source: Muir and Neuman, ICRA 1987; Taheri, Qiao and Ghaeminezhad, IJCA 113(3), 2015.
    """

    inputs = (
        Quantity("left", "rad/s", "mean speed of the left wheels"),
        Quantity("right", "rad/s", "mean speed of the right wheels"),
        Quantity(
            "sideways", "rad/s", "a quarter of front right and rear left less front left and rear right"
        ),
    )
    geometry: ClassVar[tuple[Quantity, ...]] = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, between the middles of the left and right wheels"),
        Quantity("wheelbase_m", "m", "l, between the axles"),
        Quantity(
            "controller_track_multiplier", "1", "the controller's b + l over the vehicle's", required=False
        ),
    )

    def inverse(self, body: Body, vehicle: Geometry) -> dict[str, Floats]:
        """Wheel speeds of a body command with the controller's geometry."""
        sideways = np.asarray(body[1] / vehicle.wheel_radius_m)
        return {**super().inverse(body, vehicle), "sideways": sideways}

    def turning_width_m(self, vehicle: Geometry) -> float:
        """The sum b + l: a wheel with rollers turns the vehicle about a lever of half of it."""
        return (vehicle.track_width_m or 1.0) + (vehicle.wheelbase_m or 1.0)

    def _roll(self, inputs: Inputs, vehicle: Geometry, width_m: float) -> Body:
        forward, _, turning = super()._roll(inputs, vehicle, width_m)
        return forward, vehicle.wheel_radius_m * inputs["sideways"], turning


class Omni(Mecanum):
    """Omni wheels on a circle, three or four: motion in any direction; the inputs describe body motion.

        v_x = r (left + right) / 2        v_y = r sideways        v_w = r (right - left) / b

    b is the diameter of the circle through the wheels. Number and position of the wheels do not affect body
    motion: left, right and sideways are the speeds of virtual wheels at its sides.

    Source: Siciliano and Khatib, Springer Handbook of Robotics, chapter 24, omnimobile robots.
    """

    geometry = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b, diameter of the circle through the wheels"),
        Quantity("controller_track_multiplier", "1", "the controller's diameter over b", required=False),
    )
    known_joints = False

    def turning_width_m(self, vehicle: Geometry) -> float:
        """The diameter of the circle."""
        return vehicle.track_width_m or 1.0


KINDS: tuple[type[Kinematics], ...] = (Differential, Ackermann, Mecanum, Omni)
"""All kinds, the usual one first."""


def list_kinds() -> tuple[str, ...]:
    """Names of the kinds, the usual one first."""
    return tuple(kind.__name__.lower() for kind in KINDS)


@functools.cache
def find_kinematics(kind: str) -> Kinematics:
    """The kinematics of a kind of vehicle.

    Raises:
        LookupError: there is no kind of that name.
    """
    for known in KINDS:
        if known.__name__.lower() == kind:
            return known()
    raise LookupError(f"no kind of vehicle is called {kind!r}; there are {', '.join(list_kinds())}")
