"""`slip fleet trend`: slip and parameters over dates, and the step of each."""

import json
from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from verbs import ask_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.trend import Series, Trend, find_steps, follow_trend
from pipeline.simulate import simulate_case
from pipeline.store import Store
from pipeline.words.fleet import format_trend

FIRST = date(2026, 4, 20)
WOBBLE = (0.01, -0.02, 0.015, -0.01, 0.02, -0.015, 0.0)


def stamp_of(day: date) -> int:
    return int(datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()) * 1_000_000_000


def drive_a_season(store: Store, tracks: Sequence[float]) -> None:
    for i, track in enumerate(tracks):
        # Names out of order: dates must come from the clock.
        run = Run(
            name=f"run_{(7 * i) % len(tracks):02d}", dataset="warthog-2_gravel", vehicle="warthog-2",
            seconds=30.0, start_ns=stamp_of(FIRST + timedelta(days=i)), estimates=[("effective_track", "k",
            track, 0.004)],
        )  # fmt: skip
        write_run(store, run)


def make_series(values: Sequence[float], terrains: Sequence[str]) -> Series:
    days = [f"2026-05-{i + 1:02d}" for i in range(len(values))]
    points = pl.DataFrame({"day": days, "run": days, "terrain": list(terrains), "value": list(values)})
    return Series("warthog", "effective_track.k", "1", points)


def test_a_track_that_moved_is_told_with_its_day(tmp_path: Path) -> None:
    tracks = [1.8 + WOBBLE[i % 7] for i in range(13)] + [2.1 + WOBBLE[i % 7] for i in range(6)]
    drive_a_season(Store(tmp_path), tracks)
    content = ask_verb("fleet", "trend", tmp_path)
    first = content["series"][0]
    assert (first["group"], first["quantity"]) == ("warthog-2", "effective_track.k")
    assert [point["value"] for point in first["points"]] == pytest.approx(tracks)
    assert first["step"]["since"] == "2026-05-03"
    assert first["step"]["is_significant"]
    assert (first["step"]["before"], first["step"]["after"]) == pytest.approx((1.8, 2.1), abs=0.01)
    assert {one["quantity"] for one in content["series"]} >= {
        "median_modulus (command)",
        "median_modulus (measured)",
    }
    page = Path(content["page"]).read_text(encoding="utf-8")
    assert "1.8 -&gt; 2.1 since 2026-05-03" in page
    # Page, screen and JSON have the same series.
    assert f"{len(content['series'])} series" in page
    assert all(one["step"]["is_significant"] for one in content["series"])
    assert "3 significant steps in the 3 of 3 series that could be tested" in page


def test_a_step_is_found_across_grounds_and_another_ground_is_none() -> None:
    rng = np.random.default_rng(1)
    terrains = rng.choice(["asphalt", "sand"], 16).tolist()
    levels = np.array([1.7 if terrain == "asphalt" else 2.4 for terrain in terrains])
    values = levels + 0.02 * rng.normal(size=16)
    (still,) = find_steps([make_series(values.tolist(), terrains)])
    (moved,) = find_steps([make_series((values + 0.15 * (np.arange(16) >= 9)).tolist(), terrains)])
    assert not still.is_changed
    assert moved.is_changed
    assert moved.step is not None
    assert moved.step.since == "2026-05-10"
    assert moved.step.after - moved.step.before == pytest.approx(0.15, abs=0.05)
    ground = ["asphalt"] * 8 + ["sand"] * 8
    (other,) = find_steps(
        [make_series([1.7 + w for w in WOBBLE[:4]] * 2 + [2.4 + w for w in WOBBLE[:4]] * 2, ground)]
    )
    assert not other.is_changed


def test_few_runs_are_not_tested_and_chance_makes_few_steps() -> None:
    (few,) = find_steps([make_series([1.0, 1.1, 2.0, 2.1, 2.0], ["ice"] * 5)])
    assert few.step is None
    assert "no test: 5 of the 6 runs on terrains driven twice that it takes" in few.describe()
    (alone,) = find_steps([make_series([1.0, 1.1, 2.0, 2.1, 2.0, 2.1, 2.2], [f"g{i}" for i in range(7)])])
    assert "7 runs" in alone.describe()
    assert "no test: 0 of the 6 runs on terrains driven twice" in alone.describe()
    trend = Trend((few, alone), (), ())
    assert trend.summary.startswith("Nothing can be tested: a series takes 6 dated runs")
    screen = format_trend(trend, everything=False)
    assert not any("latest" in line for line in screen)
    assert "2 series cannot be tested: --all, or the page" in screen
    assert sum("latest" in line for line in format_trend(trend, everything=True)) == len(trend.series)
    rng = np.random.default_rng(9)
    wrong = 0
    for _ in range(40):
        series = [make_series(rng.normal(size=12).tolist(), ["ice"] * 12) for _ in range(3)]
        wrong += any(one.is_changed for one in find_steps(series))
    # Of 40 with a chance of 5 %, more than 6 come in fewer than one of a hundred trials.
    assert wrong <= 6


@pytest.mark.parametrize(
    ("table", "what"),
    [("estimates", "gone"), ("findings", "gone"), ("slip", "gone"), ("estimates", "damaged")],
)
def test_a_run_whose_table_is_gone_or_damaged_is_left_out_and_named(
    tmp_path: Path, table: str, what: str
) -> None:
    store = Store(tmp_path)
    drive_a_season(store, [1.8, 1.81, 1.8, 1.81, 1.8])
    path = store.manifests()[0].path(table)
    path.unlink()
    if what == "damaged":
        path.write_bytes(b"no table")
    found = follow_trend(store, ("vehicle",))
    assert "run_00" not in " ".join(found.keys)
    (note,) = [note for note in found.notes if "run_00" in note]
    said = {
        "gone": f"the file {table}.parquet of the results is gone; slip results verify --repair",
        "damaged": f"the table {table} cannot be read: it has changed since it was written",
    }
    assert note.startswith(f"left out, {said[what]}")


def drive(
    folder: Path, tracks: list[float], *, duration_s: float = 40.0, grounds: tuple[str, ...] = ("tile",)
) -> Path:
    """Results of one log a day, each with its own effective track."""
    for number, track in enumerate(tracks):
        log = folder / "yard" / f"2026-05-{number + 1:02d}.mcap"
        effects = {"effective_track": {"k": track}}
        simulate_case("ideal_husky", effects, out=log, seed=number, duration_s=duration_s)
        ground = grounds[number % len(grounds)]
        analyze_log(
            log,
            Options(
                out=folder / "results", report=False, diagnosis=True, overrides={"run": {"terrain": ground}}
            ),
        )
    return folder / "results"


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("three"), [1.4, 1.5, 1.9])


def test_the_table_of_parameters_is_the_diagnosis(three: Path) -> None:
    for manifest in Store(three).manifests():
        told = json.loads(manifest.path("diagnosis.json").read_text(encoding="utf-8"))
        expected = [
            (told["input"], effect["id"], name, *(number[key] for key in ("value", "low", "high", "unit")))
            for effect in told["effects"]
            for name, number in effect["parameters"].items()
        ]
        table = manifest.read("parameters")
        columns = ["input", "effect", "parameter", "value", "low", "high", "unit"]
        assert table.select(pl.col(columns)).rows() == expected
        assert ("command", "effective_track", "k") in [row[:3] for row in expected]
        assert not table["at_bound"].any()


def test_the_trend_follows_what_the_diagnoses_found(three: Path) -> None:
    found = ask_verb("fleet", "trend", three, "--by", "vehicle")
    (number,) = [one for one in found["series"] if one["quantity"] == "effective_track.k"]
    assert [point["day"] for point in number["points"]] == ["2026-05-01", "2026-05-02", "2026-05-03"]
    assert [point["value"] for point in number["points"]] == pytest.approx([1.4, 1.5, 1.9], rel=0.03)


def test_results_of_a_diagnosis_without_the_table_are_made_again(tmp_path: Path) -> None:
    """As an older version left them: the key of its diagnosis was another one."""
    results = drive(tmp_path, [1.6])
    store, (manifest,) = Store(results), Store(results).manifests()
    with store.open_generation(manifest.run, "older") as generation:
        for table in manifest.tables:
            if table != "parameters":
                generation.reuse_table(table)
        for file in manifest.files:
            if not file.endswith(".parquet"):
                generation.reuse_file(file)
        details = json.loads(json.dumps(dict(manifest.details)))
        details["stages"]["diagnosis"]["key"] = "0123456789abcdef"
        generation.commit(details)

    again = analyze_log(
        tmp_path / "yard" / "2026-05-01.mcap",
        Options(out=results, report=False, diagnosis=True, overrides={"run": {"terrain": "tile"}}),
    )
    assert again.computed == ("diagnosis",)
    assert "parameters" in again.manifest.tables
