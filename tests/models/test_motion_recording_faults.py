"""What is no fault: steps of a command, and a gyro that fell silent is no heading."""

from __future__ import annotations

from typing import TYPE_CHECKING

import polars as pl
import pytest
from motion_runs import QUIET, make_scenario, tables_of, vehicle_of

from pipeline.run import load_run
from pipeline.run.heading import fit_gyro
from pipeline.simulate import VEHICLES, Imu, Program, simulate_run

if TYPE_CHECKING:
    from collections.abc import Mapping

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
    assert (fit_gyro(run) is not None) == is_heading


def test_steps_of_the_command_are_no_faults_of_the_localization() -> None:
    car = vehicle_of("ackermann_car")
    steps = Program("drive_steps", speed_scale=0.6, turn_scale=0.6)
    scene = make_scenario({}, vehicle=VEHICLES["car"], program=steps, pose=QUIET, imu=Imu())
    assert load_run(tables_of(simulate_run(scene), car), car, name="car").alignment.outlier_s == 0.0
