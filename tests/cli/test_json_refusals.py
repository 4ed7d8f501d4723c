"""Refusals are answers too: with --json, every verb prints exactly one JSON object, whatever it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from verbs import run_verb

from pipeline.cli import build_app
from pipeline.simulate import simulate_case

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cyclopts import App

BROKEN = "broken.mcap"
REFUSED: dict[str, list[tuple[str, ...]]] = {
    "analyze": [(BROKEN, "--no-report"), ("missing.mcap",), (BROKEN, "--config", "missing.toml")],
    "diagnose": [
        (BROKEN,),
        ("missing.mcap",),
        (BROKEN, "--model", "missing.toml"),
        ("a", "--budget", "soon"),
    ],
    "watch": [("ws://192.0.2.1:8765",)],
    "inspect": [(BROKEN,), ("missing.mcap",)],
    "export": [("missing", "--to", "csv")],
    "model show": [("missing.toml",), ("bad.toml",)],
    "model add": [("missing.toml", "drive_lag", "--on", BROKEN), ("husky.toml", "nothing", "--on", BROKEN)],
    "model drop": [("husky.toml", "drive_lag", "--on", BROKEN)],
    "model remove": [("husky.toml", "drive_lag", "--on", BROKEN)],
    "model fit": [("husky.toml", "--on", BROKEN), ("bad.toml", "--on", BROKEN)],
    "model compare": [("husky.toml", "missing.toml", "--on", BROKEN)],
    "model literature": [("nobody",)],
    "model trust": [("missing.toml",)],
    "effects": [("nothing",)],
    "serve": [("missing", "--memory", "much")],
    "plan": [(BROKEN,), ("--vehicle", "nothing"), ("--vehicle", "husky_a200", "--time", "soon")],
    "simulate": [("nothing",)],
    "check": [(BROKEN, BROKEN), ("missing", "missing"), (BROKEN, BROKEN, "--to", "junit")],
    "compare": [("missing",)],
    "fleet fit": [("missing",)],
    "fleet show": [("missing",)],
    "fleet predict": [("--vehicle", "husky_a200", "--terrain", "snow", "--results", "missing")],
    "fleet trend": [("missing",)],
    "fleet share": [("missing", "--file", "shared.parquet")],
    "fleet map": [("missing",)],
    "fleet map add": [(BROKEN, "--file", "map.csv")],
    "fleet map merge": [("missing.csv", BROKEN, "--file", "map.csv")],
    "batch": [("--results", "missing"), (BROKEN, "--shard", "soon")],
    "batch run": [(BROKEN, "--shard", "soon")],
    "results status": [("missing",)],
    "results verify": [("missing",)],
    "results explain": [("missing", "modulus", "--results", "missing")],
    "results query": [("SELECT", "--results", "missing")],
    "results stage": [("extract", BROKEN), ("slip", "missing")],
}
"""Arguments that each verb with --json refuses."""
NEVER_REFUSES = {"doctor", "model trusted", "model untrust"}


def list_verbs(app: App, chain: tuple[str, ...] = ()) -> Iterator[str]:
    """Verbs that take --json."""
    for name in app:
        if not name.startswith("-"):
            verb = app[name]
            yield from list_verbs(verb, (*chain, name))
            arguments = verb.assemble_argument_collection() if verb.default_command else ()
            if any("--json" in argument.names for argument in arguments):
                yield " ".join((*chain, name))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refused")
    (folder / BROKEN).write_bytes(b"no log at all" * 99)
    (folder / "bad.toml").write_text("[model\n")
    assert run_verb("model", "new", folder / "husky.toml", "--vehicle", "husky_a200").returncode == 0
    return folder


def test_every_verb_with_json_is_asked() -> None:
    assert set(list_verbs(build_app())) - NEVER_REFUSES == set(REFUSED)


@pytest.mark.parametrize(
    ("verb", "arguments"), [(verb, one) for verb, each in REFUSED.items() for one in each]
)
def test_a_refusal_is_one_json_object(verb: str, arguments: tuple[str, ...], place: Path) -> None:
    done = run_verb(*verb.split(), *arguments, "--json", cwd=place)
    assert done.returncode == 1, done.stderr
    answer = json.loads(done.stdout)
    assert answer["errors"], answer
    for error in answer["errors"]:
        assert error.keys() == {"path", "code", "message", "hint"}
        assert error["message"] in done.stderr or error["path"] in done.stderr


@pytest.mark.parametrize("verb", sorted(REFUSED))
def test_wrong_usage_is_one_json_object(verb: str, place: Path) -> None:
    done = run_verb(*verb.split(), "--no-such-option", "--json", cwd=place)
    assert done.returncode == 2
    (error,) = json.loads(done.stdout)["errors"]
    assert error["code"] == "usage"
    assert "--no-such-option" in error["message"] or "requires an argument" in error["message"]


def test_a_former_verb_says_its_place_in_json() -> None:
    done = run_verb("status", "--json")
    assert done.returncode == 2
    assert "slip results status" in json.loads(done.stdout)["errors"][0]["message"]


def test_without_json_a_refusal_prints_nothing_on_stdout(place: Path) -> None:
    done = run_verb("inspect", BROKEN, cwd=place)
    assert (done.returncode, done.stdout) == (1, "")
    # Behind --, it is the name of a file.
    done = run_verb("inspect", "--", "--json", cwd=place)
    assert (done.returncode, done.stdout) == (1, "")


def test_a_run_that_proposes_no_model_is_still_told(tmp_path: Path) -> None:
    simulate_case("husky_in_the_air", out=tmp_path / "run.mcap")
    done = run_verb("diagnose", "run.mcap", "--apply", "model.toml", "--json", cwd=tmp_path)
    assert done.returncode == 1
    answer = json.loads(done.stdout)
    (run,) = answer["runs"]
    assert "not_moving" in [finding["id"] for finding in run["findings"]]
    (error,) = answer["errors"]
    assert error["code"] == "nothing_to_apply"
    assert error["path"] == "model.toml"
    assert not (tmp_path / "model.toml").exists()
    # People read the diagnosis as well.
    told = run_verb("diagnose", "run.mcap", "--apply", "model.toml", cwd=tmp_path)
    assert told.returncode == 1
    assert "The vehicle does not move" in told.stdout
    assert "no model can be proposed" in told.stderr
