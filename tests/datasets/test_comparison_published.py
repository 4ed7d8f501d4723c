"""The published chain: exact on motions whose answer is known, near the paper on the real recordings."""

import math
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.compare import compare_results
from pipeline.datasets.compared_runs import Question
from pipeline.datasets.published_chain import Limits, follow_published
from pipeline.store import Store

RATE = 20.0
LIMITS = Limits(1.0, 1.0, 0.55)
LOGS = {
    "husky_wheels-deflated_tile_2023_12_12_16h16": (1.6, 1.95),
    "husky_snow_boreal": (2.6, 3.2),
    "warthog_gravel_1": (9.0, 10.6),
}


def make_run(
    *, speed: float, asked: float, tau: float, steps: int = 6, scale: float = 1.0
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """A straight drive: wheels follow the command with a lag, the body moves at ``speed``."""
    count = round(6.0 * RATE) * steps
    t = np.arange(count) / RATE
    step = (t / 6.0).astype(np.int32)
    sign = np.where(step % 2 == 0, 1.0, 0.5)
    command = asked * sign
    wheels = np.empty(count)
    wheels[0] = 0.0
    for i in range(1, count):
        wheels[i] = command[i - 1] + (wheels[i - 1] - command[i - 1]) * math.exp(-1.0 / RATE / tau)
    stamp = (t * 1e9).astype(np.int64)
    parts = [
        pl.DataFrame({"f_x": f, "f_w": np.zeros(count)}).with_columns(
            pl.Series("t", t),
            pl.Series("stamp", stamp),
            pl.Series("segment", np.zeros(count, dtype=np.int32)),
            pl.Series("step", step),
            pl.Series("transitory", (t % 6.0) < 2.0),
            pl.lit(name).alias("input"),
        )
        for name, f in (("command", command / scale), ("measured", wheels))
    ]
    still = np.zeros(count)
    poses = pl.DataFrame(
        {"t": t, "x": speed * t, "y": still, "q_x": still, "q_y": still, "q_z": still, "q_w": still + 1.0}
    )
    return pl.concat(parts), poses


def test_the_lag_of_the_wheels_is_found_and_windows_are_whole() -> None:
    slip, poses = make_run(speed=0.5, asked=0.8, tau=0.7)
    found = follow_published(slip, poses, limits=LIMITS, command_is_scaled=False)
    assert found is not None
    assert found.tau_s == pytest.approx(0.7, abs=0.03)
    assert found.norms.height == 18
    assert found.scale == (1.0, 1.0)


def test_a_steady_slip_has_the_norm_of_forty_samples() -> None:
    slip, poses = make_run(speed=0.5, asked=0.8, tau=0.1, steps=1)
    found = follow_published(slip, poses, limits=LIMITS, command_is_scaled=False)
    assert found is not None
    assert found.norms["window_norm"][-1] == pytest.approx(math.sqrt(40.0) * 0.3, rel=1e-3)


def test_the_body_command_is_clipped_before_the_wheels() -> None:
    slip, poses = make_run(speed=1.0, asked=3.0, tau=0.1, steps=1)
    found = follow_published(slip, poses, limits=LIMITS, command_is_scaled=False)
    assert found is not None
    assert found.norms["window_norm"][-1] == pytest.approx(0.0, abs=1e-3)


def test_a_command_known_to_be_mis_scaled_is_put_right() -> None:
    slip, poses = make_run(speed=0.5, asked=0.5, tau=0.1, scale=1.8)
    found = follow_published(slip, poses, limits=LIMITS, command_is_scaled=True)
    assert found is not None
    assert found.scale[0] == pytest.approx(1.8, rel=0.01)


def test_without_measured_wheels_or_at_another_rate_there_is_no_published_number() -> None:
    slip, poses = make_run(speed=0.5, asked=0.5, tau=0.5)
    only = slip.filter(pl.col("input") == "command")
    assert follow_published(only, poses, limits=LIMITS, command_is_scaled=False) is None
    slow = slip.with_columns(pl.col("t") * 2.0)
    assert follow_published(slow, poses, limits=LIMITS, command_is_scaled=False) is None


@pytest.fixture(scope="module")
def recorded(shared_logs: Path, recorded_results: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Results of these recordings alone: more of them would be a larger family of tests."""
    store = Store(tmp_path_factory.mktemp("recorded"))
    for name in (
        *LOGS,
        "warthog_wheels_ice_2024_7_30_16h30s21",
        "warthog_wheels_asphalt",
        "warthog_wheels_gravel_2024_8_6_11h37s32",
    ):
        options = Options(out=recorded_results, report=False)
        run = analyze_log(shared_logs / f"{name}.mcap", options).manifest.folder.parent
        shutil.copytree(run, store.root / run.relative_to(recorded_results), symlinks=True)
    return store


@pytest.mark.long
def test_published_medians_come_out(recorded: Store) -> None:
    answer = compare_results(recorded, Question(by=("run",), as_published=True))
    medians = {
        row["dataset"].rsplit("/", 1)[-1]: row["published_norm"]
        for row in answer.datasets.filter(pl.col("input") == "command").iter_rows(named=True)
    }
    for name, (low, high) in LOGS.items():
        assert low <= medians[name] <= high, name
    tile, snow, gravel = (medians[name] for name in LOGS)
    assert tile < snow < gravel


@pytest.mark.long
def test_real_runs_are_told_apart_only_where_they_differ(recorded: Store) -> None:
    answer = compare_results(recorded, Question(by=("run",)))
    pairs = {
        (row["a"].rsplit("/", 1)[-1], row["b"].rsplit("/", 1)[-1]): row
        for row in answer.take(answer.comparisons, answer.views[0]).iter_rows(named=True)
    }
    same = pairs["warthog_wheels_asphalt", "warthog_wheels_gravel_2024_8_6_11h37s32"]
    assert same["p"] > 0.05
    assert same["p_uncorrected"] < 0.01
    names = {name.rsplit("/", 1)[-1]: name for name in answer.datasets["dataset"]}
    apart = ("husky_wheels-deflated_tile_2023_12_12_16h16", "warthog_wheels_ice_2024_7_30_16h30s21")
    assert apart not in pairs
    named = compare_results(recorded, Question(by=("run",), datasets=tuple(names[name] for name in apart)))
    (other,) = named.take(named.comparisons, named.views[0]).iter_rows(named=True)
    assert other["p_adjusted"] < 0.01
    assert other["unit_of_analysis"] == "blocks"
    assert "a difference between two runs" in other["note"]
