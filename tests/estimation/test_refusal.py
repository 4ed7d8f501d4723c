"""Why an addition is no help: its sign, its interval, its degenerate form, its gain."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.estimation.additions import explain_errors, explain_refusal
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest

BELOW = {"t_mrmse_m": 0.1, "r_mrmse_rad": 0.05}
WORSE = {"t_mrmse_m": 0.11, "r_mrmse_rad": 0.06}
BETTER = {"t_mrmse_m": 0.08, "r_mrmse_rad": 0.05}
CLEAR = 12.0
"""Standard errors."""


def test_what_is_clear_is_not_refused() -> None:
    track = find_effect("effective_track")(k=1.6)
    assert explain_refusal(track, {"effective_track.k": (1.55, 1.65)}) is None


def test_a_gain_within_the_noise_is_refused() -> None:
    assert explain_errors(BELOW, BETTER, 3.0) == "the reduction is not significant (t = 3.0, required 5)"


def test_an_interval_that_includes_doing_nothing_is_refused() -> None:
    track = find_effect("effective_track")(k=1.01)
    why = explain_refusal(track, {"effective_track.k": (0.98, 1.04)})
    assert why == "the 95 % interval of k, 0.98 to 1.04, includes 1 (no effect)"
    # One number that is certain is enough.
    two = find_effect("side_lag")(tau_left=0.3, tau_right=0.01)
    certain = {"side_lag.tau_left": (0.25, 0.35), "side_lag.tau_right": (-0.01, 0.03)}
    assert explain_refusal(two, certain) is None


def test_an_impossible_sign_is_refused() -> None:
    resistance = find_effect("turning_resistance")(k=-0.02)
    why = explain_refusal(resistance, {"turning_resistance.k": (-0.03, -0.01)})
    assert "is not possible" in str(why)


def test_a_degenerate_form_is_called_by_what_it_is() -> None:
    conditions = Conditions(Largest(1.0, 1.0, 10.0, 1.0, np.linspace(0.0, 60.0, 11)))
    lag = find_effect("side_lag")(tau_left=0.3, tau_right=0.3)
    assert explain_refusal(lag, {}, conditions) == "with these values it acts as drive_lag"


@pytest.mark.parametrize(
    ("errors", "reason"),
    [
        ({"t_mrmse_m": 0.102, "r_mrmse_rad": 0.04}, "position error rises by 2 %"),
        (WORSE, "position error rises by 10 %, heading error by 20 %"),
        ({"t_mrmse_m": 0.0995, "r_mrmse_rad": 0.0499}, "no error over 2 s falls by more than 1 %"),
        (BETTER, None),
    ],
)  # fmt: skip
def test_errors_that_rise_or_do_not_fall_speak_against_an_addition(
    errors: dict[str, float], reason: str | None
) -> None:
    assert explain_errors(BELOW, errors, CLEAR) == reason
