"""Names in the code say what a thing is: no metaphor of the glossary's table comes back as an identifier."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]

PARTS = frozenset(
    {
        "told",
        "kept",
        "found",
        "begun",
        "rung",
        "promise",
        "hope",
        "prefers",
        "barred",
        "declined",
        "homes",
        "nurse",
    }
    | {"crew", "tell", "tells", "say", "says", "way", "reach", "around", "place", "worth", "adapt"}
    | {"promise", "promised", "promises"}
    | {"TELL", "TELLS", "TOLD", "WORTH"}
)
"""Words that are no part of a name: a mask, a match, a step, a residual have words of their own."""

WHOLE = frozenset({"more", "cells", "larger", "smaller", "tested", "left_out"})
"""Words that are no name alone, but fit as a part of one (`list_cells` of a table)."""

PUBLIC = {
    # A field of the sentences of effects, which are texts of their files, and the stage that an effect names.
    "pipeline/models/effect.py": {"Place"},
    "pipeline/plan/plan_files.py": {"promises"},  # a key of plan.toml
    "pipeline/recording/roles.py": {"left"},  # a key of run.toml
    "schemas/run_tables.py": {"rung"},  # a column
}
"""Vocabulary of files, screens and libraries, which stays."""


_WORD = re.compile(r"[A-Z][a-z]+")
"""A word of the name of a class."""


def list_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of every identifier, without an effect's `place`, which is public."""
    public = {id(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr == "place"}
    for kind in ast.walk(tree):
        for line in kind.body if isinstance(kind, ast.ClassDef) else ():
            targets = line.targets if isinstance(line, ast.Assign) else [getattr(line, "target", line)]
            public.update(id(one) for one in targets if isinstance(one, ast.Name) and one.id == "place")
    for node in ast.walk(tree):
        match node:
            case _ if id(node) in public:
                pass
            case ast.keyword(arg="place"):
                pass
            case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                yield node.lineno, name
            case ast.keyword(arg=str(name)):
                yield node.value.lineno, name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)):
                yield node.lineno, name
            case _:
                pass


def list_classes(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of every class, and of every type that is assigned to a name."""
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef(name=name) | ast.Name(id=name, ctx=ast.Store()) if _WORD.match(name.strip("_")):
                yield node.lineno, name
            case _:
                pass


def find_metaphors(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Identifiers and classes with a word of the lists, and `left` where no `right` stands beside it."""
    for node in tree.body:
        names = list(list_names(node))
        has_right = any("right" in name.split("_") for _, name in names)
        for line, name in names:
            plain = name.strip("_")
            if PARTS.intersection(plain.split("_")) or plain in WHOLE or (plain == "left" and not has_right):
                yield line, name
    for line, name in list_classes(tree):
        if PARTS.intersection(word.lower() for word in _WORD.findall(name)):
            yield line, name


def list_files() -> list[Path]:
    return sorted(path for room in ("pipeline", "schemas") for path in (ROOT / room).rglob("*.py"))


def test_no_identifier_is_a_metaphor() -> None:
    metaphors = []
    for path in list_files():
        name = path.relative_to(ROOT).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        metaphors += [
            f"{name}:{line} {word}"
            for line, word in find_metaphors(tree)
            if word not in PUBLIC.get(name, set())
        ]
    assert metaphors == []


def test_public_words_are_still_in_use() -> None:
    for name, words in PUBLIC.items():
        used = {word for _, word in find_metaphors(ast.parse((ROOT / name).read_text(encoding="utf-8")))}
        assert words <= used, name


@pytest.mark.parametrize(
    "source",
    [
        "found = []",
        "def score(told: bool) -> None: ...",
        "def tell_status() -> None: ...",
        "rows = [kept for kept in mask]",
        "part.way = 1",
        "call(around=context)",
        "left = error - explained",
        "def pick():\n    place = 0",
        "class Part:\n    def weigh(self, more: int) -> int: ...",
        "class Rung: ...",
        "class _KeptRun: ...",
        "Way = str",
        "CANNOT_TELL = 3",
        "_WORTH_SAYING = 0.05",
    ],
)
def test_a_planted_metaphor_is_found(source: str) -> None:
    assert list(find_metaphors(ast.parse(source)))


@pytest.mark.parametrize(
    "source",
    [
        "left, right = wheels",
        "front_left = 0.1",
        "left_speed = 0.1",
        "mask = values > 0",
        "def list_cells(row): ...",
        "class LadderStep: ...",
        "FOUND = 1",
        "class Lag(DriveEffect):\n    place = Place.DRIVE",
        "ordered = sorted(effects, key=lambda effect: effect.place)",
    ],
)
def test_standard_names_pass(source: str) -> None:
    assert not list(find_metaphors(ast.parse(source)))
