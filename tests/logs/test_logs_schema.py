"""Definitions mean what rosidl says they mean."""

import pytest
from mcap_files import is_ros2_name

from pipeline.logs import bundled_types, definition_text
from pipeline.logs.schema import (
    SEQUENCE,
    SchemaError,
    Structure,
    bundled_structure,
    leaf_paths,
    parse_idl,
    parse_msg,
)

TEXT = """# a comment
int32 LIMIT=5   # a constant
string NAME="a # b"
float64 x 0.5
float64[] open
float64[<=4] bounded
uint8[3] fixed [1, 2, 3]
string<=8 short
string<=8[<=2] shorts
Header header
demo_msgs/msg/Inner inner
Inner[] many
char letter
byte raw
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: demo_msgs/Inner
bool flag
"""


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_every_kind_of_field_is_understood(line_end: str) -> None:
    structure = parse_msg("demo_msgs/msg/Outer", TEXT.replace("\n", line_end))
    members = {member.name: member for member in structure.members}
    assert list(members) == [
        *("x", "open", "bounded", "fixed", "short", "shorts", "header", "inner", "many", "letter", "raw"),
    ]
    assert [members[name].count for name in ("x", "open", "bounded", "fixed", "short", "shorts", "many")] == [
        *(None, SEQUENCE, SEQUENCE, 3, None, SEQUENCE, SEQUENCE),
    ]
    assert isinstance(members["many"].element, Structure)
    assert members["inner"].element is members["many"].element
    assert {members["letter"].element, members["raw"].element} == {"uint8"}
    assert "many[].flag" in set(leaf_paths(structure))
    assert "header.stamp.nanosec" in set(leaf_paths(structure))


@pytest.mark.parametrize(
    "text",
    ["float64", "demo/Missing m", "demo/Outer again", "uint8[99999999999] x", "float64[-1] x", "x", "---"],
)
def test_what_is_no_definition_is_refused(text: str) -> None:
    with pytest.raises(SchemaError):
        parse_msg("demo/msg/Outer", text)


@pytest.mark.parametrize("text", ["struct A {", "module m { struct A { double x[y]; }; };", "union U {};"])
def test_what_is_no_idl_is_refused(text: str) -> None:
    with pytest.raises(SchemaError):
        parse_idl("m/msg/A", text)


def test_bundled_names_are_of_ros_2_except_one_of_a_bag_of_ros_1() -> None:
    assert [kind for kind in bundled_types() if not is_ros2_name(kind)] == ["racepak/msg/rp_wheel_encoders"]


@pytest.mark.parametrize("kind", bundled_types())
def test_bundled_definitions_are_complete_in_themselves(kind: str) -> None:
    text = definition_text(kind)
    assert text is not None
    assert parse_msg(kind, text) == bundled_structure(kind)
    assert any(leaf_paths(parse_msg(kind, text))) == ("Empty" not in kind)
