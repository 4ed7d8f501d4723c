"""What a diagnosis finds in logs is what `slip fleet trend` follows over their dates."""

import json
import math
from pathlib import Path

import polars as pl
import pytest
from verbs import ask_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.trend import follow_trend
from pipeline.simulate import simulate_case
from pipeline.store import Store

QUANTITY = "effective_track.k"


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


def test_a_track_that_changed_raises_the_alert(three: Path) -> None:
    words = ("fleet", "trend", three, "--by", "vehicle", "--limit")
    ask_verb(*words, "effective_track.k=2.0")
    found = ask_verb(*words, "effective_track.k=1.7", code=4)

    (alert,) = found["alerts"]
    assert alert["quantity"] == QUANTITY
    assert "yard/2026-05-03, above the limit of 1.7" in alert["text"]
    (number,) = [
        one for one in found["parameters"] if (one["effect"], one["parameter"]) == ("effective_track", "k")
    ]
    assert [point["day"] for point in number["points"]] == ["2026-05-01", "2026-05-02", "2026-05-03"]
    assert number["need"] == "1 more run on a terrain driven before"
    for point, track in zip(number["points"], [1.4, 1.5, 1.9], strict=True):
        assert math.isclose(point["value"], track, rel_tol=0.03)


def test_results_of_a_diagnosis_without_the_table_are_made_again(tmp_path: Path) -> None:
    """As an older version left them: the key of its diagnosis was another one."""
    results = drive(tmp_path, [1.6])
    store, (manifest,) = Store(results), Store(results).manifests()
    with store.open_generation(manifest.run, "older") as generation:
        for table in manifest.tables:
            if table != "parameters":
                generation.reuse_table(table)
        for file in manifest.files:
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


@pytest.mark.long
def test_a_track_that_changed_on_two_grounds_is_one_alert_in_analyzed_logs(tmp_path: Path) -> None:
    before = [1.5, 1.85, 1.52, 1.83, 1.49, 1.86]
    tracks = [*before, *(track + 0.3 for track in before[:4])]
    # Of shorter drives the diagnosis says itself that they tell little.
    results = drive(tmp_path, tracks, duration_s=90.0, grounds=("tile", "gravel"))
    found = follow_trend(Store(results), ("dataset",), threshold=0.1, limits={})

    (alert,) = found.alerts
    assert alert.text.startswith(f"{QUANTITY} of husky_a200 1.6")
    assert "since 2026-05-07 (" in alert.text
    assert "likely a change of tyre pressure or load" in alert.text
    assert "other terrain" not in alert.text
