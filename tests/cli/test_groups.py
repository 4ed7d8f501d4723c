"""The commands by task: what moved says where to, and an option means the same everywhere."""

import inspect
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App
from verbs import run_program, run_verb

from pipeline.cli import build_app
from pipeline.simulate import simulate_case

MOVED = {
    "trend": "fleet trend",
    "map": "fleet map",
    "status": "results status",
    "verify": "results verify",
    "explain": "results explain",
    "query": "results query",
    "stage": "results stage",
    "schedule": "batch schedule",
}


def list_apps(app: App, words: str = "") -> Iterator[tuple[str, App]]:
    """Every command with its words, from the top."""
    for name in app:
        if not name.startswith("-"):
            yield f"{words}{name}", app[name]
            yield from list_apps(app[name], f"{words}{name} ")


def list_options(app: App) -> set[str]:
    if not inspect.isfunction(app.default_command):
        return set()
    arguments = app.assemble_argument_collection(default_parameter=build_app().default_parameter)
    return {name for argument in arguments for name in argument.names}


@pytest.mark.parametrize("old", MOVED)
def test_a_command_that_moved_names_its_new_place(old: str, tmp_path: Path) -> None:
    done = run_verb(old, "--json", cwd=tmp_path)

    assert done.returncode == 2
    assert json.loads(done.stdout)["errors"][0]["message"] == f"slip {old} is now: slip {MOVED[old]}"
    assert done.stderr == f"slip: slip {old} is now: slip {MOVED[old]}\n"
    assert MOVED[old] in dict(list_apps(build_app()))
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_results_is_one_option_and_nothing_else_has_its_name() -> None:
    options = {words: list_options(app) for words, app in list_apps(build_app())}
    without = {words for words, names in options.items() if names and "--results" not in names}
    assert without == {
        "batch schedule", "effects", "model new", "model new-effect",
        "model literature", "model show", "model trust", "model untrust", "model trusted", "simulate",
    }  # fmt: skip
    for names in options.values():
        assert not names & {"--out", "--known"}


def test_no_option_has_a_negative_that_means_nothing() -> None:
    denied = {
        name
        for _, app in list_apps(build_app())
        for name in list_options(app)
        if name.startswith(("--no-", "--empty-"))
    }
    assert denied == {"--no-diagnosis", "--no-report", "--no-logs"}
    assert run_verb("effects", "--no-json").returncode == 2


def test_out_is_still_understood_as_what_it_was_called_before(tmp_path: Path) -> None:
    log, out = tmp_path / "a.mcap", tmp_path / "season"
    assert run_verb("simulate", "husky_tile", "--duration", "8", "--out", log).returncode == 0
    assert log.is_file()
    words = ("analyze", log, f"--out={out}", "--no-report", "--no-diagnosis", "--json")
    assert json.loads(run_verb(*words).stdout)["runs"][0]["same_content_as"] is None
    again = run_verb("analyze", log, "--results", out, "--no-report", "--no-diagnosis")
    assert "nothing was computed" in again.stdout
    assert "--out" not in run_verb("analyze", "--help").stdout
    # What follows -- is a name, whatever it is.
    assert "--out: " in run_verb("analyze", "--", "--out").stderr


def test_a_batch_has_its_verb_and_does_without(tmp_path: Path) -> None:
    simulate_case("husky_tile", out=tmp_path / "logs" / "a.mcap", duration_s=20.0)
    first = run_verb("batch", "logs", "--settle", 0, "--json", cwd=tmp_path)
    again = run_verb("batch", "run", "logs", "--settle", 0, "--json", cwd=tmp_path)
    assert (first.returncode, again.returncode) == (0, 0)
    assert json.loads(first.stdout)["done"] == json.loads(again.stdout)["unchanged"] == 1
    assert "batch run logs" in run_verb("batch", "schedule", "logs", cwd=tmp_path).stdout


def test_completion_is_written_for_the_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    done = run_program("--install-completion", "--shell", "bash")
    assert done.returncode == 0, done.stderr
    (script,) = (path for path in tmp_path.rglob("slip") if path.is_file())
    assert all(word in script.read_text() for word in ("doctor", "new-effect", "--trust-code"))
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    refused = run_verb("--install-completion", "--shell", "zsh")
    assert refused.returncode == 1
    assert "completion is not installed" in refused.stderr


def test_help_is_a_command_too() -> None:
    assert run_verb("help").stdout == run_verb("--help").stdout
    assert run_verb("help", "model", "add").stdout == run_verb("model", "add", "--help").stdout
