"""A base that stops by itself when nothing is asked of it: how long it waits, and commands are held."""

from dataclasses import replace
from functools import cache

import numpy as np
import polars as pl
import pytest
from few import few
from incidents import Incident, fall_silent
from stage_logs import FIELD, Taken, TakeThrough

from pipeline.recording.command_scale import roll
from pipeline.recording.geometry import roll_wheels
from pipeline.recording.readings import Held, Reading
from pipeline.recording.timeouts import CommandTimeout, find_timeout
from pipeline.simulate import Program, Scenario
from pipeline.words import format_finding

STARTS = np.linspace(12.0, 280.0, 20)
LONG_S = 1.5


@cache
def pause(timeout_s: float, effect: str = "drive_lag", size: float = 0.3) -> Scenario:
    """Twenty times nobody says anything for a second and a half."""
    program = Program("stop_and_go", hold_s=timeout_s)
    scenario = replace(FIELD, effects={effect: size}, duration_s=300.0, seed=2, program=program)
    return fall_silent(scenario, *(Incident("commands_silent", at, at + LONG_S) for at in STARTS.tolist()))


@pytest.mark.parametrize(
    ("timeout_s", "effect", "size"),
    few(
        [
            (0.25, "drive_lag", 0.3),
            (1.0, "drive_lag", 0.3),
            (0.25, "acceleration_limit", 4.0),
            (0.5, "acceleration_limit", 4.0),
            (1.0, "acceleration_limit", 4.0),
        ],
        5,
    ),
    ids=str,
)
def test_silences_show_when_the_base_stops(
    drive: TakeThrough, timeout_s: float, effect: str, size: float
) -> None:
    taken = drive(pause(timeout_s, effect, size))
    told = taken.finding("command_timeout")
    assert told.value == pytest.approx(timeout_s, abs=0.03)
    assert "after the last command" in format_finding(told)
    assert taken.aligned.alignment.hold_s == told.value, "nothing is held longer than the base does"


def test_no_sample_counts_a_command_that_the_base_gave_up(drive: TakeThrough) -> None:
    """Held for half a second, a base that stops after a quarter of it slips at full speed for the rest."""
    slip = drive(pause(0.25)).slip("command")
    since = slip["t"].to_numpy()[:, None] - STARTS
    assert not ((since > 0.35) & (since < LONG_S)).any()
    assert ((since > 0.0) & (since < 0.2)).any()


def test_without_encoders_the_poses_show_it(drive: TakeThrough) -> None:
    taken = drive(replace(pause(0.25), encoders=None))
    assert taken.aligned.alignment.hold_s == pytest.approx(0.25, abs=0.04)


def test_who_configures_a_time_is_told_of_the_other(drive: TakeThrough) -> None:
    taken = drive(pause(0.25), {"command": {"hold_s": 1.0}})
    assert taken.aligned.alignment.hold_s == 1.0
    assert "command.hold_s = 1 holds them longer" in format_finding(taken.finding("command_timeout"))


def test_commands_that_were_not_recorded_are_no_silence(drive: TakeThrough) -> None:
    """The recorder lost them, and the base heard them."""
    taken = drive(replace(pause(0.5), played=None))
    assert "command_timeout" not in taken.ids(), "nothing fell silent"
    assert find_among(taken, "commands") is None


def test_silences_of_the_whole_log_tell_nothing(drive: TakeThrough) -> None:
    """The recorder stood: nothing shows whether the base did."""
    taken = drive(pause(0.5))
    assert find_among(taken) is not None
    assert find_among(taken, "commands", "wheels") is None


def find_among(taken: Taken, *lost: str) -> CommandTimeout | None:
    """The time-out where some tables have no row in the silences."""
    readings = []
    for name in ("commands", "wheels"):
        table = taken.extracted.tables[name]
        since = table["t"].to_numpy()[:, None] - STARTS
        silent = ((since > 0.0) & (since < LONG_S)).any(axis=1)
        times, velocity = roll(
            table.filter(pl.Series(~silent)) if name in lost else table, taken.aligned.vehicle
        )
        readings.append(Reading("body", "", *(Held(times, velocity[:, axis]) for axis in (0, 2))))
    motion = roll_wheels(readings[1])
    assert motion.is_known
    return find_timeout(readings[0], motion, 0.5)
