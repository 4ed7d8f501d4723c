"""Python of the handbook is run as one session; notebooks run from the first cell to the last."""

import ast
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import nbformat
import pytest
from blocks import find_difference, open_session, read_commands

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
SAID = {
    "first_log": "wheel_separation_multiplier: 1.805",
    "hidden_effect": "Wheel asymmetry: the right wheels are 5.4 % larger",
    "own_effect": "mine.k",
}


@pytest.mark.lint
def test_python_of_a_page_is_one_session(tmp_path: Path) -> None:
    text = (
        "```pycon\n>>> for k in (1, 2):\n...     print(k)\n...\n1\n2\n```\nand\n```pycon\n>>> k + 1\n3\n```\n"
    )
    commands = read_commands(text)
    with open_session(tmp_path) as run:
        assert [find_difference(command.shown, run(command)) for command in commands] == ["", ""]
        assert [command.shown for command in commands] == [("1", "2"), ("3",)]
        with pytest.raises(RuntimeError, match="missing"):
            run(replace(commands[0], text="missing"))


@pytest.mark.lint
def test_each_notebook_is_stored_without_outputs() -> None:
    assert {path.stem for path in NOTEBOOKS} == set(SAID)
    for path in NOTEBOOKS:
        cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
        assert [cell for cell in cells if cell.outputs or cell.execution_count] == []


@pytest.mark.long
def test_the_first_notebook_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells one after the other, without a notebook server: the last expression of each is shown."""
    (tmp_path / "data_samples").symlink_to(ROOT / "data_samples")
    (tmp_path / "examples").mkdir()
    monkeypatch.chdir(tmp_path / "examples")
    names: dict[str, object] = {}
    shown = []
    for cell in nbformat.read(ROOT / "examples" / "first_log.ipynb", as_version=4).cells:
        if cell.cell_type != "code":
            continue
        body = ast.parse(cell.source)
        last = body.body.pop() if isinstance(body.body[-1], ast.Expr) else None
        exec(compile(body, "first_log", "exec"), names)  # noqa: S102 - the notebook's own cells
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "first_log", "eval"), names)  # noqa: S307 - likewise
            for how in ("_repr_html_", "_repr_svg_"):
                shown += [getattr(value, how)()] if hasattr(value, how) else []
    assert sum("<svg" in text for text in shown) == 3
    assert any("effective_track" in text and "drive_lag" in text for text in shown)
    assert (tmp_path / "examples" / "husky.toml").is_file()


@pytest.mark.long
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_tables_and_charts(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "examples" / notebook.name
    place.parent.mkdir()
    (tmp_path / "data_samples").symlink_to(ROOT / "data_samples")
    place.write_bytes(notebook.read_bytes())
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    command = [sys.executable, "-m", "jupyter", "execute", "--inplace", "--timeout=900", str(place)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

    shown: dict[str, str] = {}
    for cell in nbformat.read(place, as_version=4).cells:
        for output in cell.get("outputs", ()):
            for kind, text in output.get("data", {"text/plain": output.get("text", "")}).items():
                shown[kind] = shown.get(kind, "") + str(text)
    assert "<table>" in shown["text/html"]
    assert SAID[notebook.stem] in shown["text/html"] + shown["text/plain"]
    assert "<svg" in shown["image/svg+xml"]
