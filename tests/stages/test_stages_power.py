"""Currents and voltages: found by type or name, tabulated over time and way, and drawn."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from fomo_session import RADIUS_M, write_session

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.logs.writer import LogWriter
from pipeline.report.figures.slip_figures import draw_power
from pipeline.report.scene import RunReport, Scene
from pipeline.sources.candidates import choose_power
from pipeline.store import Manifest

FLOAT = "std_msgs/Float64"
PER_METRE = 2.0 * 4.0 * 47.0 / RADIUS_M
"""Of the made-up session: 4 A a rad/s on both sides at 47 V, over the speed of the rims [J/m]."""


def extract(session: Path) -> Manifest:
    options = Options(out=session.parent / "results", report=False, through="extract")
    return analyze_log(session, options).manifest


@pytest.mark.parametrize(
    ("types", "expected"),
    [
        (
            {"/m/left/current_battery": FLOAT, "/m/right/current_battery": FLOAT, "/m/voltage": FLOAT},
            "/m/left/current_battery.data, /m/right/current_battery.data; voltage /m/voltage.data",
        ),
        (
            {"/sensors/core": "vesc_msgs/VescStateStamped"},
            "/sensors/core.state.current_input; voltage /sensors/core.state.voltage_input",
        ),
        (
            {"/husky/status": "husky_msgs/HuskyStatus", "/battery": "sensor_msgs/BatteryState"},
            (
                "/husky/status.left_driver_current, /husky/status.right_driver_current; "
                "voltage /husky/status.battery_voltage"
            ),
        ),
        (
            {"/feedback": "jackal_msgs/Feedback"},
            "/feedback.drivers[0].current, /feedback.drivers[1].current; voltage not recorded",
        ),
        ({"/battery": "sensor_msgs/BatteryState"}, "/battery.current; voltage /battery.voltage"),
    ],
)
def test_currents_of_motors_are_found_by_type_or_name(types: dict[str, str], expected: str) -> None:
    found = choose_power(types)
    assert str(found) == expected
    assert found is not None
    assert found.sign == (-1 if expected.startswith("/battery") else 1)


def test_power_is_told_over_time_and_over_the_way(tmp_path: Path) -> None:
    session = write_session(tmp_path / "red_2025-10-14-11-41", duration_s=60.0)
    manifest = extract(session)
    power = manifest.read("power")
    wheels = manifest.read("wheels")
    at = power["t"].to_numpy()
    turning = sum(np.interp(at, wheels["t"], wheels[side]) for side in ("left", "right"))
    # The vehicle starts with a step at 3 s.
    inside = (at > 4.0) & (at < wheels["t"].max())
    # Wheels come four times a second, currents once.
    np.testing.assert_allclose(power["current"].to_numpy()[inside], 4.0 * turning[inside], atol=1.0)
    np.testing.assert_allclose(power["voltage"], 47.0)
    np.testing.assert_allclose(power["power"], 47.0 * power["current"])
    driven = power.filter(pl.col("t") > 5.0)["energy_per_m"].drop_nulls().to_numpy()
    assert driven.size > 40
    np.testing.assert_allclose(driven, PER_METRE, rtol=0.03)
    assert power.filter(pl.col("t") < 1.0)["energy_per_m"].null_count() >= 1
    (told,) = manifest.read("findings").filter(pl.col("id") == "power_drawn").to_dicts()
    assert told["value"] == pytest.approx(PER_METRE, rel=0.02)
    assert " J/m (median)" in told["text"]


def test_without_a_voltage_the_current_is_told_alone(tmp_path: Path) -> None:
    session = write_session(tmp_path / "red_2025-10-14-11-41", duration_s=30.0)
    for side in ("left", "right"):
        (session / "metadata" / f"voltage_{side}.csv").unlink()
    manifest = extract(session)
    power = manifest.read("power")
    assert power["current"].null_count() == 0
    assert power["power"].null_count() == power["energy_per_m"].null_count() == power.height
    (told,) = manifest.read("findings").filter(pl.col("id") == "power_drawn").to_dicts()
    assert "no voltage is recorded" in told["text"]
    scene = Scene(RunReport({}, {"power": power}))
    drawing = draw_power(scene)
    assert drawing is not None
    assert set(drawing.rows) >= {"power_current"}
    assert "power_energy_per_m" not in drawing.rows


def test_a_battery_that_counts_what_is_drawn_as_negative_is_turned_round(tmp_path: Path) -> None:
    session = write_session(tmp_path / "red_2025-10-14-11-41", duration_s=10.0)
    for name in ("current", "voltage"):
        for side in ("left", "right"):
            (session / "metadata" / f"{name}_{side}.csv").unlink()
    assert "power" not in extract(session).tables
    log = tmp_path / "run.mcap"
    battery = "float32 voltage\nfloat32 temperature\nfloat32 current\n"
    with LogWriter(log) as writer:
        times = 1_700_000_000_000_000_000 + np.arange(300) * 50_000_000
        seconds = (times - times[0]) * 1e-9
        pose = {"pose.position.x": 0.5 * seconds, "pose.orientation.w": 1.0, "header.frame_id": "map"}
        writer.write_columns("/icp_pose", "geometry_msgs/msg/PoseStamped", times, pose, header_time=times)
        drive = {"linear.x": np.full(300, 0.5)}
        writer.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", times, drive)
        drawn = {"voltage": np.full(30, 24.0), "current": np.full(30, -5.0)}
        writer.write_columns(
            "/battery", "sensor_msgs/msg/BatteryState", times[::10], drawn, definition=battery
        )
    overrides = {"vehicle": {"preset": "husky_a200"}}
    options = Options(out=tmp_path / "other", report=False, through="extract", overrides=overrides)
    power = analyze_log(log, options).manifest.read("power")
    np.testing.assert_allclose(power["current"], 5.0)
    np.testing.assert_allclose(power["energy_per_m"].drop_nulls(), 5.0 * 24.0 / 0.5, rtol=0.01)
