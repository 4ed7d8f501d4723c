"""The ROS 2 package without ROS: files by the rules of their formats, command and launch on stand-ins."""

import argparse
import ast
import importlib
import os
import re
import runpy
import sys
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from verbs import print_verb, run_verb

from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "packaging" / "ros2" / "slip_ros2"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
DEPENDS = {"depend", "build_depend", "build_export_depend", "buildtool_depend", "exec_depend", "test_depend"}
OF_ROS = {"launch", "ros2cli", "ros2launch"}
"""Packages of every distribution of ROS 2, which are keys of rosdep by their names."""


@pytest.mark.lint
def test_the_manifest_keeps_the_rules_of_format_3() -> None:
    """REP 149: what must be there once, names, versions and the tags of dependencies."""
    package = ET.parse(PACKAGE / "package.xml").getroot()  # noqa: S314 - it is our own
    assert (package.tag, package.attrib) == ("package", {"format": "3"})
    tags = [child.tag for child in package]
    assert all(tags.count(once) == 1 for once in ("name", "version", "description", "export"))
    assert {"maintainer", "license"} <= set(tags)
    assert set(tags) <= {"name", "version", "description", "maintainer", "license", "export", *DEPENDS}
    texts = {child.tag: child.text or "" for child in package}
    assert re.fullmatch(r"[a-z][a-z0-9_]*", texts["name"])
    assert texts["name"] == PACKAGE.name
    assert texts["version"] == VERSION
    assert all("@" in child.attrib["email"] for child in package if child.tag == "maintainer")
    assert [child.text for child in package.findall("export/build_type")] == ["ament_python"]


@pytest.mark.lint
def test_every_dependency_is_a_key_of_rosdep() -> None:
    package = ET.parse(PACKAGE / "package.xml").getroot()  # noqa: S314 - it is our own
    assert {child.text for child in package if child.tag in DEPENDS} == OF_ROS


@pytest.mark.lint
def test_nothing_of_slip_is_imported_into_the_python_of_ros_and_humble_can_run_it() -> None:
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"), feature_version=(3, 10))
        names = {
            name.partition(".")[0]
            for one in ast.walk(tree)
            for name in (
                [alias.name for alias in one.names]
                if isinstance(one, ast.Import)
                else [one.module or ""]
                if isinstance(one, ast.ImportFrom)
                else []
            )
        }
        allowed = {"argparse", "launch", "ros2cli", "setuptools", "shutil", "subprocess", "sys", "__future__"}
        assert names <= allowed, path


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What setup.py asks of setuptools."""
    asked: dict[str, Any] = {}
    monkeypatch.setattr("setuptools.setup", lambda **given: asked.update(given))
    runpy.run_path(str(PACKAGE / "setup.py"))
    return asked


@pytest.mark.lint
def test_what_is_installed_is_there(installed: dict[str, Any]) -> None:
    assert installed["version"] == VERSION
    files = [name for _, names in installed["data_files"] for name in names]
    assert [name for name in files if not (PACKAGE / name).is_file()] == []
    assert {f"resource/{PACKAGE.name}", "package.xml", "launch/watch.launch.py"} <= set(files)
    assert all((PACKAGE / name / "__init__.py").is_file() for name in installed["packages"])


@pytest.fixture
def command(installed: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> argparse.ArgumentParser:
    """`ros2` with the command that the entry point names, as ros2cli adds it: a parser of a parser."""
    stand_in = ModuleType("ros2cli.command")
    stand_in.CommandExtension = type("CommandExtension", (), {})  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ros2cli", ModuleType("ros2cli"))
    monkeypatch.setitem(sys.modules, "ros2cli.command", stand_in)
    monkeypatch.syspath_prepend(PACKAGE)
    (entry,) = installed["entry_points"]["ros2cli.command"]
    name, _, place = entry.partition(" = ")
    module, _, kind = place.partition(":")
    extension = getattr(importlib.import_module(module), kind)()
    monkeypatch.delitem(sys.modules, module)
    monkeypatch.delitem(sys.modules, module.partition(".")[0])
    ros2 = argparse.ArgumentParser("ros2")
    parser = ros2.add_subparsers().add_parser(name, description=extension.__doc__)
    extension.add_arguments(parser, f"ros2 {name}", argv=None)
    parser.set_defaults(extension=extension)
    return ros2


@pytest.mark.parametrize(
    "words", [("effects", "drive_lag", "--json"), ("effects", "no_such_effect"), ("analyze", "--help")]
)
def test_ros2_slip_does_what_slip_does(
    words: tuple[str, ...],
    command: argparse.ArgumentParser,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    program = tmp_path / "slip"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m pipeline "$@"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    expected = run_verb(*words)
    args = command.parse_args(["slip", *words])
    code = args.extension.main(parser=command, args=args)
    assert code == expected.returncode
    assert capfd.readouterr().out == expected.stdout


def test_ros2_slip_without_a_slip_on_the_path_says_how_to_have_one(
    command: argparse.ArgumentParser, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    args = command.parse_args(["slip", "doctor"])
    assert args.extension.main(parser=command, args=args) == 1
    assert capfd.readouterr().err.endswith("pipx install slip-pipeline\n")


@dataclass
class _Action:
    """Stand-in for what a launch file makes: it keeps what it was given."""

    given: tuple[Any, ...] = ()
    named: dict[str, Any] = field(default_factory=dict)

    def __init__(self, *given: Any, **named: Any) -> None:  # noqa: ANN401 - of any action
        self.given, self.named = given, named

    def perform(self, context: dict[str, str]) -> str:
        """Value of a configuration."""
        return context[self.given[0]]


@pytest.mark.long
def test_the_launch_file_watches_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kinds in {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction"),
        "launch.substitutions": ("LaunchConfiguration",),
    }.items():
        module = ModuleType(name)
        vars(module).update({kind: type(kind, (_Action,), {}) for kind in kinds})
        monkeypatch.setitem(sys.modules, name, module)
    made = runpy.run_path(str(PACKAGE / "launch" / "watch.launch.py"))["generate_launch_description"]()
    *declared, start = made.given[0]
    context = {one.given[0]: one.named["default_value"] for one in declared}
    assert [name for name, default in context.items() if default is None] == ["folder"]
    (tmp_path / "bags").mkdir()
    simulate_case("husky_tile", out=tmp_path / "bags" / "run.mcap", duration_s=30.0)
    context |= {"folder": str(tmp_path / "bags"), "results": str(tmp_path / "results")}
    (process,) = start.named["function"](context)
    assert process.named["cmd"][:2] == ["slip", "watch"]
    assert "so far" in print_verb(*process.named["cmd"][1:], code=0)
