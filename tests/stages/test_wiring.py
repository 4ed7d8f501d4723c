"""Faults of the wiring: told before any effect is looked for, with the line that mends them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.recording import FAULTS
from pipeline.simulate import Imu, make_scenario, simulate_run, write_log
from pipeline.words import format_finding

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "data_samples" / "husky_tile.mcap"
LEFT, RIGHT = ('["front_left_wheel", "rear_left_wheel"]', '["front_right_wheel", "rear_right_wheel"]')


def exchange(section: str, topic: str) -> str:
    return f'[{section}]\ntopic = "{topic}"\nleft = {RIGHT}\nright = {LEFT}\n'


@pytest.mark.parametrize(
    ("text", "found", "line"),
    [
        (exchange("wheels", "/joint_states"), "wheels_corrected", "exchanged = true under [wheels]"),
        (
            '[wheels]\ntopic = "/joint_states"\nsign = -1\n',
            "configured_wrongly",
            "[wheels] in run.toml (or in a fleet.toml above it) gives sign = -1",
        ),
        (
            exchange("command", "/wheel_commands"),
            "command_reversed",
            "angular.z or of the steering is inverted",
        ),
        (
            '[command]\ntopic = "/controller/cmd_vel"\nsign = -1\n',
            "configured_wrongly",
            "[command] in run.toml (or in a fleet.toml above it) gives sign = -1",
        ),
        ("", "", ""),
    ],
)
def test_a_wrong_line_of_the_configuration_is_corrected_or_told(
    text: str, found: str, line: str, tmp_path: Path
) -> None:
    log = tmp_path / SAMPLE.name
    shutil.copy(SAMPLE, log)
    (tmp_path / "run.toml").write_text(text)
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False, diagnosis=False)).manifest
    vehicle, recording = read_recording(manifest)
    said = {f.id: format_finding(f) for f in recording.list_findings()}
    ours = {name for name in said if name in FAULTS or name.endswith("_corrected")}
    assert ours == ({found} if found else set())
    if found:
        assert line in said[found]
    if found in FAULTS:
        assert diagnose_runs([recording], vehicle).runs[0].effects == ()


def write_run(
    path: Path, layout: str, *, ned: bool = False, command: float = 1.0, gyro: float | None = None
) -> Path:
    """A drive whose poses are in north, east, down, or whose commanded yaw rate has another sign.

    Args:
        path: the log.
        layout: topics.
        ned: whether poses are in north, east, down.
        command: sign of the recorded angular.z.
        gyro: sign of the gyro, in place of encoders; None without one.
    """
    scenario = make_scenario(
        None, {"effective_track": 1.3}, seed=3, duration_s=60.0, vehicle="husky", layout=layout
    )
    imu = None if gyro is None else Imu(sign=1 if gyro > 0.0 else -1)
    encoders = scenario.encoders if gyro is None else None
    run = simulate_run(replace(scenario, imu=imu, encoders=encoders))
    run = replace(run, commands=replace(run.commands, turn=command * run.commands.turn))
    if ned:
        upright = np.array([1.0, -1.0, -1.0, 1.0])
        poses = replace(
            run.poses, position=run.poses.position * upright[:3], quaternion=run.poses.quaternion * upright
        )
        run = replace(run, poses=poses)
    write_log(run, path)
    return path


BOTH = ('up = "-z" under [pose] in run.toml', "the sign of angular.z")


@pytest.mark.parametrize(
    ("layout", "changes", "found", "words"),
    [
        ("body_command", {"ned": True}, "signs_contradict", BOTH),
        ("body_command", {"command": -1.0}, "signs_contradict", BOTH),
        ("husky_body_command", {"ned": True}, "pose_turned", ("as commands and wheels show", 'up = "-z"')),
        ("husky_body_command", {"command": -1.0}, "command_reversed", ("the sign of angular.z",)),
        (
            "husky_body_command",
            {"ned": True, "gyro": 1.0},
            "pose_turned",
            ("commands and the gyro", 'up = "-z"'),
        ),
        (
            "husky_body_command",
            {"command": -1.0, "gyro": 1.0},
            "command_reversed",
            ("the sign of angular.z",),
        ),
    ],
)
def test_poses_in_north_east_down_are_not_taken_for_a_wrong_command(
    layout: str, changes: dict[str, float], found: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    log = write_run(tmp_path / "run.mcap", layout, **changes)
    manifest = analyze_log(log, Options(out=tmp_path / "out", report=False, diagnosis=False)).manifest
    vehicle, recording = read_recording(manifest)
    findings = {one.id: format_finding(one) for one in recording.list_findings()}
    assert found in findings
    for word in words:
        assert word in findings[found]
    assert {name for name in findings if name in FAULTS} == ({found} & set(FAULTS))
    (run,) = diagnose_runs([recording], vehicle).runs
    if found in FAULTS:
        assert run.effects == ()
    if changes.get("ned"):
        if found in FAULTS:
            # The line that the finding gives mends it.
            (tmp_path / "run.toml").write_text('[pose]\nup = "-z"\n')
            options = Options(out=tmp_path / "mended", report=False, diagnosis=False)
            vehicle, recording = read_recording(analyze_log(log, options).manifest)
            assert not {one.id for one in recording.list_findings()} & set(FAULTS)
            (run,) = diagnose_runs([recording], vehicle).runs
        (effect,) = [one for one in run.effects if one.id == "effective_track"]
        assert effect.parameters["k"].value == pytest.approx(1.3, rel=0.02)
