"""From a log whose names were made to break out, through the diagnosis, to the files of all targets."""

import ast
import json
import tomllib
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.sax.saxutils import quoteattr

import pytest
import yaml
from simulated_platforms import PLATFORMS, simulate_platform
from verbs import run_verb

from pipeline.export import list_targets
from pipeline.simulate.facts import Published

NAME = (
    'bot"""; EXECUTED = 1; """ \'\'\'---><include file="/etc/passwd"/><!--- '
    "{name}\\N{x}\n\r\t\u2028\U0001f916 -"
)


def rename_robot(topic: Published, name: str) -> Published:
    """A robot description with another name, as XML has to have it."""
    text = str(topic.fields["data"])
    quoted = quoteattr(name, {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})
    return replace(topic, fields={"data": text.replace('name="diffbot"', f"name={quoted}", 1)})


def write_log(path: Path, monkeypatch: pytest.MonkeyPatch, name: str = NAME, **radius: str) -> Path:
    kind = PLATFORMS["diff_drive_controller"]
    topics = [rename_robot(one, name) if one.topic == "/robot_description" else one for one in kind.topics]
    for old, new in radius.items():
        topics = [
            replace(one, fields={"data": str(one.fields["data"]).replace(old.replace("_", "."), new)})
            if one.topic == "/robot_description"
            else one
            for one in topics
        ]
    monkeypatch.setitem(PLATFORMS, "hostile", replace(kind, topics=tuple(topics)))
    effects = {"drive_lag": 0.3}
    return simulate_platform("hostile", effects, out=path, seed=5, duration_s=40.0)


def test_names_of_a_log_are_data_in_every_file_that_is_made_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_log(tmp_path / "a---> \"\"\" ''' {x} #.mcap", monkeypatch)
    model, results = tmp_path / "model.toml", tmp_path / "results"
    said = run_verb("diagnose", log, "--apply", model, "--results", results, "--quiet")
    assert said.returncode == 0, said.stderr
    tree = tomllib.loads(model.read_text(encoding="utf-8"))
    assert tree["vehicle"]["name"] == NAME
    (run,) = [row["run"] for row in tree["fit"]["runs"]]
    for target in list_targets():
        more = ("--on", log, "--results", results) if target.has_errors else ()
        answer = run_verb("model", "export", model, "--to", target.name, *more)
        if answer.returncode:
            refusals = ("has parameters for ackermann vehicles", "has no errors of wheel odometry")
            assert any(one in answer.stderr for one in refusals)
            continue
        text = answer.stdout
        if target.name == "python":
            space: dict[str, object] = {}
            exec(compile(ast.parse(text), "exported", "exec"), space)  # noqa: S102 - that is what it is for
            assert space["VEHICLE"] == NAME
            assert "EXECUTED" not in space
        elif target.name == "json":
            assert json.loads(text)["vehicle"]["name"] == NAME
        elif text.startswith("<"):
            root = ET.fromstring(text)  # noqa: S314 - it is our own
            assert not list(root.iter("include"))
            assert repr(NAME).replace("--", r"-\x2d") in text
        else:
            assert f"{text[0]} {NAME!r}: {target.about}." in text
            assert f" of {run!r} (SHA-256 " in text
            if text[0] == "#" and target.name != "px4":
                # Doubtful values are comments: all of them may be.
                nodes = yaml.safe_load(text) or {}
                assert all(set(node) == {"ros__parameters"} for node in nodes.values())
