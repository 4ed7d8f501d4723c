"""Vehicles that can be simulated: geometry and the command space their programs draw from.

Radii, tracks and speeds are those of the vendors' data sheets and of the published DRIVE recordings.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.simulate.errors import SimulateError, unknown_name

Kind = Literal["differential", "ackermann", "mecanum", "omni"]


@dataclass(frozen=True)
class Vehicle:
    """Geometry and limits of one vehicle.

    Attributes:
        name: how it calls itself in the log's deployment record.
        kind: ``differential`` (wheels or tracks a side), ``ackermann`` (steered front axle, base_link on
            the rear axle), ``mecanum`` (four wheels) or ``omni`` (wheels on a circle of that diameter).
        wheel_radius_m: nominal radius.
        track_width_m: nominal distance between left and right wheels.
        wheelbase_m: distance between the axles; matters for ``ackermann`` and ``mecanum``.
        max_speed_mps: largest speed a program asks for.
        max_turn_radps: largest yaw rate a program asks for (not Ackermann).
        max_steering_rad: largest steering angle a program asks for (Ackermann).
        max_sideways_mps: largest sideways speed a program asks for (mecanum, omni).
        wheels_per_side: how many joints a side has in a JointState.
        controller_track_multiplier: the onboard controller turns a body command into wheel speeds with this
            multiple of the nominal track (mecanum: of track and wheelbase).
    """

    name: str
    kind: Kind
    wheel_radius_m: float
    track_width_m: float
    wheelbase_m: float
    max_speed_mps: float
    max_turn_radps: float = 0.0
    max_steering_rad: float = 0.0
    wheels_per_side: int = 2
    controller_track_multiplier: float = 1.0
    max_sideways_mps: float = 0.0

    def __post_init__(self) -> None:
        for name in ("wheel_radius_m", "track_width_m", "wheelbase_m", "max_speed_mps"):
            if not getattr(self, name) > 0.0:
                hint = f"Give {name} in SI units"
                raise SimulateError("bad_vehicle", f"{name} must be above zero", where=self.name, hint=hint)

    @property
    def moves_sideways(self) -> bool:
        """Whether it can be asked to."""
        return self.kind in {"mecanum", "omni"}

    @property
    def lever_m(self) -> float:
        """Half of what a difference of speed between the sides turns the vehicle over."""
        reach = self.track_width_m + (self.wheelbase_m if self.kind == "mecanum" else 0.0)
        return 0.5 * reach


VEHICLES: dict[str, Vehicle] = {
    "husky": Vehicle("husky_a200", "differential", 0.165, 0.55, 0.512, 1.0, max_turn_radps=1.0),
    "warthog": Vehicle("warthog", "differential", 0.30, 1.08, 0.916, 5.0, max_turn_radps=2.0),
    "jackal": Vehicle("jackal", "differential", 0.098, 0.37559, 0.262, 2.0, max_turn_radps=2.0),
    "marmotte": Vehicle(
        "marmotte_hd2", "differential", 0.116, 0.5927, 0.6, 1.2, max_turn_radps=1.5, wheels_per_side=1
    ),
    "turtlebot3": Vehicle(
        "turtlebot3_burger", "differential", 0.033, 0.16, 0.08, 0.22, max_turn_radps=2.0, wheels_per_side=1
    ),
    "youbot": Vehicle("youbot", "mecanum", 0.0475, 0.3, 0.47, 0.8, max_turn_radps=1.2, max_sideways_mps=0.8),
    "omni": Vehicle("omni_base", "omni", 0.05, 0.36, 0.36, 0.8, max_turn_radps=1.5, max_sideways_mps=0.8),
    "car": Vehicle("ackermann_car", "ackermann", 0.31, 1.5, 2.6, 8.0, max_steering_rad=0.5),
}
_ALIASES = {vehicle.name: key for key, vehicle in VEHICLES.items()} | {"ackermann": "car"}


def find_vehicle(name: str) -> Vehicle:
    """The named vehicle.

    Raises:
        SimulateError: ``unknown_vehicle``.
    """
    key = _ALIASES.get(name, name)
    if key not in VEHICLES:
        raise unknown_name("vehicle", name, sorted(VEHICLES))
    return VEHICLES[key]
