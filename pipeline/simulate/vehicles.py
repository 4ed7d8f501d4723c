"""Vehicles that can be simulated: geometry and the command space their programs draw from.

Radii, tracks and speeds are those of the vendors' data sheets and of the published DRIVE recordings.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline.simulate.errors import SimulateError, unknown_name
from pipeline.simulate.facts import read_facts

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


VEHICLES = {name: Vehicle(**given) for name, given in read_facts("vehicles.toml").items()}
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
