"""Geometry that a controller was given: its parameters, as parameter events or metadata record them."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import msgspec

from pipeline.vehicles.recognition import Recognized

_QUANTITIES: Final = {
    "wheel_separation": "track_width_m",
    "wheels.separation": "track_width_m",
    "traction_track_width": "track_width_m",
    "rear_wheel_track": "track_width_m",
    "RD_WHEEL_TRACK": "track_width_m",
    "wheel_radius": "wheel_radius_m",
    "wheels.radius": "wheel_radius_m",
    "traction_wheels_radius": "wheel_radius_m",
    "rear_wheels_radius": "wheel_radius_m",
    "wheelbase": "wheelbase_m",
    "RA_WHEEL_BASE": "wheelbase_m",
    "wheel_separation_multiplier": "controller_track_multiplier",
    "left_wheel_radius_multiplier": "left_radius",
    "right_wheel_radius_multiplier": "right_radius",
}
"""By the end of a parameter's name. Sources: ros-controls/ros2_controllers, diff_drive_controller and
steering_controllers_library; ROBOTIS-GIT/turtlebot3, turtlebot3_node; PX4/PX4-Autopilot, rover modules."""
_RADIUS_MULTIPLIERS: Final = ("left_radius", "right_radius")
_DIFFERS: Final = 0.01


@dataclass(frozen=True)
class Controller:
    """What a controller was told of its vehicle.

    Attributes:
        name: of its node, or of the record.
        values: keys of `Vehicle`.
    """

    name: str
    values: Mapping[str, float]

    @property
    def kind(self) -> str:
        """Of the vehicle: a wheelbase is only asked for where it steers."""
        return "ackermann" if "wheelbase_m" in self.values else "differential"

    @property
    def geometry(self) -> dict[str, float]:
        """Lengths alone."""
        return {key: value for key, value in self.values.items() if key.endswith("_m")}


def read_parameters(parameters: Iterable[tuple[str, str, float]]) -> Controller | None:
    """What parameters say of the vehicle.

    Args:
        parameters: node, name and value in the order of time; the last value counts.

    Returns:
        The node that says most of its geometry; None where none says anything.
    """
    told: dict[str, dict[str, float]] = defaultdict(dict)
    for node, name, value in parameters:
        for ending, quantity in _QUANTITIES.items():
            if (name == ending or name.endswith(f".{ending}")) and 0.0 < value < float("inf"):
                told[node][quantity] = value
    if not told:
        return None
    node = max(sorted(told), key=lambda each: len(told[each]))
    values = told[node]
    multipliers = [values.pop(key) for key in _RADIUS_MULTIPLIERS if key in values]
    if multipliers and "wheel_radius_m" in values:
        values["wheel_radius_m"] *= sum(multipliers) / len(multipliers)
    return Controller(node, values) if values else None


def list_metadata(metadata: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str, float]]:
    """Numbers of metadata records as parameters of a node called after the record."""
    found = []
    for record, entries in metadata.items():
        for key, text in entries.items():
            try:
                found.append((record, key, float(text)))
            except ValueError:
                continue
    return found


def apply_parameters(told: Recognized, controller: Controller) -> Recognized:
    """A recognized vehicle with the geometry that its controller was given, which counts."""
    geometry = controller.geometry
    notes = [
        f"the parameters of {controller.name} say {key} = {value:.4g}, the {told.source.replace('_', ' ')} "
        f"{getattr(told.vehicle, key):.4g}: the parameters count"
        for key, value in geometry.items()
        if getattr(told.vehicle, key) and abs(value / getattr(told.vehicle, key) - 1.0) > _DIFFERS
    ]
    vehicle = msgspec.structs.replace(told.vehicle, **geometry)
    return Recognized(vehicle, told.source, (*told.notes, *notes))
