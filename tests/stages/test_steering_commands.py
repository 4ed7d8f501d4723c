"""Twist of a car whose angular.z is a steering angle, as some drivers of Ackermann vehicles take it."""

import re
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import STEP, Drive
from written_logs import write_log as write_drawn

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core.untrusted import number_in
from pipeline.recording.log_setup import set_up_log
from pipeline.simulate import (
    LAYOUTS,
    VEHICLES,
    Disturbance,
    Layout,
    Program,
    Recording,
    Scenario,
    simulate_run,
    write_log,
)
from pipeline.simulate.messages import twist
from pipeline.simulate.scenario import Commands
from pipeline.sources import find_preset
from pipeline.store import Manifest
from pipeline.words import format_finding

_LAYOUT = Layout("ackermann", (twist("/cmd_vel", stamped=True), *LAYOUTS["ackermann"].topics[2:]))
_TOLD = "holds steering angles in place of yaw rates"


def analyze(log: Path, results: Path) -> Manifest:
    return analyze_log(log, Options(out=results, report=False, diagnosis=False)).manifest


def find_fault(manifest: Manifest) -> str:
    texts = [str(one["text"]) for one in manifest.read("findings").to_dicts() if _TOLD in str(one["text"])]
    return "".join(texts)


def read_median(manifest: Manifest) -> float:
    median = number_in(manifest.read_json("summary.json"), "median_modulus")
    assert median is not None
    return median


def drive(program: str, log: Path, effects: dict[str, float]) -> Path:
    scene = Scenario(
        vehicle=VEHICLES["car"],
        program=Program(program),  # type: ignore[arg-type]
        duration_s=90.0,
        seed=3,
        effects=effects,
        disturbance=Disturbance(0.03, 0.05),
        recording=Recording(_LAYOUT),
    )
    log.parent.mkdir()
    write_log(simulate_run(scene), log)
    return log


@pytest.mark.parametrize(
    ("program", "effects", "is_told"),
    [
        ("drive_steps", {"drive_lag": 0.4, "steering_lag": 0.3}, True),
        ("teleop", {}, True),
        ("smooth", {"understeer": 0.03}, True),
        # At one speed a yaw rate is a multiple of a small angle: nothing tells them apart.
        ("circle", {}, False),
    ],
)
def test_steering_angles_in_place_of_yaw_rates_are_told_with_the_lines_that_mend_it(
    program: str, effects: dict[str, float], *, is_told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_rates = analyze(drive(program, tmp_path / "rates" / "run.mcap", effects), tmp_path / "out")
    assert find_fault(true_rates) == ""
    monkeypatch.setattr(Commands, "yaw_rate", lambda commands, _vehicle: commands.turn)
    log = drive(program, tmp_path / "angles" / "run.mcap", effects)
    made = analyze(log, tmp_path / "out")
    text = find_fault(made)
    assert bool(text) is is_told
    if not is_told:
        return
    lines = re.findall(r'\w+ = "[^"]+"', text)
    assert lines == [
        'speed_topic = "/cmd_vel.twist.linear.x"',
        'steering_topic = "/cmd_vel.twist.angular.z"',
    ]
    log.with_name("run.toml").write_text("[command]\n" + "\n".join(lines) + "\n")
    mended = analyze(log, tmp_path / "out")
    assert find_fault(mended) == ""
    medians = [read_median(one) for one in (made, mended, true_rates)]
    assert medians[:2] == pytest.approx([medians[2]] * 2, rel=0.02)


@pytest.mark.parametrize(("holds_angles", "is_told"), [(False, False), (True, True)])
def test_yaw_rates_beyond_the_largest_steering_are_no_angles(
    *, holds_angles: bool, is_told: bool, tmp_path: Path
) -> None:
    """A turn at full lock is proportional to the speed, too, where the stick asks for a tighter one."""
    car, draw = find_preset("ackermann_car"), np.random.default_rng(5)
    times = np.arange(0.0, 240.0, STEP)
    speed = np.repeat(draw.uniform(0.5, 5.0, 60), 400)
    asked = np.repeat(draw.uniform(-0.8, 0.8, 60), 400) * (0.4 if holds_angles else 1.0)
    wheelbase = car.wheelbase_m or 1.0
    angle = asked if holds_angles else np.arctan(wheelbase * asked / speed)
    turned = speed * np.tan(np.clip(angle, -0.33, 0.33)) / wheelbase
    yaw = np.cumsum(turned) * STEP
    place = np.cumsum(speed * np.exp(1j * yaw)) * STEP
    rows = np.arange(0, times.size, 10)
    noise = draw.normal(0.0, 0.002, (3, rows.size))
    commands = np.column_stack((speed, asked))
    seen = place[rows] + noise[0] + 1j * noise[1]
    drive = Drive(times, commands, speed, turned, seen, yaw[rows] + noise[2], rows)
    log = write_drawn(tmp_path / "log.mcap", drive, is_measured=False)
    setup = set_up_log(log, Options(out=tmp_path, overrides={"vehicle": {"preset": "ackermann_car"}}))
    assert any(_TOLD in format_finding(one) for one in setup.choice.findings) is is_told
