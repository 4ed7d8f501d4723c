"""An encoder that dies during a run is found, by what the other signals say, and left out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_motion import RADIUS, Drive, command, draw, measured, sides, tabulate
from few import few
from front import SAMPLES, find_roles
from rewritten_logs import list_changes, read, write
from simulated_platforms import simulate_platform
from written_logs import write_log

from pipeline.analysis import Options
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.log_setup import set_up_log
from pipeline.recording.motion import NO_MOTION
from pipeline.recording.outages import Outage, find_outages, turns_about
from pipeline.recording.readings import SIDES, Held, Reading
from pipeline.words import format_finding

DIES, LIVES = 40.0, 70.0


def kill(side: Held, kind: str, end: float = np.inf, start: float = DIES) -> Held:
    """A side whose encoder dies at a time, and comes back at another."""
    times, values = side.times, side.values.copy()
    inside = (times >= start) & (times < end)
    if kind == "silent":
        return Held(times[~inside], values[~inside])
    last = values[np.flatnonzero(inside)[0] - 1]
    noise = np.random.default_rng(3).normal(0.0, 4.0, values.size)
    shown = {"zero": np.zeros(values.size), "held": np.full(values.size, last), "noise": noise}[kind]
    values[inside] = shown[inside]
    return Held(times, values)


def look(drive: Drive, wheels: Reading, *, asked: bool = True, seen: bool = True) -> list[Outage]:
    """Outages of a drive's wheels by its command and its poses."""
    motion = measured(tabulate(drive)) if seen else NO_MOTION
    one = command(drive).fitted(motion if seen else roll_wheels(sides(drive)))
    assert one.explained.is_known
    pair = dict(zip(SIDES, (wheels.first, wheels.second), strict=True))
    return find_outages(pair, (0.0, 0.0), one if asked else Reading(), motion)


READS = {"zero": "zero", "held": "one value", "noise": "noise", "silent": "nothing"}


@pytest.mark.parametrize("kind", few(READS, 2))
@pytest.mark.parametrize("side", [*SIDES, "both"])
@pytest.mark.parametrize("end", few([np.inf, LIVES], 2))
def test_a_dead_encoder_is_found(kind: str, side: str, end: float) -> None:
    drive = draw(21)
    wheels = sides(drive)
    if side in {"left", "both"}:
        wheels = replace(wheels, first=kill(wheels.first, kind, end))
    if side in {"right", "both"}:
        wheels = replace(wheels, second=kill(wheels.second, kind, end))
    (found,) = look(drive, wheels)
    assert (found.side, found.reads) == (side, READS[kind])
    assert found.start == pytest.approx(DIES, abs=1.0)
    assert found.end == pytest.approx(end, abs=1.5)


@pytest.mark.parametrize("kind", few(READS, 2))
@pytest.mark.parametrize(("asked", "seen"), [(False, True), (True, False)])
def test_one_other_signal_and_the_other_side_are_enough(kind: str, *, asked: bool, seen: bool) -> None:
    drive = draw(22)
    wheels = sides(drive)
    (found,) = look(drive, replace(wheels, first=kill(wheels.first, kind)), asked=asked, seen=seen)
    assert (found.side, found.reads) == ("left", READS[kind])


def test_an_encoder_that_dies_early_is_found() -> None:
    drive = draw(23)
    wheels = sides(drive)
    (found,) = look(drive, replace(wheels, second=kill(wheels.second, "held", start=15.0)))
    assert (found.side, found.reads) == ("right", "one value")
    assert found.start == pytest.approx(15.0, abs=1.0)


def test_wheels_that_follow_are_never_left_out() -> None:
    for seed in range(30, 34):
        drive = draw(seed)
        assert look(drive, sides(drive)) == []


def test_a_wheel_that_stands_and_turns_the_body_is_no_dead_encoder() -> None:
    """What the poses confirm is not the encoder's fault: that side of the drive stands."""
    drive = draw(24)
    stands = drive.time > DIES
    left, right = drive.wheels()
    left = np.where(stands, 0.0, left)
    speed, rate = 0.05 * (left + right), 0.77 * 0.2 * (right - left)
    yaw = np.cumsum(rate) * 0.01
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.01
    stuck = replace(drive, speed=speed, rate=rate, yaw=yaw[drive.rows], place=place[drive.rows])
    assert look(stuck, sides(stuck)) == []


def test_both_wheels_that_stand_while_the_body_is_pushed_are_no_dead_encoders() -> None:
    """Without a command nobody knows whether the body was pushed."""
    drive = draw(25)
    wheels = sides(drive)
    pushed = replace(wheels, first=kill(wheels.first, "zero"), second=kill(wheels.second, "zero"))
    assert look(drive, pushed, asked=False) == []


@pytest.mark.parametrize("kind", few(["held", "silent"], 2))
def test_what_is_left_out_is_told_with_its_line(kind: str, tmp_path: Path) -> None:
    drive = draw(26)
    wheels = sides(drive)
    log = write_log(
        tmp_path / "log.mcap", drive, wheels=replace(wheels, first=kill(wheels.first, kind, LIVES))
    )
    setup = set_up_log(log, Options(out=tmp_path))
    (told,) = [one for one in setup.choice.findings if one.id == "encoder_dead"]
    assert told.severity == "warning"
    assert "the left wheels' encoder reads nothing from 40 to 70 s" in format_finding(told)
    (span,) = setup.configuration.wheels.ignore
    line = f'ignore = [{{side = "left", start_s = {span.start_s:g}, end_s = {span.end_s:g}}}]'
    assert line in format_finding(told)
    for given, ignore in ((line, [span]), ("ignore = []", [])):
        (tmp_path / "line.toml").write_text(f"[wheels]\n{given}")
        settled = set_up_log(log, Options(out=tmp_path, config=tmp_path / "line.toml"))
        assert settled.configuration.wheels.ignore == ignore
        assert "encoder_dead" not in {one.id for one in settled.choice.findings}


@pytest.mark.parametrize(("count", "said"), [(1, "1 message of it is"), (3, "3 messages of it are")])
def test_an_encoder_with_hardly_any_message_is_silent_whatever_it_says(
    count: int, said: str, tmp_path: Path
) -> None:
    drive = draw(26)
    wheels = sides(drive)
    rows = np.linspace(2, wheels.second.times.size - 5, count).astype(int)
    for shown in (wheels.second.values, np.zeros(wheels.second.values.size)):
        few_read = replace(wheels, second=Held(wheels.second.times[rows], shown[rows]))
        log = write_log(tmp_path / "log.mcap", drive, wheels=few_read)
        findings = set_up_log(log, Options(out=tmp_path)).choice.findings
        (told,) = [format_finding(one) for one in findings if one.id == "wheel_dead"]
        assert f"the right wheels' encoder is silent: {said} recorded" in told


@pytest.mark.parametrize("name", few(["left encoder dies", "right encoder holds"], 2))
def test_an_encoder_of_mecanum_wheels_dies_beside_a_body_that_is_commanded(name: str, tmp_path: Path) -> None:
    log = simulate_platform("dingo_o", {}, out=tmp_path / "log.mcap", seed=5, duration_s=100.0)
    roles = find_roles(log)
    (change,) = [one for one in list_changes() if one.name == name]
    made = change.make(read(log), roles)
    assert made is not None
    setup = set_up_log(write(made, tmp_path / "changed.mcap"), Options(out=tmp_path))
    assert "encoder_dead" in {one.id for one in setup.choice.findings}
    # Before it dies it is on no other scale.
    assert setup.configuration.wheels.factors is None


def test_an_encoder_that_dies_in_driving_at_one_speed_is_dead_from_then_on(tmp_path: Path) -> None:
    """Wheels that turned at one speed before it do not hide the value that it holds."""
    log = SAMPLES / "warthog_ice.mcap"
    (change,) = [one for one in list_changes() if one.name == "right encoder holds"]
    made = change.make(read(log), find_roles(log))
    assert made is not None
    setup = set_up_log(write(made, tmp_path / "changed.mcap"), Options(out=tmp_path))
    (span,) = setup.configuration.wheels.ignore
    assert (span.side, span.end_s) == ("right", None)
    assert span.start_s == pytest.approx(144.0, abs=1.0)


TURNS = (1.0, 2.0, 3.0, -2.0, -1.0, 2.5)
PLANS = {
    "spins, then pivots": [*((-one, one) for one in TURNS), *((one, 0.0) for one in TURNS)],
    "one wheel, then the other": [*((0.0, one) for one in TURNS), *((one, 0.0) for one in TURNS)],
    "ahead, then pivots": [*((one, one) for one in TURNS), *((0.0, one) for one in TURNS)],
}


def follow(plan: list[tuple[float, float]], track: float, skids: float) -> tuple[Drive, Reading]:
    """A drive by what its wheels do for 8 s each [rad/s], whose body turns less than they do."""
    left, right = np.repeat(np.array(plan), 800, axis=0).T
    speed, rate = 0.5 * RADIUS * (left + right), RADIUS * (right - left) / track / skids
    time = 0.01 * np.arange(left.size)
    rows = np.arange(0, time.size, 10)
    noise = np.random.default_rng(4).normal(0.0, 0.002, (3, rows.size))
    yaw = np.cumsum(rate) * 0.01
    place = np.cumsum(speed * np.exp(1j * yaw)) * 0.01
    asked = np.column_stack([speed, rate])
    place, yaw = place[rows] + noise[0] + 1j * noise[1], yaw[rows] + noise[2]
    wheels = (Held(time[::5], one[::5]) for one in (left, right))
    return Drive(time, asked, speed, rate, place, yaw, rows), Reading("sides", "wheels", *wheels)


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize(("given", "skids"), [(None, 1.0), (0.35, 1.0), (0.35, 1.6)])
def test_a_wheel_that_stands_in_another_manoeuvre_is_no_dead_encoder(
    plan: str, given: float | None, skids: float
) -> None:
    drive, wheels = follow(PLANS[plan], 0.35, skids)
    pair = dict(zip(SIDES, (wheels.first, wheels.second), strict=True))
    assert find_outages(pair, (0.0, 0.0), Reading(), measured(tabulate(drive)), given) == []


def test_an_encoder_that_dies_in_pivots_beside_other_drives_is_found() -> None:
    plan = [*PLANS["one wheel, then the other"], *PLANS["ahead, then pivots"]]
    drive, wheels = follow(plan, 0.35, 1.0)
    pair = {"left": wheels.first, "right": kill(wheels.second, "zero", start=150.0)}
    (one,) = find_outages(pair, (0.0, 0.0), Reading(), measured(tabulate(drive)), 0.35)
    assert (one.side, one.reads) == ("right", "zero")


@pytest.mark.parametrize(
    ("plan", "pivots"), [([(0.0, one) for one in TURNS], True), ([(1.0, 4.0), (3.0, 4.0)] * 8, False)]
)
def test_wheels_stand_throughout_where_the_body_turns_about_them_alone(
    plan: list[tuple[float, float]], *, pivots: bool
) -> None:
    """A body that turns more to one side the faster it goes does not turn about that side."""
    drive, _ = follow(plan, 0.35, 1.0)
    assert turns_about("left", measured(tabulate(drive)), 0.35) == pivots
    assert not turns_about("right", measured(tabulate(drive)), 0.35)
