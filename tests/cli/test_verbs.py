"""The command line as scripts and people use it: output, exit codes, one clear line for every error."""

import json
import shutil
from pathlib import Path

import pytest
from verbs import ask_verb, print_verb, run_program, run_verb

from pipeline.simulate import simulate_case


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole log and one that was cut."""
    folder = tmp_path_factory.mktemp("field")
    simulate_case("husky_tile", out=folder / "good.mcap", duration_s=30.0)
    whole = (folder / "good.mcap").read_bytes()
    (folder / "truncated.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    return folder


def test_a_truncated_log_is_analyzed_up_to_the_cut(field: Path, tmp_path: Path) -> None:
    done = run_verb(
        "analyze", field / "truncated.mcap", "--results", tmp_path, "--json", "--no-report", "--no-diagnosis"
    )

    assert done.returncode == 3
    log = json.loads(done.stdout)["runs"][0]["log"]
    assert not log["complete"]
    assert {"kind", "bytes", "chunks", "start_s", "end_s"} <= log["losses"][0].keys()
    assert log["losses"][0]["bytes"] > 0


def test_json_is_all_that_stdout_holds_and_has_the_promised_keys(field: Path, tmp_path: Path) -> None:
    done = run_program(
        "analyze",
        field / "good.mcap",
        field / "missing.mcap",
        "--results",
        tmp_path,
        "--json",
        "--no-diagnosis",
    )

    assert done.returncode == 1, "one of two failed"
    content = json.loads(done.stdout)
    (run,) = content["runs"]
    assert {
        "run", "log", "vehicle", "input", "rate_hz", "samples", "segments", "median_modulus",
        "median_window_norm", "length_scale_m", "by_input", "held_poses", "findings", "report",
    } <= run.keys()  # fmt: skip
    assert {"path", "sha256", "duration_s", "complete", "losses"} <= run["log"].keys()
    assert run["input"] == "both"
    assert run["by_input"].keys() == {"command", "measured"}
    assert {"samples", "median_modulus", "median_window_norm", "rms"} <= run["by_input"]["measured"].keys()
    assert run["median_modulus"] == run["by_input"]["command"]["median_modulus"]
    assert Path(run["report"]).is_file()
    (error,) = content["errors"]
    assert error.keys() == {"path", "code", "message", "hint"}
    assert error["code"] == "log_not_found"


def test_a_stage_alone(field: Path, tmp_path: Path) -> None:
    done = run_verb("results", "stage", "extract", field / "good.mcap", "--results", tmp_path, "--json")
    assert done.returncode == 0
    assert set(json.loads(done.stdout)["rows"]) == {
        "alignments",
        "commands",
        "wheels",
        "poses",
        "imu",
        "findings",
    }

    by_run = run_verb("results", "stage", "slip", "good", "--results", tmp_path, "--json")
    assert json.loads(by_run.stdout)["computed"] == ["velocity", "slip"]


def test_results_of_a_log_that_changed_are_not_said_to_be_of_other_options(
    field: Path, tmp_path: Path
) -> None:
    log = Path(shutil.copytree(field, tmp_path / "field")) / "good.mcap"
    analyze = ("analyze", log, "--no-report", "--no-diagnosis", "--results", tmp_path / "out")
    print_verb(*analyze)
    shutil.copy(log.with_name("truncated.mcap"), log)
    told = run_verb(*analyze, "--interval", "all").stdout
    (line,) = [one for one in told.splitlines() if one.startswith("replaced")]
    assert "earlier results, made of what the log held before it changed; they are kept in" in line


def test_results_that_were_made_otherwise_are_not_replaced_without_a_word(
    field: Path, tmp_path: Path
) -> None:
    """One line says what they were made with, and where they are kept; the same options say nothing."""
    log = Path(shutil.copytree(field, tmp_path / "field")) / "good.mcap"
    analyze = ("analyze", log, "--no-report", "--no-diagnosis", "--results", tmp_path / "out")
    every = (*analyze, "--interval", "all")
    first = tmp_path / "out" / "runs" / "field" / "good" / "generation-1"

    assert "replaced" not in print_verb(*analyze)
    assert "replaced" not in print_verb(*analyze, "--force")
    kept = {path.name: path.read_bytes() for path in first.iterdir()}
    (line,) = [one for one in print_verb(*every).splitlines() if one.startswith("replaced")]
    assert "earlier results, made with use_intervals = recorded (now all); they are kept in" in line
    assert "generation-2 until slip batch --prune --keep 0" in line
    assert {path.name: path.read_bytes() for path in first.iterdir()} == kept
    status = print_verb("results", "status", "good", "--results", tmp_path / "out")
    assert [line.split("/")[-1] for line in status.splitlines() if line.startswith("earlier")] == [
        "generation-2",
        "generation-1",
    ]
    assert print_verb(*analyze, "--quiet") == ""
    (run,) = ask_verb(*every)["runs"]
    assert run["replaced"].startswith("made with use_intervals = recorded (now all); ")
    model = tmp_path / "model.toml"
    print_verb("model", "new", model, "effective_track", "--vehicle", "husky_a200")
    assert (
        "made with use_intervals = all (now recorded) and model = not set (now model.toml); "
        in print_verb(*analyze, "--model", model)
    )
    batch = ("batch", log, "--executor", "inline", "--results", tmp_path / "out", "--vehicle", "panther")
    assert "earlier results, made with vehicle.preset = not set (now panther)" in print_verb(*batch)
    (line,) = ask_verb(*batch[:-1], "husky_a200")["logs"]
    assert line["replaced"].startswith("made with vehicle.preset = panther (now husky_a200); ")
    (line,) = ask_verb(*batch, "--prune", "--keep", 0)["logs"]
    assert line["replaced"].endswith("preset = husky_a200 (now panther); they were removed")
    stage = ("results", "stage", "slip", log, "--results", tmp_path / "out", "--force")
    assert "with a summary, which the new ones lack; " in print_verb(*stage)


def test_simulate_writes_a_log_with_the_effect_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "sim.mcap"
    done = run_verb(
        "simulate", "ideal_husky", "--effect", "effective_track=1.8", "--duration", 20, "--file", out
    )
    assert done.returncode == 0, done.stderr
    assert out.is_file()


def test_a_diagnosis_of_a_damaged_log_says_why_it_ends_with_3(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "whole.mcap", duration_s=60.0)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: 3 * log.stat().st_size // 4])
    done = run_verb("diagnose", cut, "--results", tmp_path / "out")
    assert done.returncode == 3
    assert f"logs with losses: {cut} (slip inspect {cut} lists them)" in " ".join(done.stderr.split())
