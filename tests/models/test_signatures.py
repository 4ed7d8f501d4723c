"""Signatures of effects: simulated logs with known numbers, and the curve that physics gives each of them."""

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input, ModelState
from pipeline.estimation.effect_signature import Signature, find_signatures
from pipeline.models import Effect, Timing, find_effect
from pipeline.models.effect import Parameter
from pipeline.models.formula import FormulaEffect
from pipeline.simulate import Ground

TRUE: Mapping[str, tuple[str, float]] = {
    "effective_track": ("k", 1.6),
    "drive_lag": ("tau", 0.5),
    "lateral_skid": ("c", 0.2),
    "slope_creep": ("c", 0.7),
    "body_turn_limit": ("limit", 0.5),
}


@cache
def problem_of(name: str) -> EstimationData:
    """A log that was simulated with one effect alone."""
    more = {"ground": Ground(pitch_rad=0.2, roll_rad=0.1)} if name == "slope_creep" else {}
    key, value = TRUE[name]
    run = simulate({name: {key: value}}, duration_s=150.0, seed=3, **more)
    return EstimationData([run], vehicle_of("husky_a200"), Input.COMMAND)


def sign(name: str, effect: Effect | None = None) -> Signature:
    """The signature in that log of its own effect, or of another one."""
    key, value = TRUE[name]
    own = find_effect(name)(**{key: value}) if effect is None else effect
    (found,) = find_signatures(problem_of(name), ModelState((own,), (Timing(),)))
    return found


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


def test_an_effect_that_nobody_knows_has_its_signature_for_free() -> None:
    size = Parameter("k", "s", (-5.0, 5.0), 0.0, "size", 0.1)
    mine = FormulaEffect("mine", {"v_y": "k * v0 * w0"}, (size,)).change(k=-0.2)
    found, own = sign("lateral_skid", mine), sign("lateral_skid")
    assert (found.effect, found.channel, found.variable) == ("mine", own.channel, own.variable)
    assert found.curve == pytest.approx(own.curve, abs=1e-9)


def test_an_effect_that_does_nothing_has_no_signature() -> None:
    state = ModelState((find_effect("effective_track")(k=1.0),), (Timing(),))
    assert find_signatures(problem_of("lateral_skid"), state) == []
