"""Verbs that read stored runs leave them as they are, and say what contradicts them."""

import itertools
import json
import shutil
from pathlib import Path

import pytest
from few import few
from stored import hash_tree
from verbs import ask_verb, print_verb, run_verb, slip

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import Diagnosis, diagnose_runs
from pipeline.store import Store
from pipeline.store.checksums import decode_checked, encode_checked

ERRORS = ("t_mrmse_m", "r_mrmse_rad")


@pytest.mark.parametrize("name", ["field/wide.mcap", "field/wide"])
def test_a_fit_leaves_stored_results_byte_for_byte(place: Path, name: str) -> None:
    before = hash_tree(place / "results")

    assert slip("model", "add", "husky.toml", "effective_track", "--on", name, "--quiet") == 0
    assert slip("model", "fit", "husky.toml", "--on", name, "--predict", name, "--quiet") == 0
    assert slip("model", "compare", "husky.toml", "husky.toml", "--on", name, "--quiet") == 0
    assert hash_tree(place / "results") == before


@pytest.mark.parametrize("vehicle", [None, {}, {"track_width_m": "x"}, []])
def test_results_that_do_not_tell_a_vehicle_are_one_line(
    place: Path, capsys: pytest.CaptureFixture[str], vehicle: object
) -> None:
    path = place / "results" / "runs" / "field" / "wide" / "manifest.json"
    content = decode_checked(path.read_bytes())
    details = content["details"]
    assert isinstance(details, dict)
    told = {**details["vehicle"], **vehicle} if isinstance(vehicle, dict) and vehicle else vehicle
    path.write_bytes(encode_checked({**content, "details": {**details, "vehicle": told}}))
    assert slip("diagnose", "field/wide", "--results", place / "results") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "do not say which vehicle" in line


@pytest.mark.parametrize("text", ["[vehicel]\n", "[vehicle\n", '[vehicle]\npreset = "jackal_j100"\n'])
def test_a_wrong_configuration_is_told_where_results_exist(
    place: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    """The answer of before was given without a word."""
    log, configuration = place / "field" / "wide.mcap", place / "field" / "run.toml"
    configuration.write_text(text)
    assert slip("diagnose", log, "--results", place / "results") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert str(configuration) in line


@pytest.mark.parametrize("to", ["mcap", "csv", "parquet"])
def test_a_damaged_table_is_not_exported(place: Path, capsys: pytest.CaptureFixture[str], to: str) -> None:
    path = Store(place / "results").manifests()[0].path("slip")
    path.write_bytes(path.read_bytes()[:-40])
    words = ["export", "field/wide", "--to", to, "--file", place / "x", "--results", place / "results"]
    assert slip(*words) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "slip.parquet" in line
    assert not (place / "x").exists()


def test_a_copied_log_is_the_stored_run(place: Path) -> None:
    before = hash_tree(place / "results")
    (place / "elsewhere").mkdir()
    log = shutil.copyfile(place / "field" / "wide.mcap", place / "elsewhere" / "other.mcap")

    where = ("--on", log, "--results", place / "results", "--quiet")
    assert slip("model", "add", place / "husky.toml", "effective_track", *where) == 0
    assert hash_tree(place / "results") == before


def test_a_log_that_is_not_stored_is_storeds_own_vehicle_and_only_once(
    tmp_path: Path, stored_run: Path
) -> None:
    log, model = stored_run / "field" / "wide.mcap", tmp_path / "mine.toml"
    shutil.copyfile(stored_run / "husky.toml", model)
    assert slip("model", "fit", model, "--on", log, "--results", tmp_path / "fitted", "--quiet") == 0
    first = hash_tree(tmp_path / "fitted")
    assert slip("model", "fit", model, "--on", log, "--results", tmp_path / "fitted", "--quiet") == 0
    assert hash_tree(tmp_path / "fitted") == first

    assert slip("analyze", log, "--no-report", "--results", tmp_path / "analyzed", "--quiet") == 0
    assert hash_tree(tmp_path / "analyzed" / "runs") == hash_tree(tmp_path / "fitted" / "runs")


def test_the_vehicle_that_is_chosen_is_the_one_that_counts(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hash_tree(place / "results")
    tracks = {}
    for whose in ("model", "run"):
        model = place / f"{whose}.toml"
        assert slip("model", "new", model, "--vehicle", "jackal", "--quiet") == 0
        where = (
            "--on",
            "field/wide",
            "--results",
            place / "results",
            "--vehicle-of",
            whose,
            "--input",
            "command",
        )
        capsys.readouterr()
        assert slip("model", "add", model, "effective_track", *where, "--json") == 0
        found = json.loads(capsys.readouterr().out)
        tracks[whose] = found["parameters"]["effective_track.k"]["value"]
        assert slip("model", "show", model) == 0
        assert ("Jackal" if whose == "model" else "Husky") in capsys.readouterr().out
    # The log is a Husky's with a track 1.7 times its own.
    assert tracks["run"] == pytest.approx(1.7, rel=0.05)
    assert tracks["model"] != pytest.approx(1.7, rel=0.1)
    assert hash_tree(place / "results") == before


def test_a_diagnosis_with_other_choices_leaves_the_stored_run(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hash_tree(place / "results")
    log, out = place / "field" / "wide.mcap", place / "results"

    assert slip("diagnose", log, "--results", out, "--input", "measured", "--quiet") == 0
    assert slip("diagnose", "field/wide", "--results", out, "--quiet") == 0
    capsys.readouterr()
    assert slip("diagnose", log, "--results", out, "--vehicle", "panther", "--json") == 0
    panther = json.loads(capsys.readouterr().out)["runs"][0]
    assert slip("diagnose", log, "--results", out, "--json") == 0
    husky = json.loads(capsys.readouterr().out)["runs"][0]
    # Answered with the vehicle that was asked for: wheels of another radius give another ideal motion.
    assert panther["ladder"][0]["t_mrmse_m"] > husky["ladder"][0]["t_mrmse_m"]
    assert hash_tree(out) == before


def test_what_a_diagnosis_stores_does_not_depend_on_its_input(tmp_path: Path, stored_run: Path) -> None:
    log = stored_run / "field" / "wide.mcap"
    for name in ("command", "measured"):
        assert slip("diagnose", log, "--results", tmp_path / name, "--input", name, "--quiet") == 0
    assert hash_tree(tmp_path / "command" / "runs") == hash_tree(tmp_path / "measured" / "runs")


def test_a_changed_configuration_is_said_and_the_stored_run_is_read(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hash_tree(place / "results")
    log = place / "field" / "wide.mcap"
    log.with_name("run.toml").write_text("[velocity]\nwindow_s = 1.0\n", encoding="utf-8")

    assert slip("model", "fit", place / "husky.toml", "--on", log, "--results", place / "results") == 0
    assert f"slip analyze {log}" in capsys.readouterr().err
    assert hash_tree(place / "results") == before


def test_no_verb_that_reads_writes_into_a_stored_run(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = hash_tree(place / "results" / "runs")
    for verb in (
        ("compare", "results"),
        ("compare", "results", "--by", "run", "--as-published"),
        ("fleet", "trend", "results"),
        ("fleet", "map", "results"),
        ("results", "status", "field/wide"),
        ("results", "status"),
        ("results", "verify", "results"),
        ("results", "query", "select count(*) from slip"),
        ("diagnose", "field/wide", "--apply", "proposed.toml"),
        ("export", "field/wide", "--to", "csv"),
        ("export", "field/wide", "--to", "mcap", "--model", "husky.toml"),
        ("export", "field/wide", "--to", "foxglove-layout"),
        ("export", "field/wide", "--to", "plotjuggler-layout"),
    ):
        assert slip(*verb) == 0, (verb, capsys.readouterr().err)
        assert hash_tree(place / "results" / "runs") == before, verb
    assert Store(place / "results").examine().problems == ()


@pytest.mark.parametrize("before", few(["analyzed with it", "without"], 2))
def test_a_diagnosis_is_searched_once_and_anew_where_what_is_kept_is_of_other_tables(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    before: str,
) -> None:
    log, out = place / "field" / "wide.mcap", place / "results"
    is_stored = before != "without"
    if not is_stored:
        shutil.rmtree(out)
        analyze_log(log, Options(out=out, report=False))
    (run,) = [manifest.run for manifest in Store(out).manifests()]
    searches: list[int] = []

    def count(*arguments: object, **options: object) -> Diagnosis:
        searches.append(1)
        return diagnose_runs(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr("pipeline.api.diagnoses.diagnose_runs", count)
    runs = hash_tree(out / "runs")
    screens, models, told = [], [], []
    for number in range(3):
        model = place / f"model_{number}.toml"
        assert slip("diagnose", run, "--results", out, "--apply", model) == 0
        screens.append(capsys.readouterr().out.replace(model.name, "model.toml"))
        models.append(model.read_bytes())
        assert slip("diagnose", run, "--results", out, "--json") == 0
        told.append(json.loads(capsys.readouterr().out))
        if not is_stored and not number:
            # The first diagnosis has filled the columns of the model.
            assert hash_tree(out / "runs") != runs
            runs = hash_tree(out / "runs")
    assert len(searches) == (0 if is_stored else 1)
    assert hash_tree(out / "runs") == runs
    assert screens[0] == screens[1] == screens[2]
    assert models[0] == models[1] == models[2]
    assert told[0] == told[1] == told[2]

    # Another question is searched, and does not take the place of the answer.
    assert slip("diagnose", run, "--results", out, "--input", "measured", "--budget", "60s", "--quiet") == 0
    assert slip("diagnose", log, "--results", out, "--vehicle", "panther", "--quiet") == 0
    searched = len(searches)
    assert searched == (2 if is_stored else 3)
    # What is kept of other tables, or of another version, is no answer.
    kept = list((out / "workbench").rglob("*.json"))
    assert len(kept) == (0 if is_stored else 1)
    for path in kept:
        path.write_text(json.dumps({**json.loads(path.read_text()), "key": "older"}))
        assert slip("diagnose", run, "--results", out, "--quiet") == 0
        assert len(searches) == searched + 1
        path.write_text("{")
        assert slip("diagnose", run, "--results", out, "--quiet") == 0
        assert len(searches) == searched + 2


def test_an_error_that_rises_is_said_and_not_taken_unless_asked_for(place: Path) -> None:
    """Effects that the vehicle lacks cost something on data that they were not fitted to."""
    ask_verb("model", "add", "husky.toml", "effective_track", "drive_lag", "--on", "field/wide")
    useless = ("slope_creep", "lateral_skid", "heading_skew", "turn_lag")
    before = (place / "husky.toml").read_bytes()
    refused = run_verb("model", "add", "husky.toml", *useless, "--on", "field/wide", "--quiet")
    assert (refused.returncode, "are not supported by the data (" in refused.stderr) == (1, True)
    assert (place / "husky.toml").read_bytes() == before
    found = ask_verb("model", "add", "husky.toml", *useless, "--on", "field/wide", "--anyway")
    step = found["step"]
    assert step["rises"] == [key for key in ERRORS if step[key][1] > 1.001 * step[key][0]]
    assert step["rises"]
    assert set(useless) < set(found["ladder"][-1]["effects"]), "the ladder ends at the model itself"
    for below, rung in itertools.pairwise(found["ladder"]):
        assert rung.get("rises", []) == [key for key in ERRORS if rung[key] > 1.001 * below[key]]
    told = print_verb("model", "drop", "husky.toml", "drive_lag", "turn_lag", "--on", "field/wide")
    assert "  ! position error rises by " in told
    assert ": changed as requested" in told


def test_what_remains_of_a_model_is_fitted_as_if_the_dropped_had_never_been(place: Path) -> None:
    """A lag leaves nothing to an overshoot beside it, whose damping then is where no derivative pulls."""
    on = ("--on", "field/wide")
    (place / "alone.toml").write_bytes((place / "husky.toml").read_bytes())
    ask_verb("model", "add", "husky.toml", "effective_track", "drive_lag", *on)
    ask_verb("model", "add", "husky.toml", "drive_overshoot", *on, "--anyway")
    dropped = ask_verb("model", "drop", "husky.toml", "drive_lag", *on)
    alone = ask_verb("model", "add", "alone.toml", "effective_track", "drive_overshoot", *on, "--anyway")
    for key in ERRORS:
        assert dropped["ladder"][-1][key] == pytest.approx(alone["ladder"][-1][key], rel=1e-3)


def test_what_is_left_out_of_a_log_stands_below_what_it_belongs_to(samples: Path) -> None:
    usual = print_verb("inspect", samples / "mystery_3.mcap").splitlines()
    (pose,) = (index for index, line in enumerate(usual) if line.startswith("pose "))
    assert usual[pose + 1].strip() == "1 other pose (--all)"
    whole = print_verb("inspect", samples / "mystery_3.mcap", "--all").splitlines()
    assert "interval  none: the whole log counts" in whole
    assert not any("(--all)" in line for line in whole)
