"""Why an addition is no help: its sign, its interval, its degenerate form, its gain."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.estimation.acceptance import Improvement
from pipeline.estimation.refusal import explain_refusal, explain_refusals
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest

BELOW = {"t_mrmse_m": 0.1, "r_mrmse_rad": 0.05}
BETTER = {"t_mrmse_m": 0.08, "r_mrmse_rad": 0.05}
SKID = find_effect("lateral_skid")
CLEAR = Improvement(t=12.0, t_stable=9.0, gain=0.4)


def test_what_is_clear_is_not_refused() -> None:
    track = find_effect("effective_track")(k=1.6)
    assert explain_refusal(track, {"effective_track.k": (1.55, 1.65)}, CLEAR) is None


@pytest.mark.parametrize(
    ("gain", "word"),
    [
        (Improvement(t=12.0, t_stable=9.0, gain=0.004), "less than 1%"),
        (Improvement(t=3.0, t_stable=2.6, gain=0.05), "t = 3.0; 5 is needed"),
        (Improvement(t=9.0, t_stable=0.5, gain=0.05), "within the noise"),
    ],
    ids=["small", "uncertain", "of_one_event"],
)
def test_a_gain_within_the_noise_is_refused(gain: Improvement, word: str) -> None:
    track = find_effect("effective_track")(k=1.02)
    assert word in str(explain_refusal(track, {"effective_track.k": (1.01, 1.03)}, gain))


def test_an_interval_that_includes_doing_nothing_is_refused() -> None:
    track = find_effect("effective_track")(k=1.01)
    why = explain_refusal(track, {"effective_track.k": (0.98, 1.04)}, CLEAR)
    assert why == "the 95 % interval of k, 0.98 to 1.04, includes 1: no effect"
    # One number that is certain is enough.
    two = find_effect("side_lag")(tau_left=0.3, tau_right=0.01)
    certain = {"side_lag.tau_left": (0.25, 0.35), "side_lag.tau_right": (-0.01, 0.03)}
    assert explain_refusal(two, certain, CLEAR) is None


def test_an_impossible_sign_is_refused() -> None:
    resistance = find_effect("turning_resistance")(k=-0.02)
    why = explain_refusal(resistance, {"turning_resistance.k": (-0.03, -0.01)}, CLEAR)
    assert "is not possible" in str(why)


def test_a_degenerate_form_is_called_by_what_it_is() -> None:
    conditions = Conditions(Largest(1.0, 1.0, 10.0, 1.0, np.linspace(0.0, 60.0, 11)))
    lag = find_effect("side_lag")(tau_left=0.3, tau_right=0.3)
    assert explain_refusal(lag, {}, CLEAR, conditions) == "with these values it acts as drive_lag"


def explain_skid(errors: dict[str, float], value: float, interval: tuple[float, float] | None) -> str:
    intervals = {} if interval is None else {"lateral_skid.c": interval}
    return explain_refusals(BELOW, errors, [SKID(c=value)], intervals)


@pytest.mark.parametrize("interval", [(0.05, 0.15), None])
def test_what_lowers_an_error_with_a_number_that_is_not_nothing_is_taken(
    interval: tuple[float, float] | None,
) -> None:
    assert explain_skid(BETTER, 0.1, interval) == ""


@pytest.mark.parametrize(
    ("errors", "value", "interval", "reason"),
    [
        ({"t_mrmse_m": 0.102, "r_mrmse_rad": 0.04}, 0.1, (0.05, 0.15), "position error rises 0.1000 -> 0.10"),
        ({"t_mrmse_m": 0.0995, "r_mrmse_rad": 0.0499}, 0.1, (0.05, 0.15), "no error over 2 s falls"),
        (BETTER, 0.1, (-0.01, 0.21), "lateral_skid: the 95 % interval of c, -0.01 to 0.21 s, includes 0 s"),
        (BETTER, -0.1, (-0.15, -0.05), "lateral_skid: c = -0.1 s is not possible"),
    ],
)  # fmt: skip
def test_an_addition_that_is_no_help_is_refused_for_one_reason(
    errors: dict[str, float], value: float, interval: tuple[float, float], reason: str
) -> None:
    said = explain_skid(errors, value, interval)
    assert said.startswith(reason)
    assert ";" not in said
