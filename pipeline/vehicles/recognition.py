"""Which vehicle a log is of, from what it holds: words of names, and a robot description.

A platform is recognized by a word of a namespace, a host, the robot's name, or by the package of its own
message types. A description gives the geometry of a vehicle that is no platform.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from pipeline.logs import ChannelInfo
from pipeline.vehicles.description import Description
from pipeline.vehicles.presets import Vehicle, list_presets

VehicleSource = Literal[
    "flag",
    "configuration",
    "metadata",
    "robot_description",
    "namespace",
    "message_types",
    "parameters",
    "transforms",
    "fitted",
]
_DIFFERS = 0.1
_OTHER_TRACK = 0.25
_GEOMETRY = ("wheel_radius_m", "track_width_m", "wheelbase_m")


@dataclass(frozen=True)
class Recognized:
    """A vehicle that the log tells.

    Attributes:
        vehicle: the vehicle.
        source: what told it.
        notes: what to say of it.
    """

    vehicle: Vehicle
    source: VehicleSource
    notes: tuple[str, ...] = ()


def recognize_vehicle(
    channels: Iterable[ChannelInfo],
    metadata: Mapping[str, Mapping[str, str]],
    description: Description | None,
    configured: Iterable[str] = (),
) -> Recognized | None:
    """The vehicle that a log tells; None where it tells none.

    Args:
        channels: what the log holds.
        metadata: its records.
        description: its robot description.
        configured: topics that the configuration names; of several robots theirs is meant.
    """
    held = [channel for channel in channels if channel.message_count != 0]
    named = {part for topic in configured for part in topic.split("/")[1:-1]}
    spaces = {part for channel in held for part in channel.topic.split("/")[1:-1]}
    hosts = {text for record in metadata.values() for key, text in record.items() if "host" in key.lower()}
    packages = {channel.type_name.split("/")[0] for channel in held}
    told: tuple[tuple[VehicleSource, set[str]], ...] = (
        ("robot_description", {description.name} if description is not None else set()),
        ("namespace", named),
        ("namespace", spaces | hosts),
        ("message_types", packages),
    )
    for source, words in told:
        preset = _find_platform(words)
        if preset is not None:
            return _compare(preset, source, description)
    return None if description is None else _build(description)


def _find_platform(words: Iterable[str]) -> Vehicle | None:
    """The platform that words name, of words within each other the longest; None where they name several."""
    found: dict[str, Vehicle] = {}
    for preset in list_presets():
        for word in preset.recognized_by:
            pattern = re.compile(rf"(^|[^a-z0-9]){re.escape(word)}([^a-z]|$)")
            if any(pattern.search(text.lower()) for text in words):
                found[word] = preset
    longest = {
        word: preset
        for word, preset in found.items()
        if not any(word in other for other in found if other != word)
    }
    presets = {preset.id: preset for preset in longest.values()}
    return next(iter(presets.values())) if len(presets) == 1 else None


def _compare(preset: Vehicle, source: VehicleSource, description: Description | None) -> Recognized:
    """A platform as its preset has it; where the description differs, both are said."""
    if description is None:
        return Recognized(preset, source)
    notes = []
    for name in _GEOMETRY:
        known, said = getattr(preset, name), getattr(description, name)
        if known and said and abs(said / known - 1.0) > _DIFFERS:
            notes.append(
                f"the robot description says {name} = {said:.4g}, the preset {preset.id} {known:g}: the "
                f"preset counts; vehicle.{name} = {said:.4g} takes the other"
            )
    return Recognized(preset, "robot_description", tuple(notes))


def _build(description: Description) -> Recognized | None:
    """A vehicle of a description alone, where it is complete."""
    values = {name: getattr(description, name) for name in (*_GEOMETRY, "base_to_rear_axle_m")}
    vehicle = make_vehicle(description.name or "robot", description.kind, values)
    return None if vehicle is None else Recognized(vehicle, "robot_description")


def make_vehicle(name: str, kind: str, geometry: Mapping[str, float | None]) -> Vehicle | None:
    """A vehicle of that name and geometry; None where its kind needs more."""
    name = name.strip("/")
    values = {"id": re.sub(r"\W+", "_", name.lower()), "name": name, "kind": kind, **geometry}
    try:
        vehicle = msgspec.convert(values, Vehicle)
    except msgspec.ValidationError:
        return None
    required = [quantity.name for quantity in vehicle.kinematics.geometry if quantity.required]
    return vehicle if all(getattr(vehicle, each) is not None for each in required) else None


def find_alike(radius_m: float, track_m: float) -> Vehicle | None:
    """The platform whose geometry is within a tenth of a radius and a track width; None where none is."""
    alike = [
        (abs(vehicle.wheel_radius_m / radius_m - 1.0) + abs(vehicle.track_width_m / track_m - 1.0), vehicle)
        for vehicle in list_presets()
        if vehicle.kind == "differential" and vehicle.track_width_m
    ]
    near = [(off, vehicle) for off, vehicle in alike if off < 2.0 * _DIFFERS]
    return min(near, key=lambda one: one[0])[1] if near else None


def list_contradictions(told: Vehicle, chosen: Vehicle) -> list[str]:
    """Numbers in which the vehicle that the log tells and the chosen one cannot be the same vehicle."""
    # A description of four wheels does not say whether they have rollers; what is commanded does.
    steered, is_car = (one.kinematics.has_inputs("steering") for one in (told, chosen))
    found = [] if steered == is_car else [f"kind {told.kind}, not {chosen.kind}"]
    for name, limit in (
        ("wheel_radius_m", _DIFFERS),
        ("track_width_m", _OTHER_TRACK),
        ("wheelbase_m", _OTHER_TRACK),
    ):
        said, taken = getattr(told, name), getattr(chosen, name)
        if said and taken and abs(said / taken - 1.0) > limit:
            found.append(f"{name} {said:.4g}, not {taken:g}")
    return found
