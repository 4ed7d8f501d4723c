"""SECURITY.md is short, and the tests and commands that it names are there."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "SECURITY.md"
MOST_LINES = 90
NAMED = re.compile(r"`(?P<file>tests/[\w/]+\.py)`|`make (?P<target>[\w-]+)`")


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
            is_there = any(name.startswith("test_") for name in functions)
        if not is_there:
            missing.append(named[0])
    return missing


def test_the_tests_that_the_page_names_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(NAMED.findall(text)) > 20
    assert find_missing(text) == []


def test_the_page_fits_on_two_pages() -> None:
    assert len(PAGE.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


def test_what_is_not_there_is_noticed() -> None:
    names = ["`tests/gone/test_x.py`", "`make nothing`", "`tests/fixtures/verbs.py`"]
    assert find_missing(f"{', '.join(names)}, `tests/packaging/test_security_page.py`, `make check`") == names
