"""What is no fault: steps of a command, a gyro that fell silent, a localization that waits for motion."""

from collections.abc import Mapping

import numpy as np
import polars as pl
import pytest
from motion_runs import QUIET, make_scenario, tables_of, vehicle_of

from pipeline.estimation import EstimationData, Input, fit_model, hold_out
from pipeline.estimation.floor import estimate_floor
from pipeline.models import Model
from pipeline.run import load_run
from pipeline.simulate import VEHICLES, Disturbance, Imu, PoseSensor, Program, simulate_run
from pipeline.stages.gyro import fit_gyro

HUSKY = vehicle_of("husky_a200")


@pytest.fixture(scope="module")
def tables() -> Mapping[str, pl.DataFrame]:
    return tables_of(simulate_run(make_scenario({}, pose=QUIET, imu=Imu())), HUSKY)


@pytest.mark.parametrize(
    ("heard", "is_heading"),
    [
        (pl.lit(value=True), True),
        (pl.col("t") < 50.0, False),
        (~pl.col("t").is_between(50.0, 70.0), False),
        (~pl.col("t").is_between(50.0, 52.0), True),
    ],
)
def test_a_gyro_that_fell_silent_is_no_heading(
    tables: Mapping[str, pl.DataFrame], heard: pl.Expr, *, is_heading: bool
) -> None:
    run = load_run({**tables, "imu": tables["imu"].filter(heard)}, HUSKY, name="gyro")
    assert (fit_gyro(run.track, run.gyro, run.excluded) is not None) == is_heading


def test_steps_of_the_command_are_no_faults_of_the_localization() -> None:
    car = vehicle_of("ackermann_car")
    steps = Program("drive_steps", speed_scale=0.6, turn_scale=0.6)
    scene = make_scenario({}, vehicle=VEHICLES["car"], program=steps, pose=QUIET, imu=Imu())
    assert load_run(tables_of(simulate_run(scene), car), car, name="car").alignment.outlier_s == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_what_a_localization_corrects_every_few_seconds_is_noise(seed: int) -> None:
    """As slam_toolbox, which waits for half a metre: the floor was a fifth of what the true model leaves."""
    quiet, random = PoseSensor(noise_m=0.0005, noise_rad=0.0005), Disturbance(0.001, 0.005)
    made = simulate_run(make_scenario({}, seed=seed, duration_s=240.0, pose=quiet, disturbance=random))
    tables, draw, period = tables_of(made, HUSKY), np.random.default_rng(seed), 3.0
    times = tables["poses"]["t"].to_numpy()
    scans = np.arange(times[0], times[-1] + period, period)
    error = {axis: np.interp(times, scans, draw.normal(0.0, 0.02, scans.size)) for axis in "xy"}
    corrected = np.diff(np.floor((times - times[0]) / period), prepend=0.0) > 0.0
    poses = tables["poses"].with_columns(
        *(pl.col(axis) + error[axis] for axis in "xy"), corrected=pl.Series(corrected)
    )
    data = EstimationData([load_run({**tables, "poses": poses}, HUSKY, name="waits")], HUSKY, Input.COMMAND)
    unseen = hold_out(data, fit_model(data, Model(HUSKY, ()))).pooled
    assert 0.7 < estimate_floor(data).t_mrmse_m / unseen.t_mrmse_m < 1.4
