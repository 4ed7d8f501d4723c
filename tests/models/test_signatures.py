"""Signatures of effects: simulated logs with known numbers, and the curve that physics gives each of them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Input, Problem, State
from pipeline.estimation.effect_signature import SINCE_STEP, Signature, find_signatures
from pipeline.models import Effect, Timing, find_effect
from pipeline.models.effect import Parameter
from pipeline.models.formula import FormulaEffect
from pipeline.simulate import Ground

if TYPE_CHECKING:
    from collections.abc import Mapping

TRUE: Mapping[str, tuple[str, float]] = {
    "effective_track": ("k", 1.6),
    "drive_lag": ("tau", 0.5),
    "lateral_skid": ("c", 0.2),
    "slope_drift": ("k", 0.7),
    "body_turn_limit": ("limit", 0.5),
}


@cache
def problem_of(name: str) -> Problem:
    """A log that was simulated with one effect alone."""
    more = {"ground": Ground(pitch_rad=0.2, roll_rad=0.1)} if name == "slope_drift" else {}
    key, value = TRUE[name]
    run = simulate({name: {key: value}}, duration_s=150.0, seed=3, **more)
    return Problem([run], vehicle_of("husky_a200"), Input.COMMAND)


def sign(name: str, effect: Effect | None = None) -> Signature:
    """The signature in that log of its own effect, or of another one."""
    key, value = TRUE[name]
    own = find_effect(name)(**{key: value}) if effect is None else effect
    (found,) = find_signatures(problem_of(name), State((own,), (Timing(),)))
    return found


def slope_of(found: Signature) -> float:
    return float(found.value @ found.before / (found.value @ found.value))


@pytest.mark.parametrize("name", TRUE)
def test_points_lie_on_the_curve_before_and_on_zero_after(name: str) -> None:
    found = sign(name)
    size = float(np.abs(found.curve).max())
    assert np.all(np.diff(found.value) > 0.0)
    assert found.value.size >= 8
    assert found.explained > 0.9
    assert np.abs(found.before - found.curve).max() < 0.06 * size
    assert np.abs(found.after).max() < 0.06 * size
    assert np.mean(np.abs(found.after) <= found.after_error + 0.01 * size) > 0.8, "intervals hold zero"


def test_a_wider_track_is_a_line_over_the_commanded_yaw_rate() -> None:
    found = sign("effective_track")
    assert (found.channel, found.variable) == ("w", "f_w")
    assert slope_of(found) == pytest.approx(1.0 / 1.6 - 1.0, abs=0.01)


def test_a_lag_fades_after_a_step_with_its_time_constant() -> None:
    found = sign("drive_lag")
    assert (found.channel, found.variable) == ("x", SINCE_STEP)
    early = found.before < -0.03
    rate = np.polyfit(found.value[early], np.log(-found.before[early]), 1)[0]
    assert -1.0 / rate == pytest.approx(0.5, abs=0.08)


def test_skid_is_a_line_over_speed_times_yaw_rate() -> None:
    found = sign("lateral_skid")
    assert (found.channel, found.variable) == ("y", "f_x_f_w")
    assert slope_of(found) == pytest.approx(-0.2, abs=0.01)


def test_sliding_downhill_grows_with_pitch() -> None:
    found = sign("slope_drift")
    assert (found.channel, found.variable) == ("x", "pitch")
    assert slope_of(found) == pytest.approx(0.7, abs=0.06), "it stands still for a part of the time"


def test_a_limit_does_nothing_below_itself() -> None:
    found = sign("body_turn_limit")
    assert (found.channel, found.variable) == ("w", "f_w")
    below = np.abs(found.value) < 0.4
    assert np.abs(found.before[below]).max() < 0.02
    beyond = np.abs(found.value) > 0.7
    lost = np.sign(found.value) * 0.5 - found.value
    assert found.before[beyond] == pytest.approx(lost[beyond], abs=0.03)


def test_an_effect_that_nobody_knows_has_its_signature_for_free() -> None:
    size = Parameter("k", "s", (-5.0, 5.0), 0.0, "size", 0.1)
    mine = FormulaEffect("mine", {"v_y": "k * v0 * w0"}, (size,)).change(k=-0.2)
    found, own = sign("lateral_skid", mine), sign("lateral_skid")
    assert (found.effect, found.channel, found.variable) == ("mine", own.channel, own.variable)
    assert found.curve == pytest.approx(own.curve, abs=1e-9)


def test_an_effect_that_does_nothing_has_no_signature() -> None:
    state = State((find_effect("effective_track")(k=1.0),), (Timing(),))
    assert find_signatures(problem_of("lateral_skid"), state) == []
