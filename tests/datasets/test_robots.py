"""Runs of several robots of one type are pooled with a note that names the robots and what separates them."""

from pathlib import Path

import pytest
from comparison_store import Run, write_run

from pipeline.datasets import Question, compare_results, note_robots
from pipeline.store import Store

Configuration = dict[str, dict[str, object]]


def drive(
    path: str, *topics: str, configuration: Configuration | None = None, vehicle: str = "warthog"
) -> Run:
    """A run with the topics of its command, wheels and pose."""
    roles = dict(zip(("command", "wheels", "pose"), topics, strict=False))
    return Run(
        name=path.removesuffix(".mcap"), path=f"/season/{path}", vehicle=vehicle, seconds=6.0, topics=roles,
        configuration=configuration or {},
    )  # fmt: skip


def in_space(path: str, space: str, configuration: Configuration | None = None) -> Run:
    return drive(
        path, f"{space}/cmd_vel", f"{space}/joint_states", f"{space}/odom", configuration=configuration
    )


def find_notes(tmp_path: Path, *runs: Run) -> list[str]:
    store = Store(tmp_path)
    return note_robots([write_run(store, run) for run in runs])


SEVERAL = {
    "namespaces, a folder each": (
        (in_space("r1/a.mcap", "/bot1"), in_space("r1/b.mcap", "/bot1"), in_space("b2/c.mcap", "/bot2")),
        ("topics name 2: bot1 in r1/a and r1/b; bot2 in b2/c", "In /season/fleet.toml",
         '[[match]] glob = "r1/*", vehicle.name = "bot1"', '[[match]] glob = "b2/*", vehicle.name = "bot2"'),
    ),
    "namespaces, one folder, names of files": (
        (in_space("bob_1.mcap", "/x/bob"), in_space("bob_2.mcap", "/x/bob"), in_space("eve.mcap", "/x/eve")),
        ('glob = "bob_*", vehicle.name = "x_bob"', 'glob = "eve.mcap", vehicle.name = "x_eve"'),
    ),
    "namespaces, one folder, dates": (
        (in_space("1.mcap", "/ugv1"), in_space("2.mcap", "/ugv2"), in_space("3.mcap", "/ugv1")),
        ('glob = "1.mcap", vehicle.name = "ugv1" (and one for each of 1 more log)',
         'glob = "2.mcap", vehicle.name = "ugv2"; '),
    ),
    "serial numbers, and poses of all": (
        (drive("a.mcap", "/w200_0011/cmd_vel", "/joint_states", "/slam/odom"),
         drive("b.mcap", "/w200_0012/cmd_vel", "/joint_states", "/slam/odom")),
        ("w200_0011 in a; w200_0012 in b",),
    ),
    "prefixes of frames": (
        (drive("a.mcap", "/cmd_vel", "/joints", "/tf (map -> robot1/base_link)"),
         drive("b.mcap", "/cmd_vel", "/joints", "/tf (map -> robot2/base_link)")),
        ("robot1 in a; robot2 in b",),
    ),
    "folders": (
        (drive("warthog_7/ice/a.mcap", "/cmd_vel"), drive("warthog_9/ice/b.mcap", "/cmd_vel")),
        ("folders name 2: warthog_7 in", 'glob = "warthog_7/*", vehicle.name = "warthog_7"'),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", SEVERAL)
def test_robots_of_one_vehicle_are_named_with_the_lines_that_separate_them(kind: str, tmp_path: Path) -> None:
    runs, parts = SEVERAL[kind]
    (note,) = find_notes(tmp_path, *runs)
    assert note.startswith("runs of warthog count as those of one robot, and their ")
    assert [part for part in parts if part not in note] == []


def name(robot: str) -> Configuration:
    return {"vehicle": {"name": robot, "kind": None}}


ONE = {
    "one namespace": (in_space("a.mcap", "/robot1"), in_space("b.mcap", "/robot1")),
    "with and without a namespace": (in_space("a.mcap", "/robot1"), in_space("b.mcap", "")),
    "namespaces of parts": (
        drive("a.mcap", "/controller/cmd_vel", "/drive/joints", "/mapping/odom"),
        drive("b.mcap", "/nav/cmd_vel", "/drive/joints", "/ekf/odom"),
    ),
    "a motor a side": (
        drive("a.mcap", "/motor1/rpm, /motor2/rpm", "/joints", "/odom"),
        drive("b.mcap", "/motor1/rpm, /motor2/rpm", "/joints", "/odom"),
    ),
    "sensors that are numbered": (
        drive("a.mcap", "/cmd_vel", "/joints", "/lidar1/odom"),
        drive("b.mcap", "/cmd_vel", "/joints", "/lidar2/odom"),
    ),
    "two vehicles": (
        in_space("a.mcap", "/robot1"),
        drive("b.mcap", "/robot2/cmd_vel", "", "/robot2/odom", vehicle="husky"),
    ),
    "the same name is given": (
        in_space("a.mcap", "/robot1", name("warthog")),
        in_space("b.mcap", "/robot2", name("warthog")),
    ),
    "folders of days, years and terrains": (
        drive("2026-07-30/warthog_2025/ice_1/a.mcap", "/cmd_vel"),
        drive("2026-07-31/warthog_2026/ice_2/b.mcap", "/cmd_vel"),
    ),
}


@pytest.mark.parametrize("kind", ONE)
def test_one_robot_is_not_said_to_be_several(kind: str, tmp_path: Path) -> None:
    assert find_notes(tmp_path, *ONE[kind]) == []


def test_every_answer_over_runs_begins_with_it(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for run in (in_space("a.mcap", "/robot1"), in_space("b.mcap", "/robot2")):
        write_run(store, run)
    assert "[[match]]" in compare_results(store, Question()).notes[0]
