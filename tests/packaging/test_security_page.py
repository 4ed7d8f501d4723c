"""SECURITY.md promises a test for every threat: each that it names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEADING = "## Threats, and the test that covers each"
NAMED = re.compile(r"(?P<file>[\w/]+\.py)|::(?P<function>test_\w+)|`make (?P<target>[\w-]+)`")


def list_threats() -> list[tuple[str, str]]:
    """Each threat, and the cell that names what covers it."""
    table = (ROOT / "SECURITY.md").read_text(encoding="utf-8").partition(HEADING)[2]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")][1:]
    assert all(len(row) == 3 for row in rows), "each row has a threat, what holds, and its tests"
    return [(row[0], row[2]) for row in rows]


def find_missing(cell: str) -> list[str]:
    """What a cell names that is not there."""
    missing, functions, is_any = [], set(), False
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for named in NAMED.finditer(cell):
        is_any = True
        if named["file"]:
            path = ROOT / "tests" / named["file"]
            tree = ast.parse(path.read_text(encoding="utf-8")) if path.is_file() else ast.Module([], [])
            functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
            there = path.is_file()
        elif named["function"]:
            there = named["function"] in functions
        else:
            there = re.search(f"^{named['target']}:", makefile, re.MULTILINE) is not None
        if not there:
            missing.append(named[0])
    return missing if is_any else ["a test"]


@pytest.mark.parametrize(("threat", "cell"), list_threats())
def test_each_threat_has_the_tests_that_are_named(threat: str, cell: str) -> None:
    assert find_missing(cell) == [], threat


def test_what_is_not_there_is_noticed() -> None:
    here = "packaging/test_security_page.py"
    assert find_missing(f"{here}::test_gone, `make nothing`, gone/test_x.py, ::test_y") == [
        "::test_gone",
        "`make nothing`",
        "gone/test_x.py",
        "::test_y",
    ]
    assert find_missing("nothing at all") == ["a test"]
    assert find_missing(f"{here}::test_what_is_not_there_is_noticed") == []
