"""What the diagnosis says of every real recording, against the recorded signals; no recording is excepted.

The numbers in the sentences are the model's. Against them stand ratios over steady driving and how long
measured wheels exceed a limit, read from the tables without any model. The last test compares places that
show the same errors.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import JSON_DIGITS, finite_or_none
from pipeline.datasets.check import check_runs
from pipeline.estimation.largest import average_sustained
from pipeline.estimation.stored_diagnosis import read_diagnosis
from pipeline.models.parameter import EXCEEDED_SHARE, OVERSHOOT
from pipeline.store import Store
from pipeline.words.objects import diagnosis_as_json

pytestmark = pytest.mark.long

RATIO = 0.2
WHEEL_LIMITS = ("wheel_speed_limit", "wheel_speed_scaling")
# A diagnosis that leaves more than so many noise floors says what it leaves.
ROOM = 1.5
# Below it, wheels of a skid-steered vehicle slide most of the time.
LOW_FRICTION = 0.2
# Standard gravity [m/s^2].
G = 9.80665


@dataclass(frozen=True)
class Analyzed:
    """A recording's diagnosis and the tables beside it."""

    name: str
    diagnosis: dict[str, Any]
    folder: Path
    report: str

    @property
    def numbers(self) -> dict[str, dict[str, float]]:
        return {
            effect["id"]: {name: one["value"] for name, one in effect["parameters"].items()}
            for effect in self.diagnosis["effects"]
        }

    @property
    def friction(self) -> float:
        """Friction coefficient that is named; infinite where none is."""
        return self.numbers.get("contact_friction", {"friction": math.inf})["friction"]

    def read(self, table: str) -> pl.DataFrame:
        return pl.read_parquet(self.folder / f"{table}.parquet")

    def read_motion(self) -> pl.DataFrame:
        """Ideal (f) and measured (v) motion of measured wheels, where nothing is suspect."""
        motion = self.read("slip").filter((pl.col("input") == "measured") & ~pl.col("suspect"))
        return motion.with_columns(steady=~pl.col("transitory"))


@pytest.fixture(scope="module")
def analyzed(shared_logs: Path, diagnosed_results: Path) -> list[Analyzed]:
    found = []
    for log in sorted(shared_logs.glob("*.mcap")):
        outcome = analyze_log(log, Options(out=diagnosed_results, diagnosis=True))
        manifest = outcome.manifest
        stored = read_diagnosis(manifest)
        diagnosis = {"effects": []} if stored is None else diagnosis_as_json(stored)
        assert diagnosis["effects"] or outcome.refusal or not outcome.summary["median_modulus"], log.stem
        report = (manifest.folder / "report.html").read_text("utf-8")
        found.append(Analyzed(log.stem, diagnosis, manifest.folder, report))
    return [one for one in found if one.diagnosis["effects"]]


def test_the_share_of_the_ideal_turn_is_that_of_steady_turning(analyzed: list[Analyzed]) -> None:
    compared = 0
    for one in analyzed:
        numbers = one.numbers
        track = next((name for name in ("effective_track", "contact_friction") if name in numbers), None)
        if track is None or one.friction < LOW_FRICTION:
            continue
        said = numbers.get("wheel_radius", {"k": 1.0})["k"] / numbers[track]["k"]
        turning = pl.col("f_w").abs()
        # The track beside contact friction is that of wheels that slide little.
        is_slow = turning < 1.0 if track == "contact_friction" else pl.lit(value=True)
        rows = one.read_motion().filter(pl.col("steady") & (turning > 0.3) & is_slow)
        ideal, measured = rows["f_w"].to_numpy(), rows["v_w"].to_numpy()
        assert said == pytest.approx(float(measured @ ideal) / float(ideal @ ideal), rel=RATIO), one.name
        compared += 1
    assert compared > 5


def test_the_share_of_the_ideal_way_is_that_of_straight_driving(analyzed: list[Analyzed]) -> None:
    for one in analyzed:
        numbers = one.numbers
        # On ice most of the way that is lost is that of wheels that slide: contact friction says so.
        if "wheel_radius" not in numbers or one.friction < LOW_FRICTION:
            continue
        straight = (pl.col("f_x").abs() > 0.2) & (pl.col("f_w").abs() < 0.3 * pl.col("f_x").abs())
        rows = one.read_motion().filter(pl.col("steady") & straight)
        ideal, measured = rows["f_x"].to_numpy(), rows["v_x"].to_numpy()
        ratio = float(measured @ ideal) / float(ideal @ ideal)
        assert one.numbers["wheel_radius"]["k"] == pytest.approx(ratio, rel=1.5 * RATIO), one.name


def measure_accelerations(motion: pl.DataFrame) -> np.ndarray:
    """Accelerations of the body over g, from its mean velocities in half seconds, shape (n,)."""
    motion = motion.sort("t")
    stamps, velocity = motion["t"].to_numpy(), motion.select("v_x", "v_y", "v_w").to_numpy()
    step = float(np.median(np.diff(stamps)))
    half = round(0.5 / step)
    sums = np.cumsum(np.vstack([np.zeros(3), velocity]), axis=0)
    means = (sums[half:] - sums[:-half]) / half
    before, after = means[: stamps.size - 2 * half], means[half : stamps.size - half]
    turning = 0.5 * (before + after)
    change = (after - before) / (half * step)
    forward = change[:, 0] - turning[:, 1] * turning[:, 2]
    lateral = change[:, 1] + turning[:, 0] * turning[:, 2]
    unbroken = np.abs(stamps[2 * half :] - stamps[: -2 * half] - 2 * half * step) < 0.5 * step
    return np.hypot(forward, lateral)[unbroken] / G


def test_the_body_accelerates_as_the_friction_that_is_told_lets_it(analyzed: list[Analyzed]) -> None:
    bounded = 0
    for one in analyzed:
        if math.isinf(one.friction):
            continue
        usual, large = np.percentile(measure_accelerations(one.read_motion()), (90.0, 95.0))
        assert usual < 1.25 * one.friction, one.name
        if one.friction < LOW_FRICTION:
            # Wheels that slide most of the time push as hard as the ground lets them.
            assert large > 0.8 * one.friction, one.name
            bounded += 1
    assert bounded > 0


def test_measured_wheels_keep_the_limits_that_are_told(analyzed: list[Analyzed]) -> None:
    compared = 0
    for one in analyzed:
        numbers, motion = one.numbers, one.read_motion()
        wheels = one.read("wheels").filter(pl.col("active"))
        times, sides = (
            wheels["t"].to_numpy(),
            (wheels["left_aligned"].to_numpy(), wheels["right_aligned"].to_numpy()),
        )
        # Single readings of a Husky's encoders are 6 % off: what lasts half a second counts.
        fastest = np.max([np.abs(average_sustained(times, side)) for side in sides], axis=0)
        turning = {
            **dict.fromkeys(WHEEL_LIMITS, fastest),
            "body_turn_limit": np.abs(motion["f_w"].to_numpy()),
            "body_speed_limit": np.abs(motion["f_x"].to_numpy()),
        }
        for limit, signal in turning.items():
            if limit in numbers:
                most = float(np.quantile(signal, 1.0 - EXCEEDED_SHARE))
                # No limit is searched below this one, and what stands at it is written to so many digits.
                least = finite_or_none(most / OVERSHOOT, JSON_DIGITS)
                assert least <= numbers[limit]["limit"], (one.name, limit, most)
                assert limit not in WHEEL_LIMITS or numbers[limit]["limit"] <= OVERSHOOT * most, one.name
                compared += 1
    assert compared > 5


def test_a_large_remaining_error_is_told_with_its_channel_or_its_place(analyzed: list[Analyzed]) -> None:
    for one in analyzed:
        last, floor = one.diagnosis["ladder"][-1], one.diagnosis["noise_floor"]
        if last["t_mrmse_m"] > ROOM * (floor["t_mrmse_m"] or 0.0):
            told = one.diagnosis["unexplained"] or one.diagnosis["disturbance"]
            assert told, one.name
            assert "does not depend on any recorded signal" not in str(told), one.name


def test_the_report_and_the_tables_show_the_errors_of_the_diagnosis(analyzed: list[Analyzed]) -> None:
    for one in analyzed:
        last = one.diagnosis["ladder"][-1]
        rungs = (pl.col("input") == one.diagnosis["input"]) & (pl.col("kind") == "rung")
        ladder = one.read("ladder").filter(rungs)
        top = ladder.sort("rung").row(-1, named=True)
        assert (top["t_mrmse"], top["r_mrmse"]) == (last["t_mrmse_m"], last["r_mrmse_rad"]), one.name
        for sentence in (effect["sentence"] for effect in one.diagnosis["effects"]):
            words = re.split(r"[:(]", sentence)[0].strip()
            assert words in one.report, (one.name, words)


def test_ice_is_told_from_asphalt_by_its_friction(analyzed: list[Analyzed]) -> None:
    """A fit to the run on ice that starts from the friction of asphalt ends beside it."""
    root = next(folder.parent for folder in analyzed[0].folder.parents if folder.name == "runs")
    store = Store(root)
    runs = {manifest.run.rpartition("/")[2]: manifest for manifest in store.survey().manifests}
    dry = [runs["warthog_wheels_asphalt"], runs["warthog_wheels_asphalt_2024_8_7_11h30s30"]]
    found = check_runs(dry, [runs["warthog_wheels_ice_2024_7_30_16h30s21"]], store)
    numbers = {one.name: one for one in found.numbers}
    assert (
        numbers["contact_friction.friction"].after
        < LOW_FRICTION
        < numbers["contact_friction.friction"].before
    )
