"""Runs of one vehicle whose logs were corrected in different ways are told by every verb of many runs."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from comparison_store import Run, write_run

from pipeline.datasets import Question, compare_results, find_material
from pipeline.datasets.trend import follow_trend
from pipeline.recording import Finding
from pipeline.store import Store

JOINTS = {"wheels": "/joint_states", "command": "/cmd_vel", "pose": "/mocap"}


def correct(section: str, line: str, **changed: object) -> tuple[Finding, dict[str, dict[str, object]]]:
    """The finding of a correction, and the configuration that it makes."""
    name = "pose_turned" if section == "pose" else f"{section}_corrected"
    return Finding(name, "warning", section, {"kind": "corrected", "line": line}), {section: changed}


def drive(name: str, *made: tuple[Finding, dict[str, dict[str, object]]], **others: object) -> Run:
    """A run with corrections; without one as recorded."""
    sections: dict[str, dict[str, object]] = {}
    for _, change in made:
        for section, keys in change.items():
            sections.setdefault(section, {}).update(keys)
    noted = [finding for finding, _ in made]
    return replace(
        Run(name=name, seconds=6.0, topics=JOINTS, noted=noted, configuration=_complete(sections)),
        **others,  # type: ignore[arg-type]
    )


def _complete(sections: Mapping[str, Mapping[str, object]]) -> dict[str, dict[str, object]]:
    usual: dict[str, dict[str, object]] = {
        "wheels": {"sign": 1, "exchanged": False, "factors": None, "scale": None, "unit": None},
        "command": {"late_s": None, "time": None, "unit": None, "yaw_unit": None},
        "pose": {"heading_deg": None, "up": None},
        "imu": {"unit": None},
    }
    return {name: {**keys, **sections.get(name, {})} for name, keys in usual.items()}


BACKWARD = correct("wheels", "sign = -1", sign=-1)


def find_notes(tmp_path: Path, *runs: Run) -> tuple[str, ...]:
    store = Store(tmp_path)
    for run in runs:
        write_run(store, run)
    return find_material(store, ("vehicle",), trusted_only=True).notes


def test_runs_that_were_corrected_differently_are_told_first_with_their_lines(tmp_path: Path) -> None:
    store = Store(tmp_path)
    damaged = Run(name="damaged", seconds=6.0, findings=[("not_moving", "error", 0.01)])
    for run in (drive("a", BACKWARD), drive("b"), drive("c", BACKWARD), drive("d"), damaged):
        write_run(store, run)
    for notes in (compare_results(store, Question()).notes[1:], follow_trend(store, ("vehicle",)).notes[1:]):
        assert "runs of warthog (/joint_states) are read in different ways" in notes[0]
        assert "sign = -1 in a and c; as recorded in b and d" in notes[0]
        assert "under [wheels] in the run.toml of the others, or in fleet.toml" in notes[0]
        assert sum("different ways" in note for note in notes) == 1


ALIKE = {
    "all are corrected": (drive("a", BACKWARD), drive("b", BACKWARD)),
    "the others have the line": (
        drive("a", BACKWARD),
        drive("b", configuration=_complete({"wheels": {"sign": -1}})),
    ),
    "another vehicle": (drive("a", BACKWARD), drive("b", vehicle="husky")),
    "another topic": (drive("a", BACKWARD), drive("b", topics={**JOINTS, "wheels": "/odom"})),
    "no wheels": (drive("a", BACKWARD), drive("b", topics={"command": "/cmd_vel"})),
    "a clock": (
        drive("a", correct("command", "late_s = 0.2", late_s=0.2)),
        drive("b", correct("command", 'time = "log"', time="log")),
    ),
    "measured scales that agree": (
        drive("a", correct("wheels", "scale = 0.031", scale=0.031)),
        drive("b", correct("wheels", "scale = 0.033", scale=0.033)),
    ),
    "nothing is corrected, and the user says something": (
        drive("a", configuration=_complete({"wheels": {"sign": -1}})),
        drive("b"),
    ),
    "left out by an error": (drive("a", BACKWARD), drive("b", findings=[("wheel_dead", "error", None)])),
}


@pytest.mark.parametrize("kind", ALIKE)
def test_runs_that_could_not_differ_are_not_told(kind: str, tmp_path: Path) -> None:
    assert not [note for note in find_notes(tmp_path, *ALIKE[kind]) if "different" in note]


APART = {
    "gear of a joint": (
        (correct("wheels", 'factors = {"left" = -0.5}', factors={"left": -0.5}),),
        (correct("wheels", 'factors = {"right" = 0.5}', factors={"right": 0.5}),),
        'factors = {"left" = -0.5} in a; factors = {"right" = 0.5} in b',
    ),
    "unit": (
        (correct("imu", 'unit = "deg/s"', unit="deg/s"),),
        (),
        'unit = "deg/s" in a; as recorded in b',
    ),
    "opposite frames": (
        (correct("pose", "heading_deg = 90", heading_deg=90.0),),
        (correct("pose", "heading_deg = -90", heading_deg=-90.0),),
        "heading_deg = 90 in a; heading_deg = -90 in b",
    ),
    "two keys": (
        (correct("wheels", "sign = -1, exchanged = true", sign=-1, exchanged=True),),
        (BACKWARD,),
        "exchanged = true and sign = -1 in a; sign = -1 in b",
    ),
}


@pytest.mark.parametrize("kind", APART)
def test_what_differs_is_said_as_lines_of_run_toml(kind: str, tmp_path: Path) -> None:
    one, other, said = APART[kind]
    topics = {**JOINTS, "imu": "/imu"}
    (note,) = find_notes(tmp_path, drive("a", *one, topics=topics), drive("b", *other, topics=topics))
    assert said in note


def see(name: str, angle: float, half: float, pose: str = "/mocap") -> Run:
    values = {"value": 0.0, "heading_deg": angle, "half_deg": half, "pose": pose}
    return drive(name, noted=[Finding("pose_angle", "info", "pose", values)])


def test_angles_and_places_of_poses_are_told_where_their_intervals_are_far_apart(tmp_path: Path) -> None:
    runs = [see("a", -3.3, 1.1), see("b", 2.6, 1.0), see("c", 4.0, 0.7), drive("d")]
    (note,) = find_notes(tmp_path / "apart", *runs)
    assert "different angles to the headings of its poses: -3.3 degrees (±1.1) in a to 4 degrees" in note
    assert "correct no run by its own" in note
    assert not find_notes(tmp_path / "near", see("a", 1.0, 1.1), see("b", 3.2, 1.0))
    assert not find_notes(tmp_path / "topics", see("a", -3.3, 1.1), see("b", 4.0, 0.7, pose="/lidar"))
    levers = [
        drive(name, noted=[Finding("pose_lever", "info", "pose", {"value": v, "half_m": 0.01, "pose": "/p"})])
        for name, v in (("a", 0.1), ("b", -0.1))
    ]
    (note,) = find_notes(tmp_path / "levers", *levers)
    assert "at different distances behind that of its poses: -0.1 m (±0.01) in b to 0.1 m" in note


def test_results_of_a_version_without_values_or_summary_say_nothing(tmp_path: Path) -> None:
    assert not find_notes(
        tmp_path, Run(name="a", seconds=6.0, findings=[("wheels_corrected", "warning", None)]), drive("b")
    )
