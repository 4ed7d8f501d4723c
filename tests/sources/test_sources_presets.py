"""Presets, and the vehicle that a configuration and a log come to."""

import pytest

from pipeline.sources import ConfigurationError, find_preset, list_presets, resolve_vehicle
from pipeline.sources.configuration import VehicleSection

PRESETS = list_presets()


def test_a_preset_has_the_geometry_of_its_ideal_model() -> None:
    for vehicle in PRESETS:
        needed = [quantity.name for quantity in vehicle.kinematics.geometry if quantity.required]
        assert all(getattr(vehicle, name) for name in needed)
        assert 0.01 < vehicle.wheel_radius_m < 1.0


def test_a_preset_is_found_by_id_and_alias_however_they_are_written() -> None:
    for vehicle in PRESETS:
        for name in (vehicle.id, *vehicle.aliases):
            assert find_preset(name) == vehicle
            assert find_preset(f" {name.upper().replace('_', '-')} ") == vehicle


def test_published_vehicles_have_their_published_numbers() -> None:
    for name, radius, track, mass in [
        ("husky_a200", 0.165, 0.55, 75.0),
        ("warthog", 0.30, 1.08, 470.0),
        ("marmotte_hd2", 0.116, 0.5927, None),
    ]:
        vehicle = find_preset(name)
        assert (vehicle.wheel_radius_m, vehicle.track_width_m, vehicle.mass_kg) == (radius, track, mass)


def test_the_log_names_the_vehicle_when_nobody_else_does() -> None:
    assert resolve_vehicle(VehicleSection(), recorded="Husky", where="a.mcap").id == "husky_a200"


def test_the_configuration_wins_over_the_log() -> None:
    found = resolve_vehicle(VehicleSection(preset="jackal"), recorded="husky", where="a.mcap")
    assert found.id == "jackal"


@pytest.mark.parametrize(
    ("section", "recorded", "code", "words"),
    [
        (VehicleSection(), None, "vehicle_unknown", ["does not name one", "--vehicle", "VEHICLE="]),
        (VehicleSection(), "spot", "vehicle_unknown", ["spot", "husky_a200", "--wheel-radius"]),
        (VehicleSection(preset="huskey"), "husky", "vehicle_unknown", ["huskey", "husky_a200"]),
        (VehicleSection(wheel_radius_m=0.1), None, "vehicle_incomplete", ["track_width_m", "--track-width"]),
        (
            VehicleSection(wheel_radius_m=0.1, kind="ackermann"),
            None,
            "vehicle_incomplete",
            ["wheelbase_m", "run.toml"],
        ),
    ],
)
def test_a_vehicle_that_cannot_be_determined_is_asked_for(
    section: VehicleSection, recorded: str | None, code: str, words: list[str]
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        resolve_vehicle(section, recorded=recorded, where="a.mcap")
    said = str(caught.value)
    assert caught.value.code == code
    assert "\n" not in said
    assert said.startswith("a.mcap: ")
    assert [word for word in words if word not in said] == []
