"""Trees of message types: parsers of ROS 1, ROS 2 and IDL definitions, and the standard types."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Final

import numpy as np

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

_MAX_DIGITS: Final = 9

_ALIASES: Final = {"byte": "uint8", "char": "uint8", "octet": "uint8", "boolean": "bool"}
_ALIASES_ROS1: Final = {"byte": "int8", "char": "uint8"}
_SEPARATOR: Final = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_FIELD: Final = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?P<text_bound><=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?"
    r"\s+(?P<name>[A-Za-z]\w*)(?P<rest>.*)$"
)


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


@dataclass(frozen=True, slots=True)
class RawField:
    """A field before its type is resolved: name, type as written, count as in ``Member``."""

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
        text: its definition, then those of nested types, each after ``===`` and ``MSG: package/Name`` lines.
        dialect: ``ros2msg`` or ``ros1msg``.

    Raises:
        SchemaError: a line or a type cannot be parsed.
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
            raise SchemaError(f"a line of the definition is not a field: {line[:60]!r}")
        if match["rest"].lstrip().startswith("="):
            continue
        count: int | None = None
        if match["array"]:
            fixed = bool(match["count"]) and not match["bound"]
            count = parse_count(match["count"]) if fixed else SEQUENCE
        yield RawField(match["name"], _rename(match["type"], dialect), count)


def parse_count(digits: str) -> int:
    """Parse the number of elements of an array.

    Raises:
        SchemaError: it has more than `_MAX_DIGITS` digits.
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
        SchemaError: a type is not defined, contains itself, or exceeds `MAX_FIXED` array elements or
            `MAX_LEAVES` fields.
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
        """Refuse types that grow exponentially by nesting: two fields of a type with two fields of ..."""
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


_HIDDEN: Final = re.compile(
    r'(?P<string>"(?:[^"\\]|\\.)*+(?:"|\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|^[ \t\r]*#[^\n]*|^IDL:[^\n]*',
    re.MULTILINE | re.DOTALL,
)
"""Strings and comments; an unclosed one extends to the end of the text, so that matching is linear."""

_TOKEN: Final = re.compile(r'""|\'(?:[^\'\\\n]|\\.){1,8}+\'|::|[A-Za-z_][\w]*|[\d.]+[\w.+-]*|\S')
_NUMBERS: Final = {
    "boolean": "bool",
    "octet": "uint8",
    "char": "uint8",
    "float": "float32",
    "double": "float64",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
}
_QUALIFIERS: Final = ("unsigned", "long", "short", "double")


def parse_idl(name: str, text: str) -> Structure:
    """Parse concatenated IDL definitions.

    Args:
        name: type of the message, ``package/msg/Name``.
        text: ``module``, ``struct``, ``typedef`` and ``const`` declarations; ``===`` lines separate sections.

    Raises:
        SchemaError: a declaration cannot be parsed.
    """
    types: RawTypes = {}
    for section in _SEPARATOR.split(text):
        plain = _HIDDEN.sub(lambda match: '""' if match["string"] else " ", section)
        _Reader(_TOKEN.findall(plain), types).read_declarations([])
    return resolve(short_name(name), types)


class _Reader:
    """Reads declarations into ``types``; typedefs and constants are local to their section."""

    def __init__(self, tokens: list[str], types: RawTypes) -> None:
        self._tokens = tokens
        self._position = 0
        self._types = types
        self._typedefs: dict[str, tuple[str, int | None]] = {}
        self._constants: dict[str, int] = {}

    def read_declarations(self, modules: list[str]) -> None:
        if len(modules) > MAX_DEPTH:
            raise SchemaError(f"modules are nested more than {MAX_DEPTH} deep")
        while self._position < len(self._tokens) and self._here() != "}":
            word = self._next()
            if word == "@":
                self._skip_annotation()
            elif word == "module":
                inside = self._next()
                self._expect("{")
                self.read_declarations([*modules, inside])
                self._expect("}")
            elif word == "struct":
                self._read_struct(modules)
            elif word == "typedef":
                self._read_typedef()
            elif word == "const":
                self._read_constant()
            elif word == "enum":
                self._read_enum()
            elif word != ";":
                raise SchemaError(f"the declaration {word!r} is not understood")

    def _read_struct(self, modules: list[str]) -> None:
        name = self._next()
        self._expect("{")
        fields: list[RawField] = []
        while self._here() != "}":
            if self._here() == "@":
                self._next()
                self._skip_annotation()
                continue
            kind, count = self._read_type()
            fields += [RawField(field, kind, size) for field, size in self._read_names(count)]
        self._expect("}")
        if [field.name for field in fields] == ["structure_needs_at_least_one_member"]:
            fields = []
        self._types[short_name("/".join([*modules, name]))] = fields

    def _read_typedef(self) -> None:
        kind, count = self._read_type()
        for name, size in self._read_names(count):
            self._typedefs[name] = (kind, size)

    def _read_constant(self) -> None:
        self._read_type()
        name = self._next()
        self._expect("=")
        value = ""
        while self._here() != ";":
            value += self._next()
        if re.fullmatch(r"[0-9]+", value):
            self._constants[name] = parse_count(value)

    def _read_enum(self) -> None:
        self._typedefs[self._next()] = ("uint32", None)
        while self._next() != "}":
            pass

    def _read_names(self, count: int | None) -> Iterator[tuple[str, int | None]]:
        while True:
            name, size = self._next(), count
            while self._here() == "[":
                self._next()
                length = self._number()
                self._expect("]")
                if count == SEQUENCE:
                    raise SchemaError(f"{name} is an array of sequences")
                size = length * (1 if size is None else size)
                if size > MAX_FIXED:
                    raise SchemaError(f"field {name} is an array of {size} elements")
            yield name, size
            if self._next() == ";":
                return

    def _read_type(self) -> tuple[str, int | None]:
        word = self._next()
        if word == "sequence":
            self._expect("<")
            if self._here() == "sequence":
                raise SchemaError("a sequence of sequences is not understood")
            kind, count = self._read_type()
            if count is not None:
                raise SchemaError("a sequence of arrays is not understood")
            self._skip_bound()
            return kind, SEQUENCE
        if word in ("string", "wstring"):
            if self._here() == "<":
                self._next()
                self._skip_bound()
            return word, None
        if word in SIZES:
            return word, None
        while word.split()[-1] in _QUALIFIERS and self._here() in _QUALIFIERS:
            word += f" {self._next()}"
        if word in _NUMBERS:
            return _NUMBERS[word], None
        while self._here() == "::":
            self._next()
            word += f"::{self._next()}"
        return self._typedefs.get(word.rsplit("::", 1)[-1], (word.replace("::", "/"), None))

    def _skip_bound(self) -> None:
        while self._next() != ">":
            pass

    def _skip_annotation(self) -> None:
        self._next()
        while self._position < len(self._tokens) and self._here() == "::":
            self._next()
            self._next()
        if self._position < len(self._tokens) and self._here() == "(":
            depth = 0
            while True:
                depth += {"(": 1, ")": -1}.get(self._next(), 0)
                if depth == 0:
                    return

    def _number(self) -> int:
        word = self._next()
        if re.fullmatch(r"[0-9]+", word):
            return parse_count(word)
        if word in self._constants:
            return self._constants[word]
        raise SchemaError(f"{word!r} is not a length of an array")

    def _here(self) -> str:
        if self._position >= len(self._tokens):
            raise SchemaError("the definition is truncated")
        return self._tokens[self._position]

    def _next(self) -> str:
        word = self._here()
        self._position += 1
        return word

    def _expect(self, word: str) -> None:
        word_read = self._next()
        if word_read != word:
            raise SchemaError(f"{word_read!r} stands in place of {word!r}")


# Definitions of the standard message types, for writing and for logs without definitions.
#
# The file ``definitions.msg`` contains them in the format of a concatenated schema.

_RULE: Final = f"\n{'=' * 80}\n"


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
