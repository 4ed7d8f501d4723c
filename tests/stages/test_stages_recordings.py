"""The real recordings: numbers of an independent chain, and the faults they are known to have."""

from dataclasses import dataclass
from pathlib import Path

import polars as pl
import pytest
from few import few
from store_samples import read_current

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.store import Store
from schemas.run_tables import COUNTED

LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"

pytestmark = pytest.mark.skipif(not LOGS.is_dir(), reason="the real recordings are not in ../shared/logs")


COMMON = frozenset({"not_moving", "wheels_dead", "pose_from_wheels", "imu_sign", "command_scale"})


@dataclass(frozen=True)
class Known:
    """What the recordings' own description says.

    Attributes:
        held: share of held poses.
        measured, command: median slip modulus [m/s].
        norm: median 2 s window norm, measured wheels.
        faults: findings it must give.
        absent: findings it must not give.
    """

    held: float
    measured: float
    command: float
    norm: float
    faults: frozenset[str] = frozenset()
    absent: frozenset[str] = COMMON


HELD = frozenset({"held_poses"})
ROTATED = frozenset({"bad_stretch"})
LIVE = frozenset({"interval_applied"})
LATE = frozenset({"pose_delay"})
READ = frozenset({"held_wheels"})
ENCODERS = frozenset({"wheels_delay"}) | READ

KNOWN = {
    "husky_wheels-deflated_tile_2023_12_12_16h16": Known(
        0.49, 0.256, 0.283, 1.76, HELD | LATE | ENCODERS | {"command_beyond_limit"}, COMMON | ROTATED
    ),
    "husky_snow_boreal": Known(
        0.52, 0.751, 2.04, 4.98, HELD | ROTATED | READ | {"command_scale"}, COMMON - {"command_scale"}
    ),
    "husky_wheels_wetgrass": Known(0.0, 0.488, 0.617, 3.16, LIVE | READ),
    "husky_wheels_avide2": Known(0.0, 0.939, 0.946, 5.83, LIVE | {"not_moving"}, COMMON - {"not_moving"}),
    "warthog_gravel_1": Known(0.52, 1.09, 2.04, 7.15, HELD | ROTATED | LATE | READ),
    "warthog_wheels_asphalt": Known(0.80, 1.08, 1.65, 8.21, HELD | ROTATED | LATE | READ),
    "warthog_wheels_asphalt_2024_8_7_11h30s30": Known(0.75, 0.866, 1.51, 6.81, HELD | ROTATED | LATE | READ),
    "warthog_wheels_asphalt_2024_9_20_8h13s12": Known(0.0, 0.235, 1.06, 1.72, LIVE | LATE | ENCODERS),
    "warthog_wheels_grass_2024_7_29_14h46s15": Known(0.0, 0.066, 0.405, 0.72, LIVE | LATE | ENCODERS),
    "warthog_wheels_grass_2024_8_8_16h19s23": Known(0.0, 0.176, 0.498, 1.53, LIVE | LATE | ENCODERS),
    "warthog_wheels_gravel_2024_8_6_11h37s32": Known(
        0.79, 0.923, 1.41, 7.13, HELD | ROTATED | LATE | READ | {"imu_sign"}, COMMON - {"imu_sign"}
    ),
    "warthog_wheels_ice_2024_7_30_16h30s21": Known(
        0.72, 1.79, 2.18, 12.1, HELD | ROTATED | LATE | READ | {"imu_sign"}, COMMON - {"imu_sign"}
    ),
    "warthog_wheels_sand_2024_9_25_14h32s32": Known(0.75, 1.36, 2.12, 10.1, HELD | LATE | READ),
}


def summarize(name: str, results: Path) -> dict[str, object]:
    return dict(analyze_log(LOGS / f"{name}.mcap", Options(out=results, report=False)).summary)


@pytest.mark.parametrize("name", few(KNOWN, 7))
def test_a_recording_gives_its_known_numbers_and_its_known_faults(name: str, recorded_results: Path) -> None:
    known = KNOWN[name]
    summary = summarize(name, recorded_results)
    by_input = summary["by_input"]
    assert isinstance(by_input, dict)
    measured, command = by_input["measured"], by_input["command"]
    assert isinstance(measured, dict)
    assert isinstance(command, dict)
    # The independent chain puts nothing right. Other sensible smoothing moves these numbers by some 10 %.
    store, run = Store(recorded_results), str(summary["run"])
    medians = read_current(store, run, "aggregates").filter(pl.col("subset") == "all")
    recorded = dict(medians.select("input", "median_recorded_modulus").iter_rows())
    assert recorded["measured"] == pytest.approx(known.measured, rel=0.15)
    assert recorded["command"] == pytest.approx(known.command, rel=0.15)
    # Poses and wheels at the moments they belong to, without outliers, show less slip and never more.
    assert measured["median_modulus"] <= 1.02 * recorded["measured"]
    assert measured["median_window_norm"] <= 1.15 * known.norm
    if "command_scale" not in known.faults:
        assert command["median_modulus"] <= 1.02 * recorded["command"]
    compared = read_current(store, run, "slip").filter(pl.col("input") == "command")
    assert summary["duration_s"] == pytest.approx(0.05 * compared.filter(COUNTED).height, abs=0.06)
    assert (summary["distance_m"] is None) == ("not_moving" in known.faults)
    assert summary["held_poses"] == pytest.approx(known.held, abs=0.015)
    findings = summary["findings"]
    assert isinstance(findings, list)
    ids = {finding["id"] for finding in findings if isinstance(finding, dict)}
    assert known.faults - ids == set()
    assert known.absent & ids == set()


def test_a_husky_that_stands_on_a_plank_is_not_moving_and_its_encoders_say_zero(
    recorded_results: Path,
) -> None:
    summary = summarize("husky_wheels_plank_2024_10_24_11h24s5", recorded_results)
    findings = summary["findings"]
    assert isinstance(findings, list)
    ids = {finding["id"] for finding in findings if isinstance(finding, dict)}
    assert {"not_moving", "wheels_dead"} <= ids
    by_input = summary["by_input"]
    assert isinstance(by_input, dict)
    # Two commanded steps of equal length: the median falls between 1.56 and 2.7 and tells nothing more.
    measured = by_input["measured"]
    assert isinstance(measured, dict)
    assert measured["median_modulus"] < 0.01


@pytest.mark.long
def test_snow_commands_are_off_by_the_ratio_of_two_radii(recorded_results: Path) -> None:
    summary = analyze_log(
        LOGS / "husky_snow_boreal.mcap", Options(out=recorded_results, report=False)
    ).summary
    findings = summary["findings"]
    assert isinstance(findings, list)
    (found,) = [each for each in findings if isinstance(each, dict) and each["id"] == "command_scale"]
    # Made with the Warthog's wheels, the stored command is too small: the wheels turn faster than it says.
    assert found["value"] == pytest.approx(0.30 / 0.165, rel=1e-6)
    # In turns the wheels differ by half of what it says: its track, too, is the Warthog's.
    assert "their difference is 0.56 times the commanded one" in found["text"]
    assert "another vehicle (Clearpath Warthog: wheel radius 0.3 m, track 1.08 m)" in found["text"]


@pytest.mark.parametrize(
    "name", few(["husky_wheels_wetgrass", "warthog_wheels_asphalt_2024_9_20_8h13s12"], 2)
)
def test_driving_by_hand_outside_the_protocol_is_noticed(name: str, tmp_path: Path) -> None:
    options = Options(out=tmp_path, report=False, overrides={"use_intervals": "all"})
    findings = analyze_log(LOGS / f"{name}.mcap", options).summary["findings"]
    assert isinstance(findings, list)
    ids = {finding["id"] for finding in findings if isinstance(finding, dict)}
    assert ids & {"stale_command", "manual_driving"}
