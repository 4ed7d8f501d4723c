"""A log written anew with one thing changed: the same answer, or the change is told."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from few import few
from front import Answer, ask, find_roles, judge
from rewritten_logs import Change, Log, list_changes, read, write
from simulated_platforms import simulate_platform

from pipeline.analysis import Options
from pipeline.core import SlipError
from pipeline.recording.log_setup import set_up_log
from pipeline.sources import load_configuration
from pipeline.words import format_finding

ROOT = Path(__file__).parents[2]
CASES = ROOT / ".." / "shared" / "cases"
RECORDED = ROOT / ".." / "shared" / "logs" / "warthog_wheels_asphalt_2024_9_20_8h13s12.mcap"
CHANGES = {change.name: change for change in list_changes()}
# Wheel commands beside body commands, a car by its joints, a vehicle that nothing names, poses in transforms.
SAMPLES = ("husky_tile", "ackermann_gravel", "turtlebot4", "nav2")
QUICK = {
    ("husky_tile", "an arm beside the wheels"),
    ("husky_tile", "poses turned by 90 degrees"),
    ("husky_tile", "right wheels reversed"),
    ("husky_tile", "clock back by 10 s"),
    ("nav2", "clock back by 10 s"),
    ("ackermann_gravel", "both encoders backward"),
    ("husky_tile", "left encoder dies"),
    ("husky_tile", "pivots about the left wheels"),
    ("turtlebot4", "nothing but such pivots"),
    ("turtlebot4", "right encoder holds"),
    ("husky_tile", "poses in JSON"),
    ("husky_tile", "wheels in rpm"),
    ("husky_tile", "a measured twist beside"),
    ("husky_tile", "sides exchanged"),
    ("turtlebot4", "yaw rate in degrees"),
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Log, Answer]]:
    """Each log as it is, with its answer."""
    made = {}
    for name in SAMPLES:
        path = ROOT / "data_samples" / f"{name}.mcap"
        if not path.exists():
            path = tmp_path_factory.mktemp("drawn") / f"{name}.mcap"
            simulate_platform(name, {}, out=path, seed=5, duration_s=100.0)
        made[name] = (path, read(path), ask(path))
    return made


def write_changed(path: Path, log: Log, change: str, folder: Path) -> Path:
    """A log with a change that it allows."""
    made = CHANGES[change].make(log, find_roles(path))
    assert made is not None
    return write(made, folder / path.name)


def check(logs: dict[str, tuple[Path, Log, Answer]], name: str, change: Change, folder: Path) -> None:
    path, log, before = logs[name]
    made = change.make(log, find_roles(path))
    if made is None:
        pytest.skip("this log has nothing to change so")
    after = ask(write(made, folder / path.name))
    assert judge(change, before, after) != "WRONG", after


@pytest.mark.parametrize(("name", "change"), few(sorted(QUICK), 4))
def test_a_changed_log_gives_the_same_answer_or_tells(
    logs: dict[str, tuple[Path, Log, Answer]], name: str, change: str, tmp_path: Path
) -> None:
    check(logs, name, CHANGES[change], tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "line"),
    few(
        [
            ("husky_tile", "right wheels reversed", '[wheels]\nreversed = "right"'),
            ("husky_tile", "both encoders backward", "[wheels]\nsign = -1"),
            ("husky_tile", "sides exchanged", "[wheels]\nexchanged = true"),
            ("husky_tile", "wheels in rpm", '[wheels]\nunit = "rpm"'),
            ("turtlebot4", "yaw rate in degrees", '[command]\nyaw_unit = "deg/s"'),
            ("husky_tile", "poses turned by 90 degrees", "[pose]\nheading_deg = -90"),
        ],
        3,
    ),
)
def test_the_line_that_is_offered_settles_it(
    logs: dict[str, tuple[Path, Log, Answer]], name: str, change: str, line: str, tmp_path: Path
) -> None:
    path, log, _ = logs[name]
    changed = write_changed(path, log, change, tmp_path)
    (tmp_path / "line.toml").write_text(line)
    found, settled = (
        set_up_log(changed, Options(out=tmp_path, config=config)).choice
        for config in (None, tmp_path / "line.toml")
    )
    codes = {"wheels_corrected", "command_corrected", "pose_turned", "signs_contradict"}
    told = [format_finding(one) for one in found.findings if one.id in codes]
    assert line.split("\n")[1] in " ".join(told)
    assert not [format_finding(one) for one in settled.findings if one.id in codes]
    for choice in (found, settled):
        roles = {one.role for one in choice.recording.evidence}
        assert roles >= {"command", "wheels"}


@pytest.mark.parametrize(
    ("name", "change"),
    few(
        [
            ("husky_tile", "both encoders backward"),
            ("husky_tile", "right wheels reversed"),
            ("husky_tile", "sides exchanged"),
            ("husky_tile", "left encoder counts double"),
            ("husky_tile", "poses turned by 90 degrees"),
            ("husky_tile", "wheels in rpm"),
            ("turtlebot4", "yaw rate in degrees"),
        ],
        3,
    ),
)
def test_the_line_that_takes_them_as_recorded_is_obeyed(
    logs: dict[str, tuple[Path, Log, Answer]], name: str, change: str, tmp_path: Path
) -> None:
    path, log, _ = logs[name]
    changed = write_changed(path, log, change, tmp_path)
    first = set_up_log(changed, Options(out=tmp_path)).choice.findings
    (told,) = [one for one in first if one.values.get("kind") == "corrected"]
    (line,) = told.values["otherwise"]
    assert f"{line} takes them as recorded" in format_finding(told)
    (tmp_path / "line.toml").write_text(f"[{told.where}]\n{line}")
    options = Options(out=tmp_path, config=tmp_path / "line.toml")
    kept = set_up_log(changed, options).choice
    assert not [one for one in kept.findings if one.values.get("kind") == "corrected"]
    assert not [format_finding(one) for one in kept.findings if one.severity == "error"]
    assert kept.recording.configuration == load_configuration(changed, given=options.config)


def test_of_two_faults_both_are_corrected(logs: dict[str, tuple[Path, Log, Answer]], tmp_path: Path) -> None:
    path, log, _ = logs["husky_tile"]
    roles = find_roles(path)
    for name in ("poses turned by 90 degrees", "right wheels reversed"):
        made = CHANGES[name].make(log, roles)
        assert made is not None
        log = made
    choice = set_up_log(write(log, tmp_path / path.name), Options(out=tmp_path)).choice
    assert choice.recording.configuration.wheels.reversed == "right"
    assert choice.recording.configuration.pose.heading_deg == pytest.approx(-90.0)


def test_a_tape_is_compared_with_what_is_corrected(
    logs: dict[str, tuple[Path, Log, Answer]], tmp_path: Path
) -> None:
    path, log, _ = logs["husky_tile"]
    told = []
    for one in (path, write_changed(path, log, "wheels in rpm", tmp_path)):
        options = Options(out=tmp_path, overrides={"truth": {"distance_m": 5.0}})
        told += [
            [each.values["value"], each.values["radius_m"]]
            for each in set_up_log(one, options).choice.findings
            if each.id == "tape_contradicts_vehicle"
        ]
    assert len(told) == 2
    assert told[0] == pytest.approx(told[1], rel=1e-3)


def test_a_unit_that_the_user_gives_is_not_decided_otherwise(
    logs: dict[str, tuple[Path, Log, Answer]], tmp_path: Path
) -> None:
    path, log, _ = logs["turtlebot4"]
    changed = write_changed(path, log, "yaw rate in degrees", tmp_path)
    (tmp_path / "line.toml").write_text('[command]\nyaw_unit = "rad/s"')
    options = Options(out=tmp_path, config=tmp_path / "line.toml")
    choice = set_up_log(changed, options).choice
    assert choice.recording.configuration.command.yaw_unit == "rad/s"
    assert not [one for one in choice.findings if one.severity == "error"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "change"),
    [(name, change) for name in SAMPLES for change in CHANGES if (name, change) not in QUICK],
)
def test_every_change_gives_the_same_answer_or_is_told(
    logs: dict[str, tuple[Path, Log, Answer]], name: str, change: str, tmp_path: Path
) -> None:
    check(logs, name, CHANGES[change], tmp_path)


def load_cases() -> ModuleType | None:
    """What must be said of each case, if the cases are here."""
    if not (CASES / "cases.py").exists():
        return None
    sys.path.insert(0, str(CASES))
    try:
        spec = importlib.util.spec_from_file_location("field_cases", CASES / "cases.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(CASES))
    return module


PROGRESS = re.compile(r": (reading the log|\w+ing |Ground|Drive|Effects)")
# Of these the examination alone says what must be said, before any effect is looked for.
TOLD = {
    "heading_offset": "90 degrees",
    "y_up": "the y axis of the poses",
    "optical": "optical",
    "lidar_backwards": "to the rear",
    "lidar_backwards_cmd": "frame",
    "wheels_numbered": "wheel_1",
    "steer_inverted": "inverted",
    "flipped_joints": "polarity",
    "cmd_degrees": "deg/s",
    "stale_odom": "wheel odometry, not a localization",
    "mavros": "setpoint_velocity",
    "rpm_floats": "rpm",
}


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not here")
@pytest.mark.parametrize("name", few(sorted(TOLD), 4))
def test_a_case_of_the_field_is_told(name: str, tmp_path: Path) -> None:
    log = CASES / "logs" / f"{name}.mcap"
    setup = set_up_log(log, Options(out=tmp_path))
    assert TOLD[name] in " ".join(format_finding(one) for one in setup.choice.findings)


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not here")
def test_joints_that_are_not_there_are_the_reason(tmp_path: Path) -> None:
    (tmp_path / "joints.toml").write_text('[wheels]\nleft = ["no_such"]\nright = ["nor_this"]')
    options = Options(out=tmp_path, config=tmp_path / "joints.toml")
    with pytest.raises(SlipError) as refused:
        set_up_log(CASES / "logs" / "y_up.mcap", options)
    assert "left under [wheels] names no_such" in refused.value.what
    assert "radius" not in str(refused.value)


@pytest.mark.long
@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not here")
def test_cases_of_the_field_say_what_they_must(tmp_path: Path) -> None:
    from verbs import run_slip  # noqa: PLC0415

    cases = load_cases()
    wrong = []
    for name, (_, _, must, never, args, config) in cases.CASES.items():
        log = CASES / "logs" / f"{name}.mcap"
        given = ["--config", str(log.with_suffix(".toml"))] if config else []
        _, said, told = run_slip("diagnose", log, *args, *given, "--results", tmp_path / name)
        lines = [line for line in (said + told).splitlines() if not PROGRESS.search(line)]
        text = re.sub(r"\s+", " ", " ".join(lines))
        if not re.search(must, text) or (never and re.search(never, text)):
            wrong.append(name)
    assert len(wrong) <= 2, wrong


@pytest.mark.long
@pytest.mark.skipif(not RECORDED.exists(), reason="../shared/logs is not here")
@pytest.mark.parametrize("change", ["pivots about the left wheels", "nothing but such pivots"])
def test_a_recording_of_pivots_has_no_dead_encoder(change: str, tmp_path: Path) -> None:
    """Between long rests, on ground where wheels slip aside."""
    after = ask(write_changed(RECORDED, read(RECORDED), change, tmp_path))
    assert after.medians
    assert judge(CHANGES[change], ask(RECORDED), after) == "same"
