"""A vehicle that the log does not name is a guess: what names it first, how wide and where not used."""

import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from drawn_drives import DrawnDrive, record_cdr, record_twist, stamp_ros, write_drawn
from drawn_motion import GAIN, RADIUS, TRACK, draw

from pipeline.analysis import Options
from pipeline.logs import list_files, open_log
from pipeline.recording.log_choice import Choice, choose
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.recording.motion import Steps, fit, measure_spread
from pipeline.simulate import Recording, make_scenario, simulate_run, write_log
from pipeline.sources import Configuration, ConfigurationError, find_preset
from pipeline.words import format_finding

LOGS = Path(__file__).parents[2] / ".." / "shared" / "logs"
BURGER = "turtlebot3_burger"


def steps_of(seconds: float) -> Steps:
    start = np.arange(0.0, seconds, 0.1)
    return Steps(start, start + 0.1)


def draw_gains(rng: np.random.Generator, steps: Steps, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Increments of a drive whose gain of 2 is another one every ten seconds, and what explains them."""
    column = rng.normal(0.0, 0.1, steps.start.size)
    count = int(steps.end[-1] // 10.0)
    block = (count * steps.start / steps.end[-1]).astype(int)
    gains = 2.0 + spread * rng.standard_normal(count)
    return gains[block] * column, column


def test_another_block_of_the_drive_is_in_the_interval_as_often_as_is_said() -> None:
    rng, steps, hits, widths = np.random.default_rng(1), steps_of(80.5), [], []
    for _ in range(600):
        values, column = draw_gains(rng, steps, 0.2)
        gain = float(column @ values / (column @ column))
        width = measure_spread(values, column, gain, steps)
        hits.append(abs(2.0 + 0.2 * rng.standard_normal() - gain) < width)
        widths.append(width)
    assert 0.91 < np.mean(hits) < 0.98
    assert np.median(widths) == pytest.approx(2.36 * 0.2, rel=0.15)


def test_a_longer_drive_does_not_average_its_slip_out() -> None:
    rng = np.random.default_rng(2)
    spreads = {}
    for seconds in (100.5, 1600.5):
        steps = steps_of(seconds)
        values, column = draw_gains(rng, steps, 0.2)
        made = fit(values, column[:, None], steps)
        spreads[seconds] = made.spread
    assert 0.3 < spreads[1600.5] / spreads[100.5] < 1.5
    assert spreads[1600.5] == pytest.approx(1.96 * 0.2, rel=0.25)


def test_a_drive_that_is_driven_in_one_block_alone_has_no_interval() -> None:
    steps = steps_of(60.0)
    column = np.where(steps.start < 9.9, 0.1, 0.0)
    assert measure_spread(2.0 * column, column, 2.0, steps) == np.inf


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole recording that names its vehicle."""
    return record(tmp_path_factory.mktemp("named") / "a_named.mcap")


def record(path: Path, *, seed: int = 2, deployment: str = "written", **changes: object) -> Path:
    recorded = replace(Recording("tf"), deployment=deployment, **changes)  # type: ignore[arg-type]
    scenario = make_scenario(
        None, {"effective_track": 1.3}, seed=seed, duration_s=60.0, vehicle="turtlebot3", layout="tf"
    )
    write_log(simulate_run(replace(scenario, recording=recorded)), path)
    return path


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording without its end, which does not say which vehicle it is of."""
    path = record(tmp_path_factory.mktemp("cut") / "whole.mcap", seed=3, deployment="absent")
    content = path.read_bytes()
    return content[: int(0.9 * len(content))]


def set_up(log: Path, **overrides: object) -> LogSetup:
    return set_up_log(log, Options(out=log.parent / "results", overrides=overrides))


def tell(choice: Choice) -> dict[str, str]:
    return {one.id: format_finding(one) for one in choice.findings}


def test_a_recording_without_its_end_takes_the_vehicle_of_its_folder(
    named: Path, cut: bytes, tmp_path: Path
) -> None:
    (tmp_path / named.name).write_bytes(named.read_bytes())
    (tmp_path / "cut.mcap").write_bytes(cut)
    # What is no file is not opened: a pipe would wait for a writer.
    os.mkfifo(tmp_path / "d_pipe.mcap")
    (tmp_path / "b_link.mcap").symlink_to("d_pipe.mcap")
    (tmp_path / "b_dead.mcap").symlink_to("nowhere.mcap")
    (tmp_path / "b_device.mcap").symlink_to("/dev/zero")
    assert list_files(tmp_path) == [tmp_path / named.name, tmp_path / "cut.mcap"]
    setup = set_up(tmp_path / "cut.mcap")
    assert (setup.vehicle.id, setup.choice.vehicle_source) == (BURGER, "folder")
    assert setup.choice.to_json({})["vehicle_source"] == "folder"
    assert "vehicle_fitted" not in tell(setup.choice)
    assert f"as {named.name} of its folder" in tell(setup.choice)["vehicle_of_folder"]
    assert "--vehicle" in tell(setup.choice)["vehicle_of_folder"]
    # What the user says goes first.
    given = set_up(tmp_path / "cut.mcap", vehicle={"preset": "turtlebot3_waffle"})
    assert (given.vehicle.id, given.choice.vehicle_source) == ("turtlebot3_waffle", "flag")


def test_a_recording_without_its_end_is_fitted_where_nothing_beside_it_tells(
    named: Path, cut: bytes, tmp_path: Path
) -> None:
    (tmp_path / "cut.mcap").write_bytes(cut)
    alone = set_up(tmp_path / "cut.mcap")
    # Beside it are recordings with other topics, and others without an end.
    record(tmp_path / "other_topics.mcap", layout="husky_body_command")
    (tmp_path / "named_cut.mcap").write_bytes(named.read_bytes()[:-9])
    with_others = set_up(tmp_path / "cut.mcap")
    for setup in (alone, with_others):
        assert setup.choice.vehicle_source == "fitted"
        assert "vehicle_of_folder" not in tell(setup.choice)
    assert alone.vehicle == with_others.vehicle


def test_a_folder_of_several_vehicles_names_none(named: Path, cut: bytes, tmp_path: Path) -> None:
    (tmp_path / named.name).write_bytes(named.read_bytes())
    (tmp_path / "other.mcap").write_bytes(
        named.read_bytes().replace(b"turtlebot3_burger", b"turtlebot3_waffle")
    )
    (tmp_path / "cut.mcap").write_bytes(cut)
    setup = set_up(tmp_path / "cut.mcap")
    assert setup.choice.vehicle_source == "fitted"
    assert "name several" in tell(setup.choice)["vehicle_of_folder"]


def test_a_whole_recording_does_not_ask_its_folder(named: Path, tmp_path: Path) -> None:
    (tmp_path / named.name).write_bytes(named.read_bytes())
    setup = set_up(record(tmp_path / "b_whole.mcap", seed=3, deployment="absent"))
    assert setup.choice.vehicle_source == "fitted"


def test_what_is_fitted_stands_as_lines_of_run_toml(cut: bytes, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(cut)
    setup = set_up(tmp_path / "cut.mcap")
    fitted = setup.choice.to_json({})["vehicle_fitted"]
    assert isinstance(fitted, dict)
    lines = str(fitted["run_toml"])
    section = msgspec.convert(tomllib.loads(lines), Configuration).vehicle
    assert section.kind == "differential"
    for name, truth in (("wheel_radius_m", 0.033), ("track_width_m", 0.16)):
        one = fitted[name]
        assert isinstance(one, dict)
        low, value, high = (float(str(one[key])) for key in ("low", "value", "high"))
        assert low < truth < high
        assert getattr(section, name) == pytest.approx(value, rel=1e-3)
    (tmp_path / "cut.toml").write_text(lines, "utf-8")
    again = set_up(tmp_path / "cut.mcap")
    assert again.choice.vehicle_source == "configuration"
    assert again.vehicle.wheel_radius_m == section.wheel_radius_m
    assert "vehicle_fitted" not in again.choice.to_json({})


def slide(tmp_path: Path, share: float) -> Path:
    """A robot that covers a share of the distance that its wheels turn as commanded."""
    drive = draw(71)
    at, place = drive.rows, share * drive.place
    left, right = drive.wheels()
    asked = DrawnDrive(drive.time[at], *drive.asked[at].T, x=place.real, y=place.imag, yaw=drive.yaw)
    names = [["left_wheel_joint", "right_wheel_joint"]] * at.size
    speeds = [[float(one), float(other)] for one, other in zip(left[at], right[at], strict=True)]
    joints = stamp_ros(asked) | {"name": names, "velocity": speeds}
    pose = stamp_ros(asked) | asked.pose("pose.") | {"header.frame_id": "map"}
    return write_drawn(
        tmp_path / "log.mcap",
        record_twist(asked),
        record_cdr(asked, "/joint_states", "sensor_msgs/msg/JointState", joints),
        record_cdr(asked, "/lio/pose", "geometry_msgs/msg/PoseStamped", pose),
    )


def test_wheels_whose_radius_commands_and_poses_disagree_on_are_left_out(tmp_path: Path) -> None:
    log = slide(tmp_path, 0.3)
    choice = set_up(log).choice
    assert choice.sources.wheels is None
    assert choice.sources.command is not None
    said = tell(choice)["wheels_left_out"]
    shown = re.search(r"by the commands the wheel radius is ([\d.]+) m .*, by the poses ([\d.]+) m", said)
    assert [float(one) for one in shown.groups()] == pytest.approx([RADIUS, 0.3 * RADIUS], rel=0.01)
    assert "30 % of the distance" in said
    assert "--wheel-radius and --track-width, or --vehicle" in said
    given = set_up(log, vehicle={"wheel_radius_m": RADIUS, "track_width_m": TRACK})
    assert given.vehicle.wheel_radius_m == RADIUS


def test_a_vehicle_whose_commands_and_poses_agree_is_fitted(tmp_path: Path) -> None:
    setup = set_up(slide(tmp_path, 1.0))
    assert setup.choice.vehicle_source == "fitted"
    assert setup.vehicle.wheel_radius_m == pytest.approx(RADIUS, rel=0.01)
    assert setup.vehicle.track_width_m == pytest.approx(TRACK, rel=0.01)
    assert GAIN < 1.0
    text = tell(setup.choice)["vehicle_fitted"]
    assert "it is a guess" in text


def find_withheld(log: Path) -> Choice | None:
    """The choice for a log whose metadata are withheld; None where it is refused."""
    index = replace(open_log(log), metadata={})
    try:
        return choose(index, Configuration(), {})
    except ConfigurationError:
        return None


@pytest.mark.long
@pytest.mark.skipif(not LOGS.is_dir(), reason="the real recordings are not in ../shared/logs")
def test_the_radius_of_real_vehicles_is_in_its_interval() -> None:
    inside = {}
    for log in sorted(LOGS.glob("*.mcap")):
        chosen = find_withheld(log)
        error = 0.0 if chosen is None else chosen.vehicle.errors.get("wheel_radius_m", 0.0)
        if chosen is None or not error:
            continue
        truth = find_preset(open_log(log).deployment["vehicle"])
        inside[log.name] = abs(chosen.vehicle.wheel_radius_m - truth.wheel_radius_m) < 1.96 * error
    assert len(inside) >= 10
    assert sum(not one for one in inside.values()) <= 1, inside
