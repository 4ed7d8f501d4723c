"""The ROS 2 package without ROS: files by the rules of their formats, command and launch on stand-ins."""

import argparse
import importlib
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
import yaml
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
    keys = {child.text for child in package if child.tag in DEPENDS}
    own = yaml.safe_load((PACKAGE.parent / "rosdep.yaml").read_text("utf-8"))
    assert keys - OF_ROS == own.keys()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["name"]
    for systems in own.values():
        assert {"ubuntu", "debian"} <= systems.keys()
        assert all(rule == {"pip": {"packages": [project]}} for rule in systems.values())


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
    words: tuple[str, ...], command: argparse.ArgumentParser, capfd: pytest.CaptureFixture[str]
) -> None:
    expected = run_verb(*words)
    args = command.parse_args(["slip", *words])
    code = args.extension.main(parser=command, args=args)
    assert code == expected.returncode
    assert capfd.readouterr().out == expected.stdout


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
    python, *module, verb = process.named["cmd"][:4]
    assert (python, module, verb) == (sys.executable, ["-m", "pipeline"], "watch")
    assert "so far" in print_verb(*process.named["cmd"][3:], code=0)
