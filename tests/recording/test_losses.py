"""Commands that the recorder lost at random, bases that drive in bursts, and commands of another robot."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from drawn_drives import DrawnDrive, DrawnTopic, record_cdr, record_twist, stamp_ros, write_drawn

from pipeline.analysis import Options
from pipeline.core import Flags, Floats
from pipeline.recording import number_gaps
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.words import format_finding

STEP_S = 0.01
LAG_S = 0.25


@dataclass(frozen=True)
class Robot:
    """A robot that follows its commands with a lag: what is asked every tenth of a second, and its poses."""

    asked: DrawnDrive
    does: DrawnDrive

    def command(self, *, kept: Flags | None = None) -> DrawnTopic:
        whole = record_twist(self.asked)
        rows = np.arange(whole.times.size) if kept is None else np.flatnonzero(kept)
        return replace(whole, times=whole.times[rows], messages=[whole.messages[row] for row in rows])

    def pose(self, topic: str = "/lio/pose") -> DrawnTopic:
        fields = stamp_ros(self.does) | self.does.pose("pose.") | {"header.frame_id": "map"}
        return record_cdr(self.does, topic, "geometry_msgs/msg/PoseStamped", fields)


def make_robot(
    seed: int, *, obeys: Flags | None = None, hold_s: float = np.inf, period_s: float = 0.1
) -> Robot:
    """A robot of which nothing is odd but what is given.

    Args:
        seed: of commands and noise.
        obeys: commands that the base gets, shape (n,).
        hold_s: time after which the base stops without a command.
        period_s: of the commands.
    """
    rng = np.random.default_rng(seed)
    stamps = np.arange(0.0, 120.0, period_s)
    asked = np.zeros((stamps.size, 2))
    begin = 1.0
    while begin < 118.0:
        lasts = rng.uniform(1.0, 4.0)
        asked[(stamps >= begin) & (stamps < begin + lasts)] = rng.uniform((-0.4, -1.0), (1.0, 1.0))
        begin += lasts + 1.0 * (rng.uniform() < 0.2)
    got = np.flatnonzero(np.ones(stamps.size, dtype=bool) if obeys is None else obeys)
    time = np.arange(0.0, 120.0, STEP_S)
    last = np.maximum(np.searchsorted(stamps[got], time + 1e-9, side="right") - 1, 0)
    wanted = np.where((time - stamps[got][last] < hold_s - 1e-6)[:, None], asked[got][last], 0.0)
    moves = np.zeros_like(wanted)
    for row in range(1, time.size):
        moves[row] = moves[row - 1] + (wanted[row] - moves[row - 1]) * STEP_S / LAG_S
    yaw = np.cumsum(moves[:, 1]) * STEP_S
    place = np.cumsum(moves[:, 0] * np.exp(1j * yaw)) * STEP_S
    rows = np.arange(3, time.size, 10)
    noise = rng.normal(size=(3, rows.size)) * 0.002
    nothing = np.zeros(stamps.size)
    return Robot(
        DrawnDrive(stamps + rng.uniform(0.0, 0.003, stamps.size), *asked.T, nothing, nothing, nothing),
        DrawnDrive(
            time[rows],
            *moves[rows].T,
            place.real[rows] + noise[0],
            place.imag[rows] + noise[1],
            yaw[rows] + noise[2],
        ),
    )


def set_up(path: Path, *topics: DrawnTopic) -> tuple[LogSetup, dict[str, str]]:
    setup = set_up_log(write_drawn(path, *topics), Options(out=path.parent))
    return setup, {one.id: format_finding(one) for one in setup.choice.findings}


def draw_losses(share: float) -> Flags:
    return np.asarray(np.random.default_rng(5).uniform(size=1200) > share)


@pytest.mark.parametrize("share", [0.2, 0.3], ids=str)
def test_commands_that_the_recorder_alone_lost_are_between_the_others(share: float, tmp_path: Path) -> None:
    robot, kept = make_robot(1), draw_losses(share)
    setup, told = set_up(tmp_path / "log.mcap", robot.command(kept=kept), robot.pose())
    (found,) = [one for one in setup.choice.findings if one.id == "commands_lost"]
    assert found.value == pytest.approx(share, abs=0.03)
    assert "but the base got them" in told["commands_lost"]
    assert setup.configuration.command.interpolate


def test_commands_that_the_base_lost_as_well_are_held(tmp_path: Path) -> None:
    kept = draw_losses(0.3)
    robot = make_robot(2, obeys=kept)
    setup, told = set_up(tmp_path / "log.mcap", robot.command(kept=kept), robot.pose())
    assert "the base did not get them" in told["commands_lost"]
    assert not setup.configuration.command.interpolate


def test_commands_that_are_sent_at_changes_or_at_half_the_rate_are_not_lost(tmp_path: Path) -> None:
    robot = make_robot(3)
    changes = np.append(True, np.diff(robot.asked.speed) != 0.0)
    slower = (np.arange(1200) % 40 < 20) | (np.arange(1200) % 2 == 0)
    for name, kept in (("changes", changes), ("slower", slower)):
        _, told = set_up(tmp_path / f"{name}.mcap", robot.command(kept=kept), robot.pose())
        assert "commands_lost" not in told, name


def test_gaps_are_numbered_by_the_period() -> None:
    times: Floats = np.delete(np.arange(200) * 0.05, [20, 50, 51, *range(100, 120)])
    number, period = number_gaps(times)
    assert period == pytest.approx(0.05)
    assert np.bincount(number).tolist() == [1, 173, 1, 1]
    assert not number_gaps(np.cumsum(np.random.default_rng(1).uniform(0.02, 0.3, 200)))[0].any()
    for few in ([], [0.0], [0.0, 0.1, 1.0]):
        assert number_gaps(np.array(few))[1] == 0.0


@pytest.mark.parametrize("hold_s", [0.25, 0.4], ids=str)
def test_a_base_that_stops_before_its_next_command_drives_in_bursts(hold_s: float, tmp_path: Path) -> None:
    robot = make_robot(4, hold_s=hold_s, period_s=0.5)
    setup, told = set_up(tmp_path / "log.mcap", robot.command(), robot.pose())
    assert "in bursts" in told["commands_in_bursts"]
    assert setup.configuration.command.hold_s == pytest.approx(hold_s, abs=0.015)


def test_of_two_robots_the_one_is_taken_that_the_commands_drive(tmp_path: Path) -> None:
    other, robot = make_robot(5), make_robot(6)
    setup, told = set_up(
        tmp_path / "log.mcap", robot.command(), other.pose("/vicon/a/pose"), robot.pose("/vicon/b/pose")
    )
    assert str(setup.sources.pose) == "/vicon/b/pose"
    assert "not_driven" not in told


def test_poses_that_no_command_drives_are_told(tmp_path: Path) -> None:
    _, told = set_up(tmp_path / "log.mcap", make_robot(7).command(), make_robot(8).pose())
    assert "not as /cmd_vel commands" in told["not_driven"]


@pytest.mark.parametrize("number", [7, 8])
def test_of_a_damaged_log_poses_are_used_only_where_they_are_seen_to_be_driven(
    number: int, tmp_path: Path
) -> None:
    """The rest of the log might show that they are of another body, as that of the whole log does."""
    begun = [
        replace(one, times=one.times[:90]) for one in (make_robot(7).command(), make_robot(number).pose())
    ]
    whole = write_drawn(tmp_path / "log.mcap", *(replace(one, messages=one.messages[:90]) for one in begun))
    part = tmp_path / "part.mcap"
    part.write_bytes(whole.read_bytes()[:-40])
    findings = {one.id for one in set_up_log(part, Options(out=tmp_path)).choice.findings}
    assert ("not_driven" in findings) is (number == 8)
