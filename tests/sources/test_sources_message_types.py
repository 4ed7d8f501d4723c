"""What is known of message types: fields that exist, units that are known."""

import re

import pytest

from pipeline.logs import bundled_types
from pipeline.logs.schema import bundled_structure, leaf_paths
from pipeline.sources import ConfigurationError, Signal, convert_unit, find_preset
from pipeline.sources.message_types import MessageType, find_type, list_types

PARTS = ("drive", "number", "numbers", "joints", "pose", "fix", "ground_velocity", "imu")
KNOWN = sorted({kind for part in PARTS for kind in list_types(part)})
BUNDLED = {name.replace("/msg/", "/") for name in bundled_types()}


def list_paths(kind: MessageType) -> list[str]:
    paths = [kind.numbers.field] if kind.numbers else []
    if kind.drive is not None:
        paths += [*kind.drive.first.split("+"), *kind.drive.second.split("+")]
        paths += [kind.drive.sideways] if kind.drive.sideways else []
    if kind.text is not None:
        paths = [path for path in paths if not path.startswith(f"{kind.text.field}.")]
        paths += [kind.text.field, kind.text.tag]
    if kind.number is not None:
        paths += [kind.number.field, *filter(None, [kind.number.per_turn])]
    if kind.joints is not None:
        plain = [kind.joints.velocity, kind.joints.position]
        inner = [kind.joints.interfaces, kind.joints.values]
        paths += [kind.joints.names, *(inner if kind.joints.interfaces else plain)]
    if kind.fix is not None:
        paths += [kind.fix.latitude, kind.fix.longitude, kind.fix.altitude, kind.fix.status]
    if kind.ground_velocity is not None:
        paths += [kind.ground_velocity.east, kind.ground_velocity.north]
    if kind.pose is not None:
        paths += filter(None, [kind.pose.parent, kind.pose.child, kind.pose.names, kind.pose.angle])
    for vectors in (
        kind.pose and (kind.pose.position, kind.pose.orientation),
        kind.imu and (kind.imu.rate, kind.imu.force),
    ):
        for fields in filter(None, vectors or ()):
            paths += fields if isinstance(fields, list) else [f"{fields}.{axis}" for axis in "xyz"]
    return paths


def test_every_field_is_one_of_the_type() -> None:
    for name in [name for name in KNOWN if name in BUNDLED]:
        structure = bundled_structure(name)
        assert structure is not None
        leaves = list(leaf_paths(structure))
        indexed = re.compile(r"\[\d+\]$")
        paths = [path for each in list_paths(find_type(name)) for path in Signal("", each).fields()]
        wrong = [path for path in paths if indexed.sub("", path) not in leaves]
        assert wrong == []


def test_an_index_inside_a_path_names_one_element_of_every_message() -> None:
    signal = Signal.parse("/scout_status.actuator_states[1].rpm+actuator_states[2].rpm")
    assert signal.fields() == ("actuator_states[].rpm[1]", "actuator_states[].rpm[2]")


def test_units_are_converted() -> None:
    for unit, raw, value, made in [
        ("rpm", 60.0, 6.283185, "rad/s"),
        ("mm/s", 250.0, 0.25, "m/s"),
        ("deg", 90.0, 1.570796, "rad"),
    ]:
        scale, offset, si = convert_unit(unit, {}, where="/wheels")
        assert scale * (raw - offset) == pytest.approx(value)
        assert si == made


def test_a_platform_knows_its_own_units() -> None:
    car = find_preset("f1tenth")
    scale, offset, made = convert_unit("servo", car.units, where="/commands/servo/position")
    assert scale * (0.5304 - 1.2135 * 0.2 - offset) == pytest.approx(0.2)
    assert made == "rad"


def test_a_unit_that_nobody_knows_is_asked_about() -> None:
    with pytest.raises(ConfigurationError) as caught:
        convert_unit("ticks", {}, where="/left/tick")
    assert caught.value.code == "unit_unknown"
    assert "per_turn" in str(caught.value)
    assert "\n" not in str(caught.value)
