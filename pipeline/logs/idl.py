"""The parser of ``ros2idl`` definitions: the part of OMG IDL that ROS 2 generates."""

import re
from collections.abc import Iterator
from typing import Final

from pipeline.logs.schema import (
    MAX_DEPTH,
    MAX_FIXED,
    SEQUENCE,
    SIZES,
    RawField,
    RawTypes,
    SchemaError,
    Structure,
    parse_count,
    resolve,
    short_name,
)

_SEPARATOR: Final = re.compile(r"^={3,}[ \t\r]*$", re.MULTILINE)
_HIDDEN: Final = re.compile(
    r'(?P<string>"(?:[^"\\]|\\.)*+(?:"|\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|^[ \t\r]*#[^\n]*|^IDL:[^\n]*',
    re.MULTILINE | re.DOTALL,
)
"""Strings and comments, whichever begins first. What is not closed reaches to the end: one look will do."""

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
        text: ``module``, ``struct``, ``typedef`` and ``const`` declarations; sections behind ``===`` lines.

    Raises:
        SchemaError: a declaration that cannot be understood.
    """
    types: RawTypes = {}
    for section in _SEPARATOR.split(text):
        plain = _HIDDEN.sub(lambda found: '""' if found["string"] else " ", section)
        _Reader(_TOKEN.findall(plain), types).read_declarations([])
    return resolve(short_name(name), types)


class _Reader:
    """Reads declarations into ``types``; typedefs and constants live as long as their section."""

    def __init__(self, tokens: list[str], types: RawTypes) -> None:
        self._tokens = tokens
        self._place = 0
        self._types = types
        self._typedefs: dict[str, tuple[str, int | None]] = {}
        self._constants: dict[str, int] = {}

    def read_declarations(self, modules: list[str]) -> None:
        if len(modules) > MAX_DEPTH:
            raise SchemaError(f"modules are nested more than {MAX_DEPTH} deep")
        while self._place < len(self._tokens) and self._here() != "}":
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
        while self._place < len(self._tokens) and self._here() == "::":
            self._next()
            self._next()
        if self._place < len(self._tokens) and self._here() == "(":
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
        raise SchemaError(f"{word!r} is no length of an array")

    def _here(self) -> str:
        if self._place >= len(self._tokens):
            raise SchemaError("the definition breaks off")
        return self._tokens[self._place]

    def _next(self) -> str:
        word = self._here()
        self._place += 1
        return word

    def _expect(self, word: str) -> None:
        found = self._next()
        if found != word:
            raise SchemaError(f"{found!r} stands in place of {word!r}")
