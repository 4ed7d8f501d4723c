"""Message types as trees, and the parser of ``ros2msg`` and ``ros1msg`` definitions."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

SEQUENCE: Final = -1
"""``Member.count`` of a sequence of varying length."""

NUMBER_TYPES: Final[Mapping[str, np.dtype[np.generic]]] = {
    name: np.dtype(name)
    for name in (
        "bool",
        "float32",
        "float64",
        *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)),
    )
}
"""Array type of every number type, in this machine's byte order."""

SIZES: Final[Mapping[str, int]] = {name: kind.itemsize for name, kind in NUMBER_TYPES.items()}
"""Bytes of every number type."""

MAX_FIXED: Final = 1 << 24
"""Longest fixed array taken seriously; a longer one in a definition is damage."""

MAX_DEPTH: Final = 64

MAX_LEAVES: Final = 1 << 14
"""Most fields of a type with all types below it; those of a robot have hundreds."""

_MAX_DIGITS: Final = 9

_ALIASES: Final = {"byte": "uint8", "char": "uint8", "octet": "uint8", "boolean": "bool"}
_ALIASES_ROS1: Final = {"byte": "int8", "char": "uint8"}
_SEPARATOR: Final = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_FIELD: Final = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?P<text_bound><=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)$"
)


class SchemaError(ValueError):
    """A definition that cannot be understood; the text says why."""


@dataclass(frozen=True, slots=True)
class Member:
    """One field of a structure.

    Attributes:
        name: field name.
        element: number type, ``"string"``, ``"wstring"``, or the structure of the field or its elements.
        count: None for a single value, ``SEQUENCE``, or the length of a fixed array.
    """

    name: str
    element: str | Structure
    count: int | None


@dataclass(frozen=True, slots=True)
class Structure:
    """A message type with everything below it resolved.

    Attributes:
        name: ``package/Name``.
        members: fields in the order of serialization.
    """

    name: str
    members: tuple[Member, ...]


@dataclass(frozen=True, slots=True)
class RawField:
    """A field before its type is looked up: name, type as written, count as in ``Member``."""

    name: str
    type: str
    count: int | None


RawTypes = dict[str, list[RawField]]


def short_name(name: str) -> str:
    """``package/Name`` of ``package/msg/Name`` or ``package::msg::Name``."""
    parts = [part for part in name.replace("::", "/").split("/") if part]
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else (parts[0] if parts else "")


def parse_msg(name: str, text: str, *, dialect: str = "ros2msg") -> Structure:
    """Parse a concatenated ``.msg`` definition.

    Args:
        name: type of the message, ``package/msg/Name``.
        text: its definition, then those of the types below it behind ``===`` and ``MSG: package/Name`` lines.
        dialect: ``ros2msg`` or ``ros1msg``.

    Raises:
        SchemaError: a line or a type that cannot be understood.
    """
    types: RawTypes = {}
    for position, section in enumerate(_SEPARATOR.split(text)):
        body = section.strip("\r\n ")
        section_name = short_name(name)
        if body.startswith("MSG:"):
            head, _, body = body.partition("\n")
            section_name = short_name(head[4:].strip())
        elif position > 0:
            continue
        types.setdefault(section_name, list(_parse_fields(body, dialect)))
    return resolve(short_name(name), types, dialect=dialect)


def _parse_fields(body: str, dialect: str) -> Iterator[RawField]:
    for raw_line in body.splitlines():
        line = raw_line.split("#", 1)[0].strip()
        if not line:
            continue
        match = _FIELD.match(line)
        if match is None:
            raise SchemaError(f"a line of the definition is no field: {line[:60]!r}")
        if match["rest"].lstrip().startswith("="):
            continue
        count: int | None = None
        if match["array"]:
            fixed = bool(match["count"]) and not match["bound"]
            count = parse_count(match["count"]) if fixed else SEQUENCE
        yield RawField(match["name"], _rename(match["type"], dialect), count)


def parse_count(digits: str) -> int:
    """The number of elements of an array.

    Raises:
        SchemaError: more elements than any message holds.
    """
    if len(digits) > _MAX_DIGITS:
        raise SchemaError(f"an array has a number of elements of {len(digits)} digits")
    return int(digits)


def _rename(type_name: str, dialect: str) -> str:
    aliases = _ALIASES_ROS1 if dialect == "ros1msg" else _ALIASES
    return aliases.get(type_name, type_name)


def resolve(root: str, types: Mapping[str, list[RawField]], *, dialect: str = "ros2msg") -> Structure:
    """Build the tree of ``root`` from flat definitions keyed by ``package/Name``.

    Raises:
        SchemaError: a type that is not defined, contains itself, or holds an absurd array or absurdly many
            fields.
    """
    return _Resolver({**_builtin_times(dialect), **types}).build(root, 0)


class _Resolver:
    def __init__(self, known: Mapping[str, list[RawField]]) -> None:
        self._known = known
        self._built: dict[str, Structure] = {}
        self._leaves: dict[str, int] = {}
        self._elements: dict[str, int] = {}

    def build(self, name: str, depth: int) -> Structure:
        if name in self._built:
            return self._built[name]
        if depth > MAX_DEPTH:
            raise SchemaError(f"type {name} contains itself")
        if name not in self._known:
            raise SchemaError(f"type {name} is not defined")
        package = name.split("/", 1)[0]
        members = tuple(self._member(field, package, depth) for field in self._known[name])
        self._built[name] = Structure(name, members)
        self._measure(name, members)
        return self._built[name]

    def _measure(self, name: str, members: tuple[Member, ...]) -> None:
        """Refuse types that a few lines of text blow up: each of two fields of a type of two fields of ..."""
        leaves = elements = 0
        for member in members:
            inside = "" if isinstance(member.element, str) else member.element.name
            leaves += self._leaves.get(inside, 1)
            elements += self._elements.get(inside, 1) * max(1, member.count or 1)
        if leaves > MAX_LEAVES or elements > MAX_FIXED:
            raise SchemaError(f"type {name} has {leaves} fields of {elements} elements")
        self._leaves[name], self._elements[name] = leaves, elements

    def _member(self, field: RawField, package: str, depth: int) -> Member:
        if field.count is not None and field.count > MAX_FIXED:
            raise SchemaError(f"field {field.name} is an array of {field.count} elements")
        if field.type in SIZES or field.type in ("string", "wstring"):
            return Member(field.name, field.type, field.count)
        return Member(field.name, self.build(_full_name(field.type, package), depth + 1), field.count)


def _full_name(type_name: str, package: str) -> str:
    if type_name == "Header":
        return "std_msgs/Header"
    if type_name in ("time", "duration"):
        return f"builtin_interfaces/{type_name.capitalize()}"
    return short_name(type_name) if "/" in type_name else f"{package}/{type_name}"


def _builtin_times(dialect: str) -> RawTypes:
    ros1 = dialect == "ros1msg"
    return {
        f"builtin_interfaces/{name}": [RawField("sec", seconds, None), RawField("nanosec", rest, None)]
        for name, seconds, rest in (
            ("Time", "uint32" if ros1 else "int32", "uint32"),
            ("Duration", "int32", "int32" if ros1 else "uint32"),
        )
    }


def leaf_paths(structure: Structure, prefix: str = "") -> Iterator[str]:
    """Every leaf field of a type as a path, ``[]`` marking sequences of structures."""
    for member in structure.members:
        path = f"{prefix}{member.name}"
        if isinstance(member.element, str):
            yield path
        else:
            yield from leaf_paths(member.element, f"{path}{'[]' if member.count is not None else ''}.")


def contains_text(structure: Structure, kind: str) -> bool:
    """Whether ``kind`` (``"wstring"``, ...) occurs anywhere below ``structure``."""
    return any(
        member.element == kind if isinstance(member.element, str) else contains_text(member.element, kind)
        for member in structure.members
    )
