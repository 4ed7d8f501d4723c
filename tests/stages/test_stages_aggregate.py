"""What a run comes to."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from stage_logs import FIELD, Taken, TakeThrough

from pipeline.simulate import Ground
from pipeline.stages.slip_stage import aggregate_run


def aggregate(taken: Taken, length: float = 1.0) -> pl.DataFrame:
    result = taken.result
    return aggregate_run(
        result.slip, result.windows, taken.velocities, vehicle=taken.aligned.vehicle, length=length
    )


def row(frame: pl.DataFrame, name: str, subset: str = "all") -> dict[str, float]:
    return frame.filter((pl.col("input") == name) & (pl.col("subset") == subset)).row(0, named=True)


@pytest.mark.parametrize("length", [1.0, 2.5])
def test_drivetrain_ground_and_cross_add_up_to_the_whole(drive: TakeThrough, length: float) -> None:
    frame = aggregate(drive(FIELD, {"slip": {"length_scale_m": length}}), length)
    for subset in ("all", "transitory", "steady"):
        whole = row(frame, "command", subset)
        parts = [whole[f"{part}_mean_square"] for part in ("drivetrain", "ground", "cross")]
        # The few samples that only one of the inputs has make the last hundredth.
        assert sum(parts) == pytest.approx(whole["mean_square"], rel=0.01)


def test_a_lag_is_the_drivetrains_and_a_wide_track_is_the_grounds(drive: TakeThrough) -> None:
    lag = row(aggregate(drive(replace(FIELD, effects={"drive_lag": 0.5}))), "command")
    assert lag["drivetrain_mean_square"] > 3.0 * lag["ground_mean_square"]
    track = row(aggregate(drive(replace(FIELD, effects={"effective_track": 1.8}))), "command")
    assert track["ground_mean_square"] > 3.0 * track["drivetrain_mean_square"]


def test_a_lag_shows_while_the_command_is_fresh(drive: TakeThrough) -> None:
    frame = aggregate(drive(replace(FIELD, effects={"drive_lag": 0.5})))
    assert (
        row(frame, "command", "transitory")["mean_square"]
        > 5.0 * row(frame, "command", "steady")["mean_square"]
    )
    counts = [row(frame, "command", subset)["samples"] for subset in ("all", "transitory", "steady")]
    assert counts[0] == counts[1] + counts[2]


def test_medians_and_root_mean_squares_are_those_of_the_tables(drive: TakeThrough) -> None:
    taken = drive(FIELD)
    found = row(aggregate(taken), "measured")
    slip, windows = taken.slip("measured"), taken.windows("measured")
    assert found["median_modulus"] == slip["modulus"].median()
    assert found["median_window_norm"] == windows["window_norm"].median()
    assert found["rms_w"] == pytest.approx(np.sqrt((slip["g_w"] ** 2).mean()))
    assert (found["samples"], found["windows"]) == (slip.height, windows.height)


def test_suspect_samples_are_left_out_of_medians(drive: TakeThrough) -> None:
    taken = drive(FIELD)
    half = taken.result.slip.with_columns(suspect=pl.col("t") > 30.0)
    found = aggregate_run(
        half, taken.result.windows, taken.velocities, vehicle=taken.aligned.vehicle, length=1.0
    )
    kept = half.filter((pl.col("t") <= 30.0) & (pl.col("input") == "measured"))
    assert row(found, "measured")["samples"] == kept.height
    assert row(found, "measured")["median_modulus"] == kept["modulus"].median()


def test_distance_energy_and_height_are_those_of_the_motion(drive: TakeThrough) -> None:
    flat = row(aggregate(drive(FIELD)), "measured")
    path = drive(FIELD).velocities
    assert flat["distance"] == pytest.approx(float(np.hypot(path["v_x"], path["v_y"]).sum()) * 0.05, rel=0.01)
    slip = drive(FIELD).slip("measured").filter(~pl.col("suspect"))
    speed = np.hypot(slip["v_x"].to_numpy(), slip["v_y"].to_numpy())
    calm = [np.median(speed[max(0, i - 20) : i + 1]) for i in range(2, speed.size)]
    fastest = float(np.quantile(calm, 0.99, method="nearest"))
    assert flat["largest_kinetic_energy"] == pytest.approx(0.5 * 75.0 * fastest**2, rel=1e-6)
    hilly = row(aggregate(drive(replace(FIELD, ground=Ground(hill_m=0.5)))), "measured")
    assert hilly["height_rate"] > 3.0 * flat["height_rate"]


def test_noise_of_the_poses_is_no_distance_of_a_vehicle_that_stands(drive: TakeThrough) -> None:
    taken = drive(FIELD)
    parts = (taken.result.slip, taken.result.windows, taken.velocities)
    found = aggregate_run(*parts, vehicle=taken.aligned.vehicle, length=1.0, moves=False)
    assert found["distance"].null_count() == found.height
    assert row(found, "command")["duration"] > 0.0
