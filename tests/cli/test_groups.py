"""The commands by task, and an option means the same everywhere."""

import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App
from verbs import run_program, run_verb

from pipeline.cli import build_app


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


def test_the_folder_of_results_is_one_option_and_nothing_else_has_its_name() -> None:
    options = {words: list_options(app) for words, app in list_apps(build_app())}
    without = {words for words, names in options.items() if names and "--results" not in names}
    assert without == {
        "effects", "model new", "model new-effect", "model literature", "model show", "simulate",
    }  # fmt: skip


def test_no_option_has_a_negative_that_means_nothing() -> None:
    denied = {
        name
        for _, app in list_apps(build_app())
        for name in list_options(app)
        if name.startswith(("--no-", "--empty-"))
    }
    assert denied == {"--no-diagnosis", "--no-report", "--no-logs"}
    assert run_verb("effects", "--no-json").returncode == 2


def test_completion_is_written_for_the_shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    done = run_program("--install-completion", "--shell", "bash")
    assert done.returncode == 0, done.stderr
    (script,) = (path for path in tmp_path.rglob("slip") if path.is_file())
    assert all(word in script.read_text() for word in ("doctor", "new-effect", "--effects"))
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    refused = run_verb("--install-completion", "--shell", "zsh")
    assert refused.returncode == 1
    assert "completion is not installed" in refused.stderr


def test_help_is_a_command_too() -> None:
    assert run_verb("help").stdout == run_verb("--help").stdout
    assert run_verb("help", "model", "add").stdout == run_verb("model", "add", "--help").stdout
