"""Trees of message types, from definitions of ROS 1, ROS 2 and IDL, and the standard types.

The rosbags library parses definitions. Here its fields become a tree of bounded size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from typing import Final

import numpy as np
from rosbags.typesys.base import BaseType, Cardinality, Field, Message, TypesysError
from rosbags.typesys.idl import IDLParser
from rosbags.typesys.msg import MSGParser

SEQUENCE: Final = -1
"""``Member.count`` of a sequence of variable length."""

NUMBER_TYPES: Final[Mapping[str, np.dtype[np.generic]]] = {
    name: np.dtype(name)
    for name in (
        "bool",
        "float32",
        "float64",
        *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)),
    )
}
"""Array type of every number type, in native byte order."""

SIZES: Final[Mapping[str, int]] = {name: kind.itemsize for name, kind in NUMBER_TYPES.items()}
"""Size of every number type [bytes]."""

MAX_FIXED: Final = 1 << 24
"""Maximum length of a fixed array; a longer one indicates a damaged definition."""

MAX_DEPTH: Final = 64

MAX_LEAVES: Final = 1 << 14
"""Maximum number of fields of a type with all nested types; those of a robot have hundreds."""

_MAX_DEFINITION: Final = 1 << 18
"""Maximum length of a definition with all nested types [characters]; those of a robot have thousands."""

_ALIASES: Final = {"byte": "uint8", "char": "uint8", "octet": "uint8", "boolean": "bool"}
_ALIASES_ROS1: Final = {"byte": "int8", "char": "uint8"}
_RULE: Final = f"\n{'=' * 80}\n"
_SEPARATOR: Final = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)


class SchemaError(ValueError):
    """A definition that cannot be parsed; the text states the reason."""


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
    """A message type with all nested types resolved.

    Attributes:
        name: ``package/Name``.
        members: fields in the order of serialization.
    """

    name: str
    members: tuple[Member, ...]


def short_name(name: str) -> str:
    """``package/Name`` of ``package/msg/Name`` or ``package::msg::Name``."""
    parts = [part for part in name.replace("::", "/").split("/") if part]
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else (parts[0] if parts else "")


@lru_cache(256)
def parse_msg(name: str, text: str, *, dialect: str = "ros2msg") -> Structure:
    """Parse a concatenated ``.msg`` definition.

    Args:
        name: type of the message, ``package/msg/Name``.
        text: its definition, then those of nested types, each after ``===`` and ``MSG: package/Name`` lines.
        dialect: ``ros2msg`` or ``ros1msg``.

    Raises:
        SchemaError: the definition cannot be parsed, a type is not defined, contains itself, or exceeds
            `MAX_FIXED` array elements or `MAX_LEAVES` fields.
    """
    sections = [section.strip("\n ") for section in _SEPARATOR.split(text.replace("\r\n", "\n"))]
    named = [body for body in sections[1:] if body.startswith("MSG:")]
    first = sections[0] if sections[0].startswith("MSG:") else f"MSG: {name}\n{sections[0]}"
    return _resolve(name, _parse(MSGParser, _RULE[1:].join(f"{body}\n" for body in [first, *named])), dialect)


_HIDDEN: Final = re.compile(
    r'(?P<string>"(?:[^"\\]|\\.)*+(?:"|\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|^[ \t\r]*#[^\n]*|^IDL:[^\n]*',
    re.MULTILINE | re.DOTALL,
)
"""Strings and comments; an unclosed one extends to the end of the text, so that matching is linear."""


_ANNOTATION: Final = re.compile(r"@\s*+[\w:]++(?:\s*+\([^()]*+\))?")

_COSTLY: Final = re.compile(r"[(*]|<<|\]\s*+\[|sequence\s*+<\s*+sequence\b")
"""What costs the parser exponential time or memory; no definition that ROS makes has any of it."""


def parse_idl(name: str, text: str) -> Structure:
    """Parse concatenated IDL definitions.

    Args:
        name: type of the message, ``package/msg/Name``.
        text: ``module``, ``struct``, ``typedef`` and ``const`` declarations; ``===`` lines separate sections.

    Raises:
        SchemaError: as `parse_msg`.
    """
    plain = _HIDDEN.sub(lambda match: '""' if match["string"] else " ", text)
    plain = _ANNOTATION.sub(" ", plain)
    if _COSTLY.search(plain):
        raise SchemaError("it holds brackets in brackets, or numbers that must be computed")
    parts = [part for part in _SEPARATOR.split(plain) if part.strip()]
    parsed = [message for part in parts for message in _parse(IDLParser, part)]
    return _resolve(name, parsed)


def _parse(parser: type[MSGParser | IDLParser], text: str) -> list[Message]:
    if len(text) > _MAX_DEFINITION:
        raise SchemaError(f"it has {len(text)} characters")
    try:
        return parser(text).specification()
    # The library asserts what its grammar should exclude, and converts numbers of any length.
    except (TypesysError, ValueError, AssertionError, RecursionError, TypeError) as error:
        rest = str(error).rstrip("\n").rpartition("\n")[2]
        raise SchemaError(f"it cannot be parsed at {rest[:60]!r}") from error


def _resolve(name: str, messages: Sequence[Message], dialect: str = "ros2msg") -> Structure:
    """Build the tree of a type from parsed definitions."""
    types: dict[str, tuple[Field, ...]] = {}
    for message in messages:
        fields = tuple(message.fields)
        is_empty = [field.name for field in fields] == ["structure_needs_at_least_one_member"]
        types.setdefault(short_name(message.name), () if is_empty else fields)
    return _Resolver(types, dialect).build(short_name(name), 0)


class _Resolver:
    def __init__(self, known: Mapping[str, tuple[Field, ...]], dialect: str) -> None:
        self._known = known
        self._aliases = _ALIASES_ROS1 if dialect == "ros1msg" else _ALIASES
        self._built = {} if "builtin_interfaces/Time" in known else _builtin_times(dialect)
        self._leaves: dict[str, int] = {}
        self._elements: dict[str, int] = {}

    def build(self, name: str, depth: int) -> Structure:
        if name in self._built:
            return self._built[name]
        if depth > MAX_DEPTH:
            raise SchemaError(f"type {name} contains itself")
        if name not in self._known:
            raise SchemaError(f"type {name} is not defined")
        members = tuple(self._member(field, depth) for field in self._known[name])
        self._built[name] = Structure(name, members)
        self._measure(name, members)
        return self._built[name]

    def _measure(self, name: str, members: tuple[Member, ...]) -> None:
        """Refuse types that grow exponentially by nesting: two fields of a type with two fields of ..."""
        leaves = elements = 0
        for member in members:
            inside = "" if isinstance(member.element, str) else member.element.name
            leaves += self._leaves.get(inside, 1)
            elements += self._elements.get(inside, 1) * max(1, member.count or 1)
        if leaves > MAX_LEAVES or elements > MAX_FIXED:
            raise SchemaError(f"type {name} has {leaves} fields of {elements} elements")
        self._leaves[name], self._elements[name] = leaves, elements

    def _member(self, field: Field, depth: int) -> Member:
        size = field.typ.size
        if not 0 <= size <= MAX_FIXED:
            raise SchemaError(f"field {field.name} is an array of {size} elements")
        count = {Cardinality.SCALAR: None, Cardinality.SEQUENCE: SEQUENCE}.get(field.typ.cardinality, size)
        reference = field.typ.ref
        if isinstance(reference, BaseType):
            plain = str(reference.name.value)
            return Member(field.name, self._aliases.get(plain, plain), count)
        return Member(field.name, self.build(_full_name(reference.name), depth + 1), count)


def _full_name(type_name: str) -> str:
    inner = type_name.rsplit("/", 1)[-1]
    if inner == "Header":
        return "std_msgs/Header"
    if inner in ("time", "duration"):
        return f"builtin_interfaces/{inner.capitalize()}"
    return short_name(type_name)


def _builtin_times(dialect: str) -> dict[str, Structure]:
    ros1 = dialect == "ros1msg"
    return {
        (name := f"builtin_interfaces/{kind}"): Structure(
            name, (Member("sec", seconds, None), Member("nanosec", rest, None))
        )
        for kind, seconds, rest in (
            ("Time", "uint32" if ros1 else "int32", "uint32"),
            ("Duration", "int32", "int32" if ros1 else "uint32"),
        )
    }


def leaf_paths(structure: Structure, prefix: str = "") -> Iterator[str]:
    """Paths of all leaf fields of a type; ``[]`` marks sequences of structures."""
    for member in structure.members:
        path = f"{prefix}{member.name}"
        if isinstance(member.element, str):
            yield path
        else:
            yield from leaf_paths(member.element, f"{path}{'[]' if member.count is not None else ''}.")


def contains_text(structure: Structure, kind: str) -> bool:
    """Whether ``structure`` or a nested type has a field of type ``kind``, such as ``"wstring"``."""
    return any(
        member.element == kind if isinstance(member.element, str) else contains_text(member.element, kind)
        for member in structure.members
    )


# Definitions of the standard message types, for writing and for logs without definitions.
#
# The file ``definitions.msg`` contains them in the format of a concatenated schema.


@cache
def _fields() -> dict[str, str]:
    """Fields of every bundled type, one per line, by ``package/Name``."""
    text = resources.files("pipeline.logs").joinpath("definitions.msg").read_text("utf-8")
    sections = (section.partition("\n") for section in text.removesuffix("\n").split(_RULE))
    return {head.removeprefix("MSG: "): fields for head, _, fields in sections}


def definition_text(type_name: str) -> str | None:
    """The concatenated ``ros2msg`` definition of a bundled type, None if it is not bundled.

    Args:
        type_name: ``package/msg/Name`` or ``package/Name``.
    """
    root, fields = short_name(type_name), _fields()
    if root not in fields:
        return None
    order = [root]
    for name in order:
        kinds = [field.split()[0].split("[")[0] for field in fields[name].splitlines()]
        order += [kind for kind in dict.fromkeys(kinds) if kind not in (*SIZES, "string", *order)]
    return _RULE.join([fields[root], *(f"MSG: {name}\n{fields[name]}" for name in order[1:])]) + "\n"


@cache
def bundled_structure(type_name: str) -> Structure | None:
    """The tree of a bundled type, None if it is not bundled."""
    text = definition_text(type_name)
    return None if text is None else parse_msg(type_name, text)


def bundled_types() -> tuple[str, ...]:
    """All bundled types as ``package/msg/Name``."""
    return tuple(name.replace("/", "/msg/") for name in _fields())
