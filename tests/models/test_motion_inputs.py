"""Which input a verb takes, and the reason that it gives."""

from dataclasses import replace

import pytest
from motion_runs import simulate

from pipeline.estimation import Input, choose_input
from pipeline.models import find_effect
from pipeline.run import MotionRun

LAG, SKID = find_effect("drive_lag")(), find_effect("lateral_skid")()


@pytest.fixture(scope="module")
def run() -> MotionRun:
    made = simulate({}, duration_s=20.0)
    assert made.commands is not None
    assert made.wheels is not None
    return made


def test_the_command_leads_where_every_run_has_one(run: MotionRun) -> None:
    without = replace(run, name="silent", commands=None)

    assert choose_input([run]).source is Input.COMMAND
    mixed = choose_input([run, without])
    assert mixed.source is Input.MEASURED
    assert "silent" in mixed.reason


def test_what_was_asked_for_is_taken_and_what_cannot_act_there_is_said(run: MotionRun) -> None:
    chosen = choose_input([run], "measured", effects=(LAG, SKID))

    assert chosen.source is Input.MEASURED
    assert chosen.reason == "as requested"
    assert chosen.idle == ("drive_lag",)
    assert chosen.warning == (
        "not fitted from wheel encoders: drive_lag acts between command and wheels (--input command)"
    )
    assert not choose_input([run], "command", effects=(LAG, SKID)).warning


def test_effects_of_the_drivetrain_need_the_command_whatever_was_last(run: MotionRun) -> None:
    needed = choose_input([run], effects=(LAG, SKID), last="measured")
    assert needed.source is Input.COMMAND
    assert needed.reason == "drive_lag acts between command and wheels"
    assert choose_input([run], effects=(SKID,), last="measured").source is Input.MEASURED

    without = replace(run, name="silent", commands=None)
    impossible = choose_input([without], effects=(LAG, SKID))
    assert impossible.source is Input.MEASURED
    assert impossible.warning == (
        "not fitted from wheel encoders: drive_lag acts between command and wheels (silent has no command)"
    )
