"""Vehicles: presets found by being in the `presets` folder, and what a configuration makes of them."""

import functools
import tomllib
from importlib import resources
from typing import Annotated, Literal

import msgspec

from pipeline.vehicles.configuration import Kind, Positive, RunningGear, VehicleSection
from pipeline.vehicles.errors import ConfigurationError
from pipeline.vehicles.kinematics import USUAL_KIND, Kinematics, find_kinematics


class UsualTopics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Topic names that a vehicle usually has, by role; the first is preferred."""

    command: list[str] = []
    wheels: list[str] = []
    pose: list[str] = []
    imu: list[str] = []


class VendorController(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the vendor's controller does with the body commands that it receives.

    Attributes:
        topics: ends of the names of the topics that it listens to.
        track_multiplier: what it multiplies the vehicle's track width by.
    """

    topics: list[str] = []
    track_multiplier: Positive = 1.0


class OwnUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A unit that only the platform knows: raw = per * value + offset.

    Attributes:
        per: raw units a unit of the value.
        unit: of the value.
        offset: raw number at zero.
    """

    per: float
    unit: Literal["rad/s", "m/s", "rad"]
    offset: float = 0.0


class Vehicle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A vehicle's geometry and limits; units are in the names.

    Attributes:
        id: name in tables and file names, lower case with underscores.
        running_gear: what it stands on: tracks move it as the wheels of a differential drive do.
        source: where a preset's numbers were read.
        recognized_by: words of namespaces, hosts and robot descriptions, and packages of message types, that
            tell the platform.
        sideways_preset: the same platform on wheels that move it sideways, under the same names: what it is
            asked tells which it is.
        controller: the vendor's.
        units: of what the platform publishes, by name.
    """

    id: str
    name: str
    kind: Kind
    wheel_radius_m: Positive
    track_width_m: Positive | None = None
    wheelbase_m: Positive | None = None
    base_to_rear_axle_m: float = 0.0
    mass_kg: Positive | None = None
    max_speed_mps: Positive | None = None
    max_yaw_rate_radps: Positive | None = None
    max_steering_rad: Positive | None = None
    controller_track_multiplier: Positive = 1.0
    running_gear: RunningGear = "wheels"
    aliases: Annotated[list[str], msgspec.Meta(description="other names")] = []
    topics: UsualTopics = UsualTopics()
    source: str = ""
    recognized_by: list[str] = []
    sideways_preset: str = ""
    controller: VendorController = VendorController()
    units: dict[str, OwnUnit] = {}

    @property
    def kinematics(self) -> Kinematics:
        """The ideal motion of its kind."""
        return find_kinematics(self.kind)


@functools.cache
def list_presets() -> tuple[Vehicle, ...]:
    """All presets, sorted by id."""
    folder = resources.files("pipeline.vehicles") / "presets"
    found = []
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".toml"):
            content = tomllib.loads(entry.read_text(encoding="utf-8"))
            found.append(msgspec.convert({"id": entry.name[:-5], **content}, Vehicle))
    return tuple(found)


def find_preset(name: str) -> Vehicle | None:
    """The preset of that id or alias, ignoring case, spaces and dashes; None when there is none."""
    wanted = _plain(name)
    for vehicle in list_presets():
        if wanted in {_plain(vehicle.id), *map(_plain, vehicle.aliases)}:
            return vehicle
    return None


def _plain(name: str) -> str:
    return name.strip().lower().replace("-", "_").replace(" ", "_")


def resolve_vehicle(
    section: VehicleSection, *, recorded: str | None, where: str, told: Vehicle | None = None
) -> Vehicle:
    """The vehicle of a run.

    Args:
        section: what the configuration and the command line say.
        recorded: vehicle named in the log's `deployment` record, used when the configuration names none.
        where: the log, for the error message.
        told: vehicle that the rest of the log tells, used when neither names a preset.

    Raises:
        ConfigurationError: no vehicle is named, the name is unknown, or a value is missing.
    """
    values = section.list_values()
    named = values.pop("preset", None)
    # A full geometry needs no preset; a vehicle that the log names but nobody knows is then only a name.
    base = find_preset(str(named or recorded or ""))
    if named and base is None:
        raise _unknown(f"no vehicle preset is called {named!r}", where)
    if base is None and not {"wheel_radius_m", "kind"} & set(values):
        base = told
    if base is None:
        if "wheel_radius_m" not in values:
            said = f"names {recorded!r}, which is no preset" if recorded else "does not name one"
            raise _unknown(f"the vehicle cannot be determined: the log {said}", where)
        label = str(values.pop("name", None) or recorded or "vehicle")
        values = {"kind": USUAL_KIND, "id": _plain(label), "name": label, **values}
        return _check_geometry(msgspec.convert(values, Vehicle), where)
    if "name" in values:
        values["id"] = _plain(str(values["name"]))
    return _check_geometry(msgspec.structs.replace(base, **values), where)


def _check_geometry(vehicle: Vehicle, where: str) -> Vehicle:
    required = [quantity.name for quantity in vehicle.kinematics.geometry if quantity.required]
    needed = next((name for name in required if getattr(vehicle, name) is None), None)
    if needed is not None:
        raise ConfigurationError(
            "vehicle_incomplete",
            f"a vehicle of kind {vehicle.kind!r} needs {needed}",
            where=where,
            hint=f"Set vehicle.{needed} in run.toml"
            + (" or give --track-width." if needed == "track_width_m" else "."),
        )
    return vehicle


def _unknown(what: str, where: str) -> ConfigurationError:
    known = ", ".join(vehicle.id for vehicle in list_presets())
    hint = (
        f"Say which: --vehicle NAME (make: VEHICLE=NAME) with one of {known}; "
        "or --wheel-radius and --track-width in metres."
    )
    return ConfigurationError("vehicle_unknown", what, where=where, hint=hint)
