"""Python that a model file names is not run before its very content has been trusted."""

import json
import os
import py_compile
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.models import read_model, write_model
from pipeline.models.catalogue import distrust, list_trusted, trust
from pipeline.models.model_file import list_code, parse_model
from pipeline.run import MotionError
from pipeline.simulate import simulate_case
from pipeline.web.session import Session, SessionFile, Step, show_session

MODEL = """effects = ["own.py"]
[vehicle]
preset = "husky_a200"
[[effect]]
id = "effective_track"
k = 1.5
[[effect]]
id = "tilt"
k = 0.2
"""
OWN = """
import pathlib
pathlib.Path({mark!r}).write_text("ran")
from pipeline.models import LinearEffect, Parameter

class Tilt(LinearEffect):
    "Adds speed to the left."
    id = "tilt"
    parameters = (Parameter("k", "1", (-1.0, 1.0), 0.0, "share", 0.1),)

    def columns(self, rolling, velocity, around):
        return {{"k": (0.0, rolling.v0, 0.0)}}
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    folder = tmp_path / "somebody's"
    folder.mkdir()
    (folder / "own.py").write_text(OWN.format(mark=str(tmp_path / "mark")), encoding="utf-8")
    path = folder / "m.toml"
    path.write_text(MODEL, encoding="utf-8")
    return path


def has_run(model: Path) -> bool:
    return (model.parents[1] / "mark").exists()


def test_untrusted_python_does_not_run_and_what_it_defines_is_left_out_and_named(model: Path) -> None:
    file = read_model(model)
    assert not has_run(model)
    assert file.model.ids == ("effective_track",)
    assert file.omitted == ("tilt",)
    (warning,) = file.warnings
    assert "'own.py'" in warning
    assert "tilt" in warning
    assert "slip model trust" in warning
    assert "\n" not in warning


def test_what_was_left_out_is_never_lost_from_the_file(model: Path) -> None:
    file = read_model(model)
    before = model.read_bytes()
    with pytest.raises(MotionError, match="tilt would be lost"):
        write_model(file, model)
    assert model.read_bytes() == before
    assert [path.name for path in sorted(model.parent.iterdir())] == ["m.toml", "own.py"]


def test_trust_is_in_the_content_wherever_it_lies_and_ends_when_it_changes(
    model: Path, tmp_path: Path
) -> None:
    trust(list_code(model))
    assert not has_run(model)
    assert read_model(model).model.ids == ("effective_track", "tilt")
    assert has_run(model)
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(model.parent, elsewhere)
    assert read_model(elsewhere / "m.toml").warnings == ()
    with (elsewhere / "own.py").open("a", encoding="utf-8") as file:
        file.write("# one more line\n")
    assert read_model(elsewhere / "m.toml").omitted == ("tilt",)
    distrust(set(list_code(model)))
    assert read_model(model).omitted == ("tilt",)


def test_the_bytes_that_were_judged_are_the_bytes_that_run(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file swapped after it was read, or something else compiled beside it, does not run."""
    trust(list_code(model))
    own = model.parent / "own.py"
    good, other = own.read_text(encoding="utf-8"), model.parents[1] / "other"
    evil = f"import pathlib; pathlib.Path({str(other)!r}).write_text('ran')\n".ljust(len(good), "#")
    own.write_text(evil, encoding="utf-8")
    py_compile.compile(str(own), doraise=True)
    stamp = own.stat()
    own.write_text(good, encoding="utf-8")
    os.utime(own, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))

    from pipeline.models import model_file  # noqa: PLC0415 - patched

    def swap(content: bytes) -> str:
        own.write_text(evil, encoding="utf-8")
        return original(content)

    original = model_file.hash_code
    monkeypatch.setattr(model_file, "hash_code", swap)
    assert "tilt" in read_model(model).model.ids
    assert not other.exists()


@pytest.mark.parametrize(
    "name", ["/etc/evil.py", "../evil.py", "a/../../evil.py", "..", "", "a\\..\\b.py", "a\0b.py"]
)
def test_python_lies_beside_the_model_file(model: Path, name: str) -> None:
    text = MODEL.replace('"own.py"', json.dumps(name))
    with pytest.raises(MotionError, match="must lie beside") as caught:
        parse_model(text, model)
    assert caught.value.where == f"{model}:1"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_plain_file_is_refused_at_once(model: Path, make: Callable[[Path], None]) -> None:
    (model.parent / "own.py").unlink()
    make(model.parent / "own.py")
    with pytest.raises(MotionError, match=r"own\.py"):
        read_model(model)


def test_trusted_code_in_a_list_that_others_may_write_does_not_count(
    model: Path, own_configuration: Path
) -> None:
    trust(list_code(model))
    path = own_configuration / "slip" / "trusted_code"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    path.chmod(0o666)
    with pytest.raises(MotionError, match="yours alone"):
        read_model(model)
    assert not has_run(model)


def test_a_relative_configuration_folder_counts_for_nothing(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    trust(list_code(model))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CONFIG_HOME", ".")
    monkeypatch.chdir(tmp_path)
    assert list_trusted() == {}


def test_a_model_out_of_a_results_folder_runs_nothing_in_the_workbench_and_says_so(model: Path) -> None:
    file = SessionFile(model.parent, "run")
    file.model_path.parent.mkdir(parents=True)
    shutil.copy(model.parent / "own.py", file.model_path.parent)
    ladder: list[dict[str, object]] = [{"t_mrmse_m": 0.1, "r_mrmse_rad": 0.1}]
    step = Step(said="opened", model=MODEL, order=["effective_track", "tilt"], ladder=ladder)
    session = Session(run="run", key="k", input="command", steps=[step], at=0)
    shown = show_session(session, file.parse(step.model))
    assert not has_run(model)
    assert "left out: tilt" in str(shown["warnings"])
    assert [card["id"] for card in shown["effects"]] == ["effective_track"]  # type: ignore[attr-defined]


@pytest.mark.long
def test_an_analysis_says_what_it_leaves_out_and_is_made_again_when_it_is_trusted(
    model: Path, tmp_path: Path
) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "run.mcap", duration_s=12.0)
    options = Options(out=tmp_path / "results", model=model)
    before = analyze_log(log, options)
    (finding,) = [row for row in before.summary["findings"] if row["id"] == "model_code_left_out"]
    assert "tilt" in finding["text"]
    assert not has_run(model)
    assert not analyze_log(log, options).computed
    trust(list_code(model))
    after = analyze_log(log, options)
    assert after.computed
    assert "model_code_left_out" not in {row["id"] for row in after.summary["findings"]}
