"""What a diagnosis finds in logs is the table of parameters, and what `slip fleet trend` follows."""

import json
from pathlib import Path

import polars as pl
import pytest
from verbs import ask_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case
from pipeline.store import Store


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
