"""Logs without any pose: commands and measured wheels show the drivetrain, and nothing of the ground."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import polars as pl
import pytest
from few import few
from stage_logs import PLAIN
from verbs import print_verb, run_slip, run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.datasets.compared_runs import find_material
from pipeline.estimation import DiagnosisInput as Diagnosed
from pipeline.estimation import choose_input, diagnose_runs, load_recording
from pipeline.estimation.stored_diagnosis import read_diagnosis
from pipeline.logs import open_log, read_topics
from pipeline.logs.writer import LogWriter
from pipeline.models import find_effect
from pipeline.models.effect import Place
from pipeline.run.signals import GROUND_UNOBSERVABLE
from pipeline.simulate import Encoders, Recording, Scenario, make_scenario, simulate_run, write_log
from pipeline.simulate.facts import find_layout
from pipeline.simulate.messages import list_topics
from pipeline.sources import find_preset
from pipeline.store import Manifest, Store
from pipeline.words import format_finding
from pipeline.words.objects import diagnosis_as_json
from pipeline.words.verdict import NO_GROUND

CASES = Path(__file__).parents[3] / "shared" / "cases" / "logs"
EFFECTS = {"drive_lag": 0.3, "effective_track": 1.8, "lateral_skid": 0.3}
"""A lag of the drive on slippery ground."""
POSES = {"localization", "tracking", "relocalization"}
STAMPS = 1_700_000_000_000_000_000 + np.arange(600) * 50_000_000


def make(
    layout: str = "tf",
    vehicle: str = "turtlebot3",
    effects: dict[str, float] = EFFECTS,
    *,
    is_named: bool = False,
    encoders: Encoders | None = None,
) -> Scenario:
    scenario = make_scenario(None, effects, seed=3, duration_s=80.0, vehicle=vehicle)
    recording = Recording(layout, deployment="written" if is_named else "absent")
    return replace(scenario, recording=recording, encoders=encoders or scenario.encoders)


def record(scenario: Scenario, path: Path) -> Path:
    """The log of a scenario without its poses."""
    layout = find_layout(scenario.recording.layout, scenario.vehicle)
    topics = tuple(one for one in list_topics(layout, scenario) if one.source not in POSES)
    recording = replace(scenario.recording, layout=replace(layout, topics=topics))
    write_log(simulate_run(replace(scenario, recording=recording)), path)
    return path


@dataclass(frozen=True)
class Analyzed:
    """A log with its results."""

    log: Path
    results: Path
    manifest: Manifest
    summary: dict[str, Any]

    @property
    def diagnosis(self) -> dict[str, Any]:
        diagnosis = read_diagnosis(self.manifest)
        assert diagnosis is not None
        return diagnosis_as_json(diagnosis)

    @property
    def named(self) -> dict[str, dict[str, Any]]:
        return {one["id"]: one["parameters"] for one in self.diagnosis["effects"]}

    @property
    def findings(self) -> dict[str, str]:
        return {one["id"]: one["text"] for one in self.summary["findings"]}


def analyze(log: Path, results: Path) -> Analyzed:
    outcome = analyze_log(log, Options(out=results, diagnosis=True))
    return Analyzed(log, results, outcome.manifest, cast("dict[str, Any]", outcome.summary))


@pytest.fixture(scope="module")
def unknown(tmp_path_factory: pytest.TempPathFactory) -> Analyzed:
    """A log of a vehicle that nothing identifies."""
    folder = tmp_path_factory.mktemp("drive_alone")
    return analyze(record(make(), folder / "run.mcap"), folder / "results")


def contains(number: dict[str, Any], truth: float) -> bool:
    return bool(number["low"] <= truth <= number["high"])


def list_ids(diagnosis: dict[str, Any]) -> set[str]:
    """Every effect that a diagnosis mentions."""
    ids = {one["id"] for one in diagnosis["effects"]}
    ids |= {name for one in diagnosis["undecided"] for name in one["candidates"]}
    ids |= {name for one in diagnosis["effects"] for name in one.get("equivalent_to", ())}
    return ids | {one["effect"] for one in diagnosis["detectable"]}


def test_the_lag_is_recovered_and_nothing_of_the_ground_is_named(unknown: Analyzed) -> None:
    assert [*unknown.named] == ["drive_lag"]
    assert contains(unknown.named["drive_lag"]["tau"], 0.3)
    assert unknown.named["drive_lag"]["tau"]["value"] == pytest.approx(0.3, abs=0.005)
    for name in list_ids(unknown.diagnosis):
        effect = find_effect(name)
        assert effect is not None
        assert effect.place <= Place.DRIVE, name


def test_every_face_says_that_the_ground_is_not_observable(unknown: Analyzed) -> None:
    assert "the ground does is not observable" in unknown.findings[GROUND_UNOBSERVABLE]
    assert NO_GROUND[1:] in unknown.summary["verdict"]
    assert not re.search(r"turns at|skid|slid|radius|track", unknown.summary["verdict"])
    page = (unknown.manifest.folder / "report.html").read_text("utf-8")
    assert NO_GROUND[1:] in page
    assert "no pose is recorded" in page
    screen = print_verb("analyze", unknown.log, "--results", unknown.results)
    assert "of the drivetrain, not of the ground, 0.0" in screen


def test_the_geometry_is_that_of_the_controller(unknown: Analyzed) -> None:
    vehicle = unknown.manifest.part("vehicle")
    assert vehicle["wheel_radius_m"] == pytest.approx(0.033, rel=0.01)
    assert vehicle["track_width_m"] == pytest.approx(0.16, rel=0.01)
    assert "its controller turns commands into wheel speeds" in unknown.findings["vehicle_fitted"]


def test_inspect_shows_the_choice(unknown: Analyzed) -> None:
    screen = print_verb("inspect", unknown.log)
    assert re.search(r"pose +/joint_states +no pose is recorded: the motion of the wheels stands in", screen)
    assert "problem" not in screen


def test_such_a_run_is_compared_with_no_other(unknown: Analyzed) -> None:
    for trusted_only in (False, True):
        compared = find_material(
            Store(unknown.results), ("dataset",), trusted_only=trusted_only, tables=("aggregates",)
        )
        assert not compared.manifests
        assert "its log holds no pose" in compared.notes[0]
    assert unknown.manifest.read("aggregates").height
    code, _, said = run_slip("compare", "--results", unknown.results)
    assert code
    assert "its log holds no pose, and its slip is not that of the ground" in said


def test_runs_with_and_without_a_pose_are_not_judged_together(unknown: Analyzed, tmp_path: Path) -> None:
    write_log(simulate_run(make()), tmp_path / "whole.mcap")
    whole = analyze_log(tmp_path / "whole.mcap", Options(out=tmp_path / "results"))
    names = ("poses", "alignments", "commands", "slip", "findings")
    both = [
        Diagnosed(name, {table: manifest.read(table) for table in names})
        for name, manifest in (("alone", unknown.manifest), ("whole", whole.manifest))
    ]
    vehicle = find_preset("turtlebot3_burger")
    assert vehicle is not None
    judged, left_out = diagnose_runs(both, vehicle, inputs=("command",)).runs
    assert (judged.run, judged.joint, bool(judged.ladder)) == ("whole", ("whole",), True)
    assert (left_out.run, left_out.ladder) == ("alone", ())
    assert "left out: the log holds no pose, so that only its drivetrain" in format_finding(
        left_out.findings[0]
    )
    alone, other = (load_recording(one, vehicle) for one in both)
    ground = [effect for name in ("effective_track", "drive_lag") if (effect := find_effect(name))]
    effects = [effect() for effect in ground]
    assert choose_input([alone], None, effects).idle == ("effective_track",)
    assert choose_input([other], None, effects).idle == ()


@pytest.mark.parametrize(
    ("layout", "vehicle", "effects"),
    few(
        [
            ("husky_body_command", "husky", {"drive_lag": 0.3, "drive_gain": 0.9}),
            ("husky", "husky", {"drive_lag": 0.3, "transport_delay": 0.15}),
            ("ackermann", "car", {"drive_lag": 0.3, "steering_lag": 0.2}),
            ("ackermann_status", "car", {"drive_lag": 0.3}),
            ("mecanum", "youbot", {"drive_lag": 0.3}),
        ],
        3,
    ),
    ids=["body command", "wheel command", "car", "steering at once", "mecanum"],
)
def test_a_known_vehicle_shows_every_effect_of_its_drive(
    tmp_path: Path, layout: str, vehicle: str, effects: dict[str, float]
) -> None:
    scenario = make(layout, vehicle, effects, is_named=True)
    made = analyze(record(scenario, tmp_path / "run.mcap"), tmp_path / "results")
    assert {*made.named} == {*effects}
    for name, truth in effects.items():
        (number,) = made.named[name].values()
        assert contains(number, truth), name


@pytest.mark.parametrize("layout", few(["wheel_float", "ackermann"], 2))
def test_commands_of_the_wheels_themselves_need_no_geometry(tmp_path: Path, layout: str) -> None:
    vehicle = "car" if layout == "ackermann" else "turtlebot3"
    log = record(make(layout, vehicle, {"drive_lag": 0.3}), tmp_path / "run.mcap")
    made = analyze(log, tmp_path / "results")
    assert "no vehicle is given: " in made.findings["vehicle_fitted"]
    assert made.manifest.part("vehicle")["stand_ins"]
    assert contains(made.named["drive_lag"]["tau"], 0.3)


def test_encoders_against_the_command_are_reported_and_nothing_is_named(tmp_path: Path) -> None:
    scenario = make(encoders=Encoders(gain=-1.0))
    made = analyze(record(scenario, tmp_path / "run.mcap"), tmp_path / "results")
    assert "drive and turn the other way" in made.findings["signs_contradict"]
    assert "sign = -1 under [wheels]" in made.findings["signs_contradict"]
    assert not made.named
    (tmp_path / "run.toml").write_text("[wheels]\nsign = -1\n")
    mended = analyze(tmp_path / "run.mcap", tmp_path / "mended")
    assert contains(mended.named["drive_lag"]["tau"], 0.3)


def test_one_encoder_against_the_command_is_reported(tmp_path: Path) -> None:
    record(make(), tmp_path / "run.mcap")
    (tmp_path / "run.toml").write_text('[wheels]\nreversed = "left"\n')
    made = analyze(tmp_path / "run.mcap", tmp_path / "results")
    assert 'gives reversed = "left", which contradicts' in made.findings["configured_wrongly"]
    assert not made.named


def write_drive(log: LogWriter, *, commands: bool, wheels: bool, moves: bool = True) -> None:
    turning = np.sin(np.arange(STAMPS.size) / 20.0) * moves
    if commands:
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", STAMPS, {"linear.x": turning})
    if wheels:
        sides = {"name": ["left_wheel", "right_wheel"], "velocity": np.column_stack((turning, turning)) * 5.0}
        log.write_columns("/joint_states", "sensor_msgs/msg/JointState", STAMPS, sides, header_time=STAMPS)


@pytest.mark.parametrize(
    ("commands", "wheels", "moves", "said"),
    [
        (True, False, True, "the log has commands without measured wheels"),
        (False, True, True, "the log has measured wheels without commands"),
        (True, True, False, r"\(/joint_states\) cannot stand in for it: they do not turn"),
    ],
    ids=["no wheels", "no commands", "wheels at rest"],
)
def test_what_is_missing_is_named(
    tmp_path: Path, *, commands: bool, wheels: bool, moves: bool, said: str
) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        write_drive(log, commands=commands, wheels=wheels, moves=moves)
    done = run_verb("diagnose", tmp_path / "run.mcap", "--results", tmp_path / "results")
    assert done.returncode
    assert "no topic can serve as pose" in done.stderr
    assert re.search(said, done.stderr)


def test_a_pose_topic_without_any_message_is_missed(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        write_drive(log, commands=True, wheels=True)
        none = np.zeros(0, dtype=np.int64)
        fields = {"pose.pose.position.x": np.zeros(0)}
        log.write_columns("/odom", "nav_msgs/msg/Odometry", none, fields, header_time=none)
    if not any(channel.topic == "/odom" for channel in open_log(tmp_path / "run.mcap").channels):
        pytest.skip("the writer leaves out channels without messages")
    with pytest.raises(SlipError, match=r"no topic can serve as pose.*/odom is without any message"):
        analyze_log(tmp_path / "run.mcap", Options(out=tmp_path / "results"))


def test_a_pose_topic_without_a_usable_pose_is_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        write_drive(log, commands=True, wheels=True)
        lost = {"pose.pose.position.x": np.full(STAMPS.size, np.nan)}
        log.write_columns("/odom", "nav_msgs/msg/Odometry", STAMPS, lost, header_time=STAMPS)
    with pytest.raises(SlipError):
        analyze_log(tmp_path / "run.mcap", Options(out=tmp_path / "results"))


def test_wheels_that_stand_in_are_no_input(unknown: Analyzed, tmp_path: Path) -> None:
    done = run_verb("diagnose", unknown.log, "--results", tmp_path / "results", "--input", "measured")
    assert done.returncode
    assert "stand in for it, and are no input" in done.stderr


def test_wheels_that_repeat_the_commands_are_refused(tmp_path: Path) -> None:
    steps = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, STAMPS.size // 4), 4)
    sides = {"name": ["left_wheel", "right_wheel"], "velocity": np.column_stack((steps, steps)) / 0.165}
    with LogWriter(tmp_path / "run.mcap") as log:
        log.metadata("deployment", {"vehicle": "husky_a200"})
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", STAMPS, {"linear.x": steps})
        stamps = STAMPS + 1_000_000
        log.write_columns("/joint_states", "sensor_msgs/msg/JointState", stamps, sides, header_time=stamps)
    with pytest.raises(SlipError, match="repeat the commands"):
        analyze_log(tmp_path / "run.mcap", Options(out=tmp_path / "results"))


def test_wheels_that_turn_back_and_forth_are_not_at_rest(tmp_path: Path) -> None:
    times = np.arange(1200) / 20.0
    asked = 0.4 * np.sign(np.sin(2.0 * np.pi * 0.5 * times)) * (0.5 + 0.5 * (times > 30.0))
    speed, rolled = 0.0, []
    for one in asked:
        # What the wheels do follows the commands before.
        rolled.append(speed)
        speed += (one - speed) * (1.0 - np.exp(-0.05 / 0.25))
    stamps = STAMPS[0] + (times * 1e9).astype(np.int64)
    noise = np.random.default_rng(2).normal(0.0, 0.005, (times.size, 2))
    sides = {"name": ["left_wheel", "right_wheel"], "velocity": np.array(rolled)[:, None] / 0.165 + noise}
    with LogWriter(tmp_path / "run.mcap") as log:
        log.metadata("deployment", {"vehicle": "husky_a200"})
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", stamps, {"linear.x": asked})
        log.write_columns("/joint_states", "sensor_msgs/msg/JointState", stamps, sides, header_time=stamps)
    made = analyze(tmp_path / "run.mcap", tmp_path / "results")
    assert "not_moving" not in made.findings
    # It never turns, so that the lag of a turn is not told from that of the drive.
    (open_group,) = made.diagnosis["undecided"]
    assert open_group["candidates"][0] == "drive_lag"
    assert contains(open_group["parameters"]["drive_lag"]["tau"], 0.25)


def test_poses_are_the_integral_of_the_wheels(unknown: Analyzed) -> None:
    poses = unknown.manifest.read("poses")
    data = read_topics(open_log(unknown.log), [], sha256="unused")
    assert data.topics == ()
    moved = np.hypot(*(np.diff(poses[axis].to_numpy()) for axis in "xy")).sum()
    ahead = unknown.manifest.read("velocities").select(pl.col("v_x").abs().sum() / 20.0).item()
    assert moved == pytest.approx(ahead, rel=0.03)
    assert not poses["held"].any()
    assert "wheels" not in unknown.manifest.tables


def test_a_case_of_the_field(tmp_path: Path) -> None:
    log = CASES / "drive_only.mcap"
    if not log.is_file():
        pytest.skip("../shared/cases is not here: the cases of the field are not part of the repository")
    made = analyze(log, tmp_path)
    assert [*made.named] == ["drive_lag"]
    assert made.named["drive_lag"]["tau"]["value"] == pytest.approx(0.25, abs=0.01)
    assert contains(made.named["drive_lag"]["tau"], 0.25)


def test_a_plain_log_with_poses_is_analyzed_as_before(tmp_path: Path) -> None:
    write_log(simulate_run(replace(PLAIN, duration_s=30.0)), tmp_path / "run.mcap")
    outcome = analyze_log(tmp_path / "run.mcap", Options(out=tmp_path / "results"))
    findings = outcome.manifest.read("findings")["id"]
    assert GROUND_UNOBSERVABLE not in findings
