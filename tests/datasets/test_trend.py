"""`slip fleet trend`: slip and parameters over dates, and the step of each."""

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from comparison_store import Run, write_run
from verbs import ask_verb

from pipeline.datasets.trend import Series, find_steps, follow_trend
from pipeline.store import Store
from pipeline.store.names import read_day

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
        "median_window_norm (measured)",
    }
    assert "1.8 -&gt; 2.1 since 2026-05-03" in Path(content["page"]).read_text(encoding="utf-8")


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
    assert "too few for a test" in few.describe()
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


@pytest.mark.parametrize(
    ("name", "day"),
    [
        ("warthog_2024_8_7_11h30s30", "2024-08-07"),
        ("2026-05-03_gravel", "2026-05-03"),
        ("run_2024_13_40", None),
        ("run_2024_2_31", None),
        ("run_7", None),
    ],
)
def test_dates_in_names_are_read(name: str, day: str | None) -> None:
    assert read_day(name) == day
