"""SECURITY.md is short; the tests and commands that it and the page of promises name are there."""

import ast
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "SECURITY.md"
MOST_LINES = 90
PROMISES = ROOT / "docs" / "pages" / "promises.md"
NAMED = re.compile(r"`(?P<file>tests/[\w/]+\.py)(?:::(?P<test>\w+))?`|`make (?P<target>[\w-]+)`")


def find_missing(text: str) -> list[str]:
    """What a text names that is not there, or holds no test."""
    missing = []
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for named in NAMED.finditer(text):
        path = ROOT / (named["file"] or "")
        if named["target"]:
            is_there = re.search(f"^{named['target']}:", makefile, re.MULTILINE) is not None
        else:
            tree = ast.parse(path.read_text(encoding="utf-8")) if path.is_file() else ast.Module([], [])
            functions = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
            tests = {name for name in functions if name.startswith("test_")}
            is_there = named["test"] in tests if named["test"] else bool(tests)
        if not is_there:
            missing.append(named[0])
    return missing


def test_the_tests_that_the_page_names_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(NAMED.findall(text)) > 20
    assert find_missing(text) == []


def test_the_tests_that_the_page_of_promises_names_are_there() -> None:
    text = PROMISES.read_text(encoding="utf-8")
    assert find_missing(text) == []
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        assert any(named["test"] for named in NAMED.finditer(section)), section[:40]


def test_every_row_that_is_held_names_its_test() -> None:
    for page in (PAGE, PROMISES):
        text = page.read_text(encoding="utf-8")
        tables = re.findall(r"^(\|.*\| held by \|\n)\|[-| ]+\|\n((?:\|.*\|\n)+)", text, re.MULTILINE)
        assert tables
        for _, rows in tables:
            for row in rows.splitlines():
                assert any(named["test"] for named in NAMED.finditer(row)), row


def test_the_page_fits_on_two_pages() -> None:
    assert len(PAGE.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_what_is_not_there_is_noticed() -> None:
    names = ["`tests/gone/test_x.py`", "`make nothing`", "`tests/fixtures/verbs.py`"]
    names += ["`tests/packaging/test_security_page.py::test_gone`", "`tests/fixtures/verbs.py::slip`"]
    assert find_missing(f"{', '.join(names)}, `tests/packaging/test_security_page.py`, `make check`") == names
