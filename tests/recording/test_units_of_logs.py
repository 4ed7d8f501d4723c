"""Units of commands that no name says: logs of one drawn drive, and the line that settles each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drawn_motion import STEP, draw
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.words import format_finding


def set_up(log: Path, line: str = "") -> LogSetup:
    (log.parent / "line.toml").write_text(f"[command]\n{line}")
    return set_up_log(log, Options(out=log.parent, config=log.parent / "line.toml"))


def test_a_speed_in_kilometres_per_hour(tmp_path: Path) -> None:
    drive = draw(41)
    faster = drive.asked * [3.6, 1.0]
    setup = set_up(write_log(tmp_path / "log.mcap", drive, asked=faster))
    told = " ".join(format_finding(one) for one in setup.choice.findings)
    assert 'unit = "km/h"' in told
    assert setup.configuration.command.unit == "km/h"
    # The geometry is that of the command as it is meant.
    assert setup.vehicle.wheel_radius_m == pytest.approx(0.1, rel=0.02)
    assert setup.vehicle.track_width_m == pytest.approx(0.5, rel=0.02)


def write_car(
    path: Path,
    speed: float,
    angle: float,
    wheelbase: float = 0.9,
    measured: float | None = None,
    widest: float = np.inf,
) -> Path:
    """A car that takes its commands in other units, and may measure its speed, in another one, too.

    Of a car that steers no farther than `widest` more is asked than that, at one speed.
    """
    drive = draw(42)
    asked = np.column_stack([drive.asked[:, 0], 0.35 * drive.asked[:, 1]])
    if widest < np.inf:
        asked = np.column_stack([np.full(drive.time.size, 0.8), 1.1 * drive.asked[:, 1]])
    made = np.zeros_like(asked)
    for k in range(1, made.shape[0]):
        made[k] = made[k - 1] + STEP / 0.2 * (asked[k - 1] - made[k - 1])
    made[:, 1] = np.clip(made[:, 1], -widest, widest)
    rate = made[:, 0] * np.tan(made[:, 1]) / wheelbase
    yaw = np.cumsum(rate) * STEP
    place = np.cumsum(made[:, 0] * np.exp(1j * yaw)) * STEP
    rng = np.random.default_rng(4)
    rows = drive.rows
    noise = rng.normal(0.0, 0.002, (3, rows.size))
    drive = type(drive)(
        drive.time,
        drive.asked,
        made[:, 0],
        rate,
        place[rows] + noise[0] + 1j * noise[1],
        yaw[rows] + noise[2],
        rows,
    )
    seen = None if measured is None else made * [measured, 1.0]
    return write_log(path, drive, car=asked * [speed, angle], car_measured=seen)


@pytest.mark.parametrize(
    ("speed", "angle", "line"),
    [(1.0, 1.0, ""), (1.0, 180.0 / np.pi, 'steering_unit = "deg"'), (3.6, 180.0 / np.pi, 'unit = "km/h"')],
)
def test_a_car_in_other_units(speed: float, angle: float, line: str, tmp_path: Path) -> None:
    log = write_car(tmp_path / "log.mcap", speed, angle)
    setup = set_up(log)
    told = " ".join(format_finding(one) for one in setup.choice.findings)
    assert line in told
    assert ("unit" in told) == bool(line)
    assert setup.configuration.command.steering_unit == ("deg" if angle != 1.0 else None)
    assert setup.vehicle.wheelbase_m == pytest.approx(0.9, rel=0.03)
    if line:
        settled = [format_finding(one) for one in set_up(log, line).choice.findings]
        assert not [text for text in settled if line in text]


def test_a_car_that_does_not_steer_as_far_as_it_is_asked_is_no_car_in_degrees(tmp_path: Path) -> None:
    setup = set_up(write_car(tmp_path / "log.mcap", 1.0, 1.0, widest=0.35))
    assert setup.configuration.command.steering_unit is None
    wheelbase = setup.vehicle.wheelbase_m
    assert wheelbase is not None
    assert wheelbase > 0.5


@pytest.mark.parametrize(
    ("speed", "measured", "commanded_in", "measured_in"),
    [(1.0, 1.0, None, None), (3.6, 1.0, "km/h", None), (1.0, 3.6, None, "km/h"), (3.6, 3.6, "km/h", "km/h")],
)
def test_three_speeds_of_a_car_vote_on_their_units(
    speed: float, measured: float, commanded_in: str | None, measured_in: str | None, tmp_path: Path
) -> None:
    setup = set_up(write_car(tmp_path / "log.mcap", speed, 1.0, measured=measured))
    assert str(setup.sources.command) == "/drive"
    assert str(setup.sources.wheels) == "/drive_measured"
    assert (setup.configuration.command.unit, setup.configuration.wheels.unit) == (commanded_in, measured_in)
    told = " ".join(format_finding(one) for one in setup.choice.findings)
    assert ('unit = "m/s" takes them as recorded' in told) == bool(commanded_in or measured_in)
    assert "wheel radius" not in told
    assert setup.vehicle.wheelbase_m == pytest.approx(0.9, rel=0.03)
