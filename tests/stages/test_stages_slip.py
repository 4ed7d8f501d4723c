"""Slip: f(u) - v, its modulus, and the published window norm."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stage_logs import FIELD, PLAIN, TakeThrough, rms, slope

from pipeline.simulate import VEHICLES, Program
from pipeline.sources import Vehicle, find_preset
from pipeline.stages.inputs import hold_commands, interpolate_wheels
from pipeline.stages.slip_stage import cut_windows, report_across
from pipeline.words import format_finding


def preset(name: str, **changes: float) -> Vehicle:
    found = find_preset(name)
    assert found is not None
    from msgspec.structs import replace as change  # noqa: PLC0415 - presets are structs, scenarios are not

    return change(found, **changes)


HUSKY = preset("husky")


def test_slip_is_ideal_minus_measured_and_its_modulus_takes_the_length_scale(drive: TakeThrough) -> None:
    plain = drive(FIELD).result.slip
    longer = drive(FIELD, {"slip": {"length_scale_m": 2.5}}).result.slip
    for axis in "xyw":
        assert np.allclose(plain[f"g_{axis}"], plain[f"f_{axis}"] - plain[f"v_{axis}"], atol=1e-12)
    for frame, length in ((plain, 1.0), (longer, 2.5)):
        parts = [frame["g_x"], frame["g_y"], frame["g_w"] * length]
        assert np.allclose(frame["modulus"] ** 2, sum(part**2 for part in parts))
    assert np.array_equal(plain["g_w"], longer["g_w"])


def test_a_known_slip_comes_out(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, effects={"drive_lag": 0.3, "effective_track": 1.8, "wheel_radius": 0.9}))
    steady = taken.slip("measured").filter(~pl.col("transitory"))
    assert slope(steady["f_x"], steady["g_x"]) == pytest.approx(0.1, abs=0.01)
    assert slope(steady["f_w"], steady["g_w"]) == pytest.approx(1.0 - 0.9 / 1.8, abs=0.01)


def make_slip(
    count: int, rate: float, modulus: float = 0.5, *, step: int = 0, start: float = 0.0
) -> pl.DataFrame:
    return pl.DataFrame(
        {
            "t": start + np.arange(count) / rate,
            "segment": np.zeros(count, dtype=np.int32),
            "step": np.full(count, step, dtype=np.int32),
            "input": pl.Series(["command"] * count, dtype=pl.Enum(["command", "measured"])),
            "transitory": np.zeros(count, dtype=bool),
            "suspect": np.zeros(count, dtype=bool),
            "standing": np.zeros(count, dtype=bool),
            "modulus": np.full(count, modulus),
        }
    )


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0])
def test_the_window_norm_is_root_40_times_the_root_mean_square_at_any_rate(rate: float) -> None:
    windows = cut_windows(make_slip(round(2.0 * rate) * 3, rate), rate)
    assert windows.height == 3
    assert windows["samples"].to_list() == [round(2.0 * rate)] * 3
    assert np.allclose(windows["window_norm"], np.sqrt(40.0) * 0.5)
    assert np.allclose(windows["rms_modulus"], 0.5)
    assert np.allclose(windows["t_end"] - windows["t_start"], 2.0)


@given(st.integers(1, 300))
def test_a_remainder_is_dropped(count: int) -> None:
    windows = cut_windows(make_slip(count, 20.0), 20.0)
    assert windows.height == count // 40


def test_windows_start_at_each_step_and_cross_none() -> None:
    slip = pl.concat([make_slip(110, 20.0, 0.1, step=0), make_slip(90, 20.0, 0.9, step=1, start=5.5)])
    windows = cut_windows(slip, 20.0)
    assert windows["t_start"].to_list() == pytest.approx([0.0, 2.0, 5.5, 7.5])
    assert windows["step"].to_list() == [0, 0, 1, 1]
    assert set(windows["rms_modulus"].round(9)) == {0.1, 0.9}


def test_windows_cross_no_hole_inside_a_step() -> None:
    slip = pl.concat([make_slip(50, 20.0), make_slip(100, 20.0, start=3.0)])
    windows = cut_windows(slip, 20.0)
    # Of a step from 0 to 8 s with a hole from 2.5 to 3 s, three of four windows are whole.
    assert windows["t_start"].to_list() == pytest.approx([0.0, 4.0, 6.0])


def test_a_suspect_sample_makes_its_window_suspect() -> None:
    slip = make_slip(80, 20.0).with_columns(suspect=pl.Series(np.arange(80) == 50))
    assert cut_windows(slip, 20.0)["suspect"].to_list() == [False, True]


@pytest.mark.parametrize(
    "program",
    [
        "drive_steps",
        "ramps",
        "teleop",
        *(pytest.param(more, marks=pytest.mark.long) for more in ("smooth", "slalom", "circle")),
    ],
)
def test_every_way_of_driving_has_windows_inside_steps_and_segments(drive: TakeThrough, program: str) -> None:
    taken = drive(replace(FIELD, program=Program(program)), {"velocity": {"rate_hz": 20}})  # type: ignore[arg-type]
    for name in ("command", "measured"):
        slip, windows = taken.slip(name), taken.windows(name)
        # At least half of the run stands in full windows, however restless the command.
        assert windows.height * 2.0 > 0.5 * slip.height / 20.0
        for window in windows.iter_rows(named=True):
            inside = slip.filter(pl.col("t").is_between(window["t_start"], window["t_end"], closed="left"))
            assert inside["step"].n_unique() == inside["segment"].n_unique() == 1


def make_drive(times: list[float], left: list[float]) -> pl.DataFrame:
    return pl.DataFrame({"t": times, "left": left, "right": left, "active": [True] * len(times)})


def test_a_command_is_held_until_the_next_one_or_until_it_is_stale() -> None:
    commands = make_drive([1.0, 1.1, 1.2, 5.0], [1.0, 2.0, 3.0, 4.0])
    at = np.array([0.9, 1.0, 1.15, 1.7, 1.71, 5.0])
    found = hold_commands(at, commands, HUSKY, 0.5)
    speed = found.velocity[:, 0] / 0.165
    assert np.allclose(speed, [np.nan, 1.0, 2.0, 3.0, np.nan, 4.0], equal_nan=True)
    assert found.stale.tolist() == [False, False, False, False, True, False]


def test_measured_wheels_are_interpolated_but_not_across_holes() -> None:
    stamps = [0.0, 0.1, 0.2, 3.0, *(3.1 + 0.1 * np.arange(20)).tolist()]
    wheels = make_drive(stamps, [0.0, 1.0, 2.0, *[9.0] * 21])
    found = interpolate_wheels(np.array([-0.1, 0.05, 0.2, 1.0, 3.05, 5.2]), wheels, HUSKY)
    speed = found.velocity[:, 0] / 0.165
    assert np.allclose(speed, [np.nan, 0.5, 2.0, np.nan, 9.0, np.nan], equal_nan=True)


def test_wheels_that_stand_across_tell_no_turn_and_are_reported() -> None:
    # Of a tricycle that turns on the spot the rear axle stands: an ideal turn of it would be rounding.
    times = np.arange(0.0, 10.0, 0.0625)
    steering = np.where(times >= 5.0, np.pi / 2.0, 0.2)
    columns = {"t": times, "speed": np.where(times >= 5.0, 1e-9, 0.5), "steering": steering}
    wheels = pl.DataFrame({**columns, "active": [True] * times.size})
    found = interpolate_wheels(times, wheels, preset("car")).velocity
    assert np.isfinite(found[times < 5.0]).all()
    assert np.isnan(found[times >= 5.0]).all()
    (finding,) = report_across(wheels)
    assert finding.count == np.count_nonzero(times >= 5.0)
    assert "for 5 s the steered wheel stands across" in format_finding(finding)
    assert not report_across(wheels.filter(pl.col("t") < 5.0))
    assert not report_across(make_drive([0.0, 0.1], [1.0, 1.0]))


def test_with_yaw_imu_the_gyro_gives_the_yaw_rate_and_nothing_else(drive: TakeThrough) -> None:
    pose, imu = drive(FIELD), drive(FIELD, {"velocity": {"yaw": "imu"}})
    assert np.array_equal(pose.velocities["v_x"], imu.velocities["v_x"])
    assert np.array_equal(imu.velocities["v_w"], imu.velocities["v_w_imu"])
    assert rms(pose.velocities["v_w"] - imu.velocities["v_w"]) > 1e-4


def test_a_car_with_base_link_between_its_axles_has_no_lateral_slip(drive: TakeThrough) -> None:
    middle = replace(VEHICLES["car"], name="ackermann_car")
    scenario = replace(PLAIN, vehicle=middle, effects={"lever_arm": {"l_x": 1.3, "l_y": 0.0}})
    rear = drive(scenario).slip("measured")
    told = drive(scenario, {"vehicle": {"base_to_rear_axle_m": 1.3}}).slip("measured")
    assert float(rear["g_y"].abs().median()) > 0.1
    assert float(told["g_y"].abs().median()) < 0.02
