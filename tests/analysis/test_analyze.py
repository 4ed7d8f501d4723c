"""One log through all stages: what is computed, what is reused, what is left behind."""

import json
import shutil
from pathlib import Path

import polars as pl
import pytest
from stored import hash_tree

from pipeline.analysis import Options
from pipeline.analysis.analyze import Outcome, analyze_log, update_datasets
from pipeline.core import SlipError
from pipeline.recording import StageError
from pipeline.simulate import simulate_case
from pipeline.store import Store

STAGES = ("extract", "velocity", "slip", "aggregate")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_case("husky_tile", out=tmp_path_factory.mktemp("field") / "run one.mcap", duration_s=30.0)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "results"


def analyze(log: Path, out: Path, **options: object) -> Outcome:
    return analyze_log(log, Options(out=out, **{"report": False, **options}))


def test_a_log_becomes_tables_a_summary_and_a_report(log: Path, out: Path) -> None:
    outcome = analyze(log, out, report=True)

    assert outcome.computed == STAGES
    assert set(outcome.manifest.tables) == {
        "commands", "wheels", "poses", "imu", "alignments", "events",
        "velocities", "slip", "windows", "aggregates", "findings",
    }  # fmt: skip
    assert json.loads(outcome.manifest.path("summary.json").read_text())["run"] == outcome.manifest.run
    assert "<html" in outcome.manifest.path("report.html").read_text()[:200]
    assert outcome.summary["report"] == str(outcome.manifest.path("report.html"))


def test_an_unchanged_log_is_not_computed_again(log: Path, out: Path) -> None:
    first = analyze(log, out)
    second = analyze(log, out)

    assert second.computed == ()
    assert second.summary == first.summary
    assert second.manifest.folder == first.manifest.folder


def test_a_report_asked_for_later_reuses_every_table(log: Path, out: Path) -> None:
    analyze(log, out)
    later = analyze(log, out, report=True)

    assert later.computed == ()
    assert "report.html" in later.manifest.files
    assert analyze(log, out).manifest.folder == later.manifest.folder, "a report once made is not given up"


def test_a_report_of_another_version_is_drawn_again_from_the_same_tables(
    log: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = analyze(log, out, report=True)
    monkeypatch.setattr("pipeline.analysis.analyze.read_version", lambda: "99.0")
    monkeypatch.setattr("pipeline.analysis.summary.read_version", lambda: "99.0")
    second = analyze(log, out, report=True)

    assert second.computed == ()
    assert second.manifest.folder != first.manifest.folder
    assert second.summary["provenance"]["version"] == "99.0"
    assert analyze(log, out, report=True).manifest.folder == second.manifest.folder


@pytest.mark.parametrize(
    ("change", "computed"),
    [
        ({"slip": {"length_scale_m": 0.5}}, ("slip", "aggregate")),
        ({"velocity": {"window_s": 0.5}}, ("velocity", "slip", "aggregate")),
        ({"vehicle": {"track_width_m": 0.6}}, STAGES),
        ({"run": {"terrain": "parquet"}}, STAGES),
        ({"truth": {"distance_m": 2.0, "turns": 10.0}}, STAGES),
    ],
)
def test_a_change_redoes_exactly_what_depends_on_it(
    log: Path, out: Path, change: dict[str, object], computed: tuple[str, ...]
) -> None:
    analyze(log, out)

    assert analyze(log, out, overrides=change).computed == computed


def test_two_folders_hold_the_same_bytes(log: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        analyze(log, tmp_path / name, report=True)
        update_datasets(Store(tmp_path / name))

    first, second = (hash_tree(tmp_path / name) for name in ("a", "b"))
    kept = {name for name in first if not name.startswith("identities")}
    assert {name: first[name] for name in kept} == {name: second[name] for name in kept}
    assert any(name.endswith("report.html") for name in kept)


def test_a_stage_alone_writes_its_tables_and_no_later_ones(log: Path, out: Path) -> None:
    extracted = analyze(log, out, through="extract")
    assert set(extracted.manifest.tables) == {"alignments", "commands", "wheels", "poses", "imu", "findings"}

    velocity = analyze(log, out, through="velocity")
    assert velocity.computed == ("velocity",)
    assert "velocities" in velocity.manifest.tables


def test_force_computes_again_and_gives_the_same(log: Path, out: Path) -> None:
    first = analyze(log, out)
    second = analyze(log, out, force=True)

    assert second.computed == STAGES
    for table in first.manifest.tables:
        file = f"{table}.parquet"
        assert second.manifest.files[file].sha256 == first.manifest.files[file].sha256, table


def test_equal_content_is_one_run(log: Path, out: Path, tmp_path: Path) -> None:
    first = analyze(log, out)
    copy = tmp_path / "elsewhere" / "copy.mcap"
    copy.parent.mkdir()
    shutil.copy(log, copy)

    assert analyze(copy, out).manifest.run == first.manifest.run
    assert len(Store(out).runs()) == 1


def test_a_log_that_grew_is_the_same_run_with_new_results(out: Path, tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "log.mcap", duration_s=20.0)
    first = analyze(log, out)
    simulate_case("husky_tile", out=log, duration_s=30.0)
    second = analyze(log, out)

    assert second.manifest.run == first.manifest.run
    assert second.computed == STAGES


def test_a_failing_stage_leaves_nothing(out: Path, tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "log.mcap", duration_s=20.0)
    config = tmp_path / "run.toml"
    config.write_text("[[interval]]\nstart_s = 900\nend_s = 1000\n")

    with pytest.raises(StageError, match="no pose falls into the intervals"):
        analyze(log, out, config=config)
    assert Store(out).runs() == ()
    assert list(out.rglob("*.parquet")) == []


def test_datasets_name_the_runs_they_hold(out: Path, tmp_path: Path) -> None:
    runs = []
    for seed in (1, 2):
        log = simulate_case("husky_tile", out=tmp_path / f"{seed}.mcap", seed=seed, duration_s=30.0)
        runs.append(analyze(log, out))
    update_datasets(Store(out))

    table = pl.read_parquet(out / "datasets.parquet").filter(pl.col("input") == "command")
    assert table["runs"].to_list() == [2]
    assert table["dataset"].to_list() == ["husky_a200_tile"]
    for outcome in runs:
        assert outcome.manifest.run in table["keys"][0]


def test_the_log_is_opened_read_only(log: Path, out: Path) -> None:
    before = (log.read_bytes(), log.stat().st_mtime_ns)
    log.chmod(0o444)
    analyze(log, out)

    assert (log.read_bytes(), log.stat().st_mtime_ns) == before


def write_wide_track(path: Path, track: float) -> Path:
    path.write_text(
        'format = 1\n[vehicle]\npreset = "husky_a200"\n\n[[effect]]\nid = "effective_track"\n'
        f'k = {{ value = {track}, unit = "1" }}\n'
    )
    return path


def test_slip_can_be_told_relative_to_a_model(out: Path, tmp_path: Path) -> None:
    log = simulate_case(
        "ideal_husky", {"effective_track": {"k": 1.8}}, out=tmp_path / "w.mcap", duration_s=60.0
    )
    right = analyze(log, out, model=write_wide_track(tmp_path / "right.toml", 1.8))
    table = right.manifest.read("slip")
    by_input = right.summary["by_input"]

    for name in ("command", "measured"):
        assert by_input[name]["median_residual_modulus"] < 0.5 * by_input[name]["median_modulus"]
    turning = table.filter(pl.col("f_w").abs() > 0.5).filter(~pl.col("transitory"))
    assert (turning["model_w"] / turning["f_w"]).median() == pytest.approx(1 / 1.8, rel=0.02)

    assert analyze(log, out, model=tmp_path / "right.toml").computed == ()
    wrong = analyze(log, out, model=write_wide_track(tmp_path / "wrong.toml", 0.7))
    assert wrong.computed == ("slip", "aggregate")
    assert wrong.summary["by_input"]["command"]["median_modulus"] == by_input["command"]["median_modulus"]
    assert (
        wrong.summary["by_input"]["command"]["median_residual_modulus"]
        > by_input["command"]["median_modulus"]
    )
    without = analyze(log, out)
    assert without.summary["by_input"]["command"]["median_residual_modulus"] is None
    assert without.manifest.read("slip")["model_x"].null_count() == table.height


def test_a_summary_that_was_damaged_is_one_clear_error_and_made_anew_with_force(log: Path, out: Path) -> None:
    path = analyze(log, out).manifest.path("summary.json")
    whole = path.read_bytes()
    assert b'"reason"' in whole
    misspelt = whole.replace(b'"reason"', b'"reas0n"')
    for damaged in (whole[:-9], b"[]", b"[" * 5000, b"\xff" + whole[1:], misspelt):
        path.write_bytes(damaged)
        with pytest.raises(SlipError, match="has changed since it was written") as caught:
            analyze(log, out)
        assert caught.value.code == "file_damaged"
    assert analyze(log, out, force=True).summary["run"]
