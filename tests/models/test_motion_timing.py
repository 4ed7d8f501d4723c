"""Poses stand at the moments they belong to, faults of a localization are left out, encoders may be late."""

from collections.abc import Mapping

import numpy as np
import polars as pl
import pytest
from few import few
from motion_runs import QUIET, align, make_scenario, tables_of, vehicle_of
from scipy.signal import lfilter

from pipeline.core import rigid
from pipeline.core.arrays import nearest_indices
from pipeline.estimation import EstimationData, Input, RunResiduals, fit_model
from pipeline.estimation.estimates import read_clock
from pipeline.estimation.prediction import predict_from
from pipeline.models import Model, find_effect
from pipeline.run import MotionRun, load_run
from pipeline.simulate import Imu, simulate_run
from pipeline.simulate.programs import lag_signal

HUSKY = vehicle_of("husky_a200")
SKID = {"effective_track": 1.8, "turn_lag": {"tau_mean": 0.1, "tau_diff": 0.4}, "icr_offset": 0.12}


@pytest.fixture(scope="module")
def tables() -> Mapping[str, pl.DataFrame]:
    return tables_of(simulate_run(make_scenario(SKID, duration_s=240.0, pose=QUIET, imu=Imu())), HUSKY)


def load(tables: Mapping[str, pl.DataFrame], **changed: pl.DataFrame) -> MotionRun:
    recorded = {name: tables[name] for name in ("poses", "commands", "wheels", "imu")}
    recorded["poses"] = recorded["poses"].drop("latency", "outlier")
    slip = {name: frame for name, frame in changed.items() if name == "slip"}
    return load_run({**align({**recorded, **changed}, HUSKY), **slip}, HUSKY, name="changed")


def draw_ages(count: int, spread: float) -> np.ndarray:
    """Ages that last for some poses, as of a localization that is now quick and now slow."""
    random = np.random.default_rng(5)
    ages = np.zeros(count)
    for index in range(1, count):
        ages[index] = 0.7 * ages[index - 1] + random.normal(0.0, spread * np.sqrt(1.0 - 0.49))
    return ages


def draw_slow_ages(count: int, spread: float, seed: int) -> np.ndarray:
    """Ages that change over seconds."""
    noise = np.random.default_rng(seed).normal(0.0, spread * np.sqrt(1.0 - 0.95**2), count)
    return lfilter((1.0,), (1.0, -0.95), noise)


def delay(times: np.ndarray, ages: np.ndarray) -> np.ndarray:
    """Stamps of poses that are reported so late, in order."""
    count = 0.01 * np.arange(times.size)
    return np.maximum.accumulate(times + ages - count) + count


def test_repeats_are_left_out_while_wheels_turn_and_kept_at_rest(tables: Mapping[str, pl.DataFrame]) -> None:
    poses, run = tables["poses"].sort("t"), load(tables)
    times, wheels = poses["t"].to_numpy(), run.wheels
    turning = np.interp(times, wheels.times, np.maximum(np.abs(wheels.left), np.abs(wheels.right)))
    # Twenty poses in a row, of which the last nineteen repeat the first: once in a turn, once at the start.
    turns = int(np.flatnonzero(np.convolve(turning > 1.0, np.ones(40), "valid") == 40.0)[3]) + 10
    spans = {"turn": np.arange(turns, turns + 20), "rest": np.arange(20)}
    rows = np.arange(times.size)
    for span in spans.values():
        rows[span] = span[0]
    still = poses.select("x", "y", "z", "q_x", "q_y", "q_z", "q_w")[rows]
    held = np.isin(np.arange(times.size), np.concatenate([span[1:] for span in spans.values()]))
    repeated = poses.with_columns(still.iter_columns()).with_columns(
        held=pl.Series(held | poses["held"].to_numpy())
    )
    known = load(tables, poses=repeated.drop("latency", "outlier")).track.times
    seen = {
        name: np.abs(known[nearest_indices(times[span[1:15]], known)] - times[span[1:15]]) < 0.02  # of 0.05
        for name, span in spans.items()
    }
    assert not seen["turn"].any()
    assert seen["rest"].all()
    assert np.isin(times[spans["turn"][-1] + 2 :].round(2), known.round(2)).mean() > 0.9


def test_good_stamps_and_good_poses_stay_as_they_are(tables: Mapping[str, pl.DataFrame]) -> None:
    run = load(tables)
    assert run.alignment.latency_spread_s == 0.0
    assert run.alignment.outlier_s == 0.0
    assert np.allclose(run.track.times, np.sort(tables["poses"]["t"].to_numpy()), atol=2e-3)


def test_the_gyro_tells_how_old_each_pose_is(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    true = poses["t"].to_numpy()
    stamps = delay(true, draw_ages(true.size, 0.06))
    run = load(tables, poses=poses.with_columns(pl.Series("t", stamps)))
    assert run.alignment.latency_spread_s == pytest.approx(0.06, rel=0.35)
    turning = np.abs(np.gradient(run.track.heading, true)) > 0.3
    before, after = (stamps - true)[turning], (run.track.times - true)[turning]
    assert np.std(after) < 0.4 * np.std(before)
    everywhere = run.track.times - true
    assert np.std(everywhere) < np.std(stamps - true)


@pytest.mark.parametrize("seed", few(range(8), 3))
def test_the_interval_of_a_clock_is_that_of_its_mean(tables: Mapping[str, pl.DataFrame], seed: int) -> None:
    poses = tables["poses"]
    true = poses["t"].to_numpy()
    stamps = delay(true, 0.3 + draw_slow_ages(true.size, 0.06, seed))
    run = load(tables, poses=poses.with_columns(pl.Series("t", stamps)))
    clock = find_effect("clock_offset").of_delay(run.alignment.heading_delay_s)
    number = read_clock(clock, run)["d"]
    assert number.low <= np.mean(stamps - true) <= number.high
    # Single poses vary by twice 0.06 s about it.
    assert number.high - number.low < 0.12


def test_the_path_tells_how_old_poses_of_straight_driving_are(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    true = poses["t"].to_numpy()
    stamps = delay(true, draw_ages(true.size, 0.06))
    track = load(tables, poses=poses.with_columns(pl.Series("t", stamps))).track
    speed = np.abs(np.gradient(track.path, true))
    straight = (np.abs(np.gradient(track.heading, true)) < 0.1) & (speed > 0.2)
    after = track.times - true
    # The path tells neighbours apart: the gyro alone leaves 0.44 of their difference.
    assert np.std(np.diff(after)[straight[1:]]) < 0.38 * np.std(np.diff(stamps - true)[straight[1:]])
    # Speeding up is not taken for a pose that is old.
    faster = np.gradient(speed, true)[straight]
    assert abs(np.polyfit(faster, after[straight], 1)[0]) < 0.01  # s per m/s^2


def test_wrong_positions_leave_the_ages_about_them_alone(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    true = poses["t"].to_numpy()
    late = poses.with_columns(pl.Series("t", delay(true, draw_ages(true.size, 0.06))))
    spikes = pl.Series("x", poses["x"].to_numpy() + 1.0 * (np.arange(true.size) % 100 == 50))
    turning = np.abs(np.gradient(load(tables).track.heading, true)) > 0.3
    plain, spiked = (load(tables, poses=one).track.times - true for one in (late, late.with_columns(spikes)))
    assert np.std(spiked[turning]) < 1.1 * np.std(plain[turning])


def test_poses_that_grow_older_while_turning_do_not_scale_the_gyro(
    tables: Mapping[str, pl.DataFrame],
) -> None:
    poses, gyro = tables["poses"], tables["imu"]
    true = poses["t"].to_numpy()
    turning = np.interp(true, gyro["t"].to_numpy(), np.abs(gyro["rate_z"].to_numpy())) > 0.3
    older = lag_signal(0.3 * turning, tau_s=4.0, step_s=float(np.median(np.diff(true))))
    run = load(
        tables, poses=poses.with_columns(pl.Series("t", delay(true, older + draw_ages(true.size, 0.05))))
    )
    assert run.gyro_fit.signed_scale == pytest.approx(1.0, abs=0.003)


def test_a_localization_that_jumps_away_and_back_is_not_compared(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    times = poses["t"].to_numpy()
    away = (times > 100.0) & (times < 102.0)
    moved = poses.with_columns(pl.Series("x", poses["x"].to_numpy() + 1.5 * away))
    run = load(tables, poses=moved)
    before = np.sort(load(tables).excluded)
    more = run.excluded[np.abs(before[nearest_indices(run.excluded, before)] - run.excluded) > 0.02]
    assert np.abs(more - 101.0).max() < 1.8
    for edge in (100.0, 102.0):
        assert np.abs(more - edge).min() < 0.1


def test_faults_are_never_more_than_a_twentieth(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    times = poses["t"].to_numpy()
    often = np.where(times % 4.0 < 1.0, 1.5, 0.0)
    run = load(tables, poses=poses.with_columns(pl.Series("y", poses["y"].to_numpy() + often)))
    assert run.alignment.outlier_s <= 0.05 * run.duration_s + 0.5
    assert run.excluded.size > load(tables).excluded.size


def test_a_pose_that_is_only_waited_for_is_no_rest(tables: Mapping[str, pl.DataFrame]) -> None:
    poses = tables["poses"]
    wheels = tables["wheels"]
    times = poses["t"].to_numpy()
    rim = np.interp(times, wheels["t"].to_numpy(), np.abs(wheels["left"].to_numpy()))
    start = int(np.flatnonzero((rim > 2.0) & (times > 60.0))[0])
    stuck = np.arange(times.size)
    stuck[start : start + 17] = start
    held = np.zeros(times.size, dtype=bool)
    held[start + 1 : start + 17] = True
    assert 0.6 < times[start + 16] - times[start] < 1.5
    frozen = poses.select(pl.all().gather(stuck)).with_columns(t=poses["t"], held=pl.Series(held))
    run = load(tables, poses=frozen)
    assert run.track.times.size == times.size - 16


@pytest.mark.parametrize("late", few([0.0, 0.12, 0.25], 2))
def test_the_delay_of_the_encoders_is_measured_against_the_gyro(
    late: float, tables: Mapping[str, pl.DataFrame]
) -> None:
    wheels = tables["wheels"].with_columns(pl.col("t") + late)
    run = load(tables, wheels=wheels)
    model = Model(HUSKY, tuple(find_effect(name)() for name in SKID))
    left = fit_model(EstimationData([run], HUSKY, Input.COMMAND), model).state.timing[0].wheel_delay_s
    # Read twenty times a second, wheels that step seem late by up to half that time.
    assert (run.alignment.wheel_delay_s > 0.0) == (late > 0.0)
    assert late - 0.02 < run.alignment.wheel_delay_s + left < late + 0.045
    assert abs(left) < 0.03


_MOVED, _TURNED, _LATER_S = 100.0 - 50.0j, 1.2, 12.8


def _move(frame: pl.DataFrame) -> pl.DataFrame:
    """Poses in another map."""
    place = (frame["x"].to_numpy() + 1j * frame["y"].to_numpy()) * np.exp(1j * _TURNED) + _MOVED
    quaternion = frame.select("q_x", "q_y", "q_z", "q_w").to_numpy()
    turn = np.tile(rigid.quaternions_from_yaw(np.array([_TURNED])), (frame.height, 1))
    turned = rigid.multiply_quaternions(turn, quaternion)
    columns = {f"q_{name}": turned[:, index] for index, name in enumerate("xyzw")}
    return frame.with_columns(**{"x": place.real, "y": place.imag, **columns})


def test_a_fit_is_the_same_to_the_last_bit_wherever_the_map_lies_and_whenever_it_started(
    tables: Mapping[str, pl.DataFrame],
) -> None:
    stamped = {name: tables[name] for name in ("poses", "commands", "wheels", "imu", "slip")}
    later = {name: frame.with_columns(pl.col("t") + _LATER_S) for name, frame in stamped.items()}
    moved = {**tables, **later, "poses": _move(later["poses"])}
    recorded = load_run(tables, HUSKY, name="recorded")
    data, other = (
        EstimationData([run], HUSKY, Input.COMMAND)
        for run in (recorded, load_run(moved, HUSKY, name="moved"))
    )
    model = Model(HUSKY, tuple(find_effect(name)() for name in SKID))
    fitted = fit_model(data, model, exact=True)
    assert np.array_equal(fit_model(other, model, exact=True).residuals, fitted.residuals)
    assert np.array_equal(recorded.anchored.anchored.track.path, data.runs[0].track.path)
    assert recorded.anchored.anchored.origin == data.runs[0].origin

    effects, timing = fitted.state.effects, fitted.state.timing[0]
    one, two = (predict_from(each.residuals_by_run[0], effects, timing) for each in (data, other))
    assert np.allclose(one.start_times + _LATER_S, two.start_times)
    path, beyond = (made.poses[..., 0] + 1j * made.poses[..., 1] for made in (one, two))
    assert np.allclose(path * np.exp(1j * _TURNED) + _MOVED, beyond)
    assert np.allclose(one.poses[..., 2] + _TURNED, two.poses[..., 2])
    plain = predict_from(RunResiduals(recorded, HUSKY, Input.COMMAND), effects, timing)
    assert np.allclose(plain.poses, one.poses, atol=1e-4)
