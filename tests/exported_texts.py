"""Exported files as those who take them read them: what they hold, and the names in them."""

from __future__ import annotations

import ast
import csv
import json
import math
import re
from collections.abc import Callable
from xml.etree import ElementTree as ET

import yaml

RUNS = "EXECUTED"
"""A name of the exported module that only a name that runs can assign."""
HOSTILE = [
    f'bot"""\n{RUNS} = 1\n"""',
    f"bot'''\n{RUNS} = 1\n'''",
    f'"; {RUNS} = 1; "',
    f"x\\'; {RUNS} = 1 #",
    f"{{radius}}{{name}}{{steps}} {{{RUNS}}} {{0}} %s %(name)s $HOME",
    "\\N{x}",
    "\\u0022\\x2d\\",
    "\\",
    '\\"""\n"""',
    "a-",
    "a--",
    "a---",
    "--->",
    "---->",
    '---><include file="/etc/passwd"/><!---',
    "--><plugin filename='evil.so' name='evil'/><!--",
    "]]></x><x>&amp;&#10;&lt;",
    "line\nevil: 1",
    "line\r\nevil: 1",
    "line\revil: 1",
    "a\u2028evil: 1\u2029b\x85c",
    "\x00\x01\x07\x1b[31m\x7f\x9f",
    "\ud800 alone",
    "\U0001f916 \U0010ffff \ufeff\u202e",
    "é ß 雪 \u0301",
    "# a\n1\t1\tRO_SPEED_LIM\t9\t9",
    ": [ *a &b !!python/object/apply:os.system ['x']",
    "- a: b\n---\n...\n%YAML 9.9",
    "",
    " ",
    "'",
    '"',
    "''",
    "x" * 5000,
]


def read_python(text: str) -> tuple[object, list[str]]:
    tree = ast.parse(text)
    space: dict[str, object] = {}
    exec(compile(text, "exported", "exec"), space)  # noqa: S102 - that is what it is for
    assert RUNS not in space
    names = [str(space["VEHICLE"])]
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "VEHICLE":
            node.value = ast.Constant("")
    return ast.dump(tree), names


def _refuse_constant(name: str) -> None:
    raise AssertionError(f"{name} is no JSON")


def read_json(text: str) -> tuple[object, list[str]]:
    content = json.loads(text, parse_constant=_refuse_constant)
    vehicle = content["vehicle"]
    runs = content["fit"].get("runs")
    fitted = [row["run"] for row in runs if "run" in row] if isinstance(runs, list) else []
    names = [vehicle["name"], vehicle["id"], *fitted, *content.get("warnings", [])]
    return [sorted(content), sorted(vehicle), content["effects"]], names


def read_xml(text: str) -> tuple[object, list[str]]:
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))  # noqa: S314 - it is our own
    root = ET.fromstring(text, parser)  # noqa: S314
    comments = [str(one.text).strip() for one in root.iter() if one.tag is ET.Comment]
    elements = [one for one in root.iter() if one.tag is not ET.Comment]
    for one in elements:
        require_finite(" ".join([one.text or "", *one.attrib.values()]).split())
    return [(one.tag, one.attrib, (one.text or "").strip()) for one in elements], list_literals(comments)


def read_parameters(text: str) -> tuple[object, list[str]]:
    tree = yaml.safe_load(text)
    assert tree == yaml.load(text, Loader=yaml.CSafeLoader)
    values = [tree]
    while values:
        value = values.pop()
        values += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        assert value is None or isinstance(value, dict | list) or math.isfinite(value)
    return tree, list_literals(list_comments(text))


def read_table(text: str) -> tuple[object, list[str]]:
    rows = [row for row in csv.reader(text.split("\n"), delimiter="\t") if row and row[0][:1] != "#"]
    assert {len(row) for row in rows} <= {5}
    assert all(math.isfinite(float(row[3])) for row in rows)
    return rows, list_literals(list_comments(text))


def require_finite(words: list[str]) -> None:
    """Refuse the words of numbers that are not finite."""
    assert not {word.lower().lstrip("+-") for word in words} & {"nan", "inf", "infinity"}


def list_comments(text: str) -> list[str]:
    return [line.strip() for line in text.split("\n") if line.strip().startswith("#")]


LITERAL = r"""(?<!\w)(?:'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")"""


def list_literals(comments: list[str]) -> list[str]:
    """The literals in comments, from left to right."""
    names = []
    for line in comments:
        assert line.isprintable()
        # An apostrophe of ours follows a letter.
        names += [ast.literal_eval(one) for one in re.findall(LITERAL, line)]
    return names


READERS: dict[str, Callable[[str], tuple[object, list[str]]]] = {
    "json": read_json,
    "python": read_python,
    "traction": read_python,
    "gazebo": read_xml,
    "px4": read_table,
    **dict.fromkeys(
        ("autoware", "nav2", "nav2_traction", "robot_localization", "ros2_control", "vesc"), read_parameters
    ),
}
"""By target."""
