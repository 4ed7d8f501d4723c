"""Poses that are integrated wheels are told from a localization that sees how the wheels skid."""

import msgspec
import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter
from stage_logs import make_samples

from pipeline.recording.echo import check_echo
from pipeline.sources import find_preset
from pipeline.stages.trust import Samples, check_independence

PERIODS_S = (0.05, 0.1)


def drive_curves(drift_s: float, uneven_m: float = 0.0) -> Samples:
    """Wheels that drive curves of all kinds, and poses that follow them but for v_y = drift_s v w.

    Args:
        drift_s: by which they go beside them.
        uneven_m: spread of what single steps are beside that, and the next ones make good.
    """
    times = np.arange(0.0, 60.0, 0.05)
    speed, turn = 1.0 + 0.5 * np.sin(0.7 * times), 0.6 * np.sin(0.4 * times)
    velocity = np.column_stack((speed, drift_s * speed * turn, turn))
    beside = np.random.default_rng(1).normal(0.0, uneven_m, times.size)
    velocity[:, 1] += np.diff(beside, prepend=0.0) / 0.05
    return make_samples(times, np.column_stack((speed, np.zeros(times.size), turn)), velocity)


def turn_wheels(lag_s: float, noise: float, step: float) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Wheel speeds that are commanded anew every 50 ms, and what the encoders read every 20 ms [rad/s].

    Args:
        lag_s: time constant of the drive; zero repeats the last command.
        noise: standard deviation of the readings.
        step: resolution of the readings; zero is exact.
    """
    times, random = np.arange(0.0, 30.0, 0.001), np.random.default_rng(1)
    asked = np.stack((5.0 + 2.0 * np.sin(0.7 * times), 5.0 + 2.0 * np.cos(0.4 * times)))
    asked = asked[:, np.arange(times.size) // 50 * 50]
    turned = asked if lag_s == 0.0 else lfilter([0.001 / lag_s], [1.0, 0.001 / lag_s - 1.0], asked)
    read = turned + random.normal(0.0, noise, asked.shape)
    read = np.round(read / step) * step if step else read
    return tuple(
        pl.DataFrame({"t": times[rows], "left": sides[0, rows], "right": sides[1, rows]})
        for sides, rows in ((asked, slice(None, None, 50)), (read, slice(7, None, 20)))
    )  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("lag_s", "noise", "step", "found"),
    [
        (0.0, 0.0, 0.0, True),
        (0.0, 1e-7, 0.0, True),
        (0.02, 0.0, 0.0, False),
        (0.005, 0.0, 0.0, False),
        (0.0, 0.001, 0.0, False),
        (0.0, 0.0, 0.01, False),
        (0.02, 0.01, 0.02, False),
    ],
)
def test_readings_that_repeat_the_commands_are_told_from_those_of_a_fast_drive(
    lag_s: float,
    noise: float,
    step: float,
    found: bool,  # noqa: FBT001 - one of the cases
) -> None:
    commands, wheels = turn_wheels(lag_s, noise, step)
    told = check_echo(commands, wheels, find_preset("husky_a200"), body_commanded=False)
    assert [finding.id for finding in told] == (["wheels_from_commands"] if found else [])


def test_a_body_command_is_repeated_through_the_controllers_geometry() -> None:
    husky = msgspec.structs.replace(find_preset("husky_a200"), controller_track_multiplier=1.875)
    commands, wheels = turn_wheels(0.0, 0.0, 0.0)
    mean, half = 0.5 * (wheels["left"] + wheels["right"]), 0.5 * (wheels["right"] - wheels["left"])
    wheels = wheels.with_columns(left=mean - half / 1.875, right=mean + half / 1.875)
    assert check_echo(commands, wheels, husky, body_commanded=True)
    assert not check_echo(commands, wheels, husky, body_commanded=False)


@pytest.mark.parametrize(
    ("drift_s", "found"),
    [(0.0, True), (0.025, True), (-0.025, True), (0.05, True), (0.005, True), (-0.04, False), (-0.1, False)],
)
def test_steps_before_or_after_the_turn_are_odometry_and_a_skid_is_not(
    drift_s: float,
    found: bool,  # noqa: FBT001 - one of the cases
) -> None:
    told = check_independence(drive_curves(drift_s), find_preset("husky_a200"), PERIODS_S)
    assert [finding.id for finding in told] == (["pose_from_wheels"] if found else [])


def test_uneven_steps_that_do_not_add_up_are_odometry_all_the_same() -> None:
    vehicle = find_preset("husky_a200")
    assert check_independence(drive_curves(0.025, uneven_m=5e-5), vehicle, PERIODS_S)
    assert not check_independence(drive_curves(0.025, uneven_m=5e-4), vehicle, PERIODS_S)
