"""An effect that is no help is refused, with the reason in words."""

from __future__ import annotations

import pytest

from pipeline.estimation.acceptance import explain_refusal
from pipeline.models import find_effect

BELOW = {"t_mrmse_m": 0.1, "r_mrmse_rad": 0.05}
BETTER = {"t_mrmse_m": 0.08, "r_mrmse_rad": 0.05}
SKID = find_effect("lateral_skid")


def explain(errors: dict[str, float], value: float, interval: tuple[float, float] | None) -> str:
    intervals = {} if interval is None else {"lateral_skid.c": interval}
    return explain_refusal(BELOW, errors, [SKID(c=value)], intervals)


@pytest.mark.parametrize("interval", [(0.05, 0.15), None])
def test_what_lowers_an_error_with_a_number_that_is_not_nothing_is_taken(
    interval: tuple[float, float] | None,
) -> None:
    assert explain(BETTER, 0.1, interval) == ""


@pytest.mark.parametrize(
    ("errors", "value", "interval", "reason"),
    [
        ({"t_mrmse_m": 0.102, "r_mrmse_rad": 0.04}, 0.1, (0.05, 0.15), "position error rises 0.1000 -> 0.10"),
        ({"t_mrmse_m": 0.0995, "r_mrmse_rad": 0.0499}, 0.1, (0.05, 0.15), "no error over 2 s falls"),
        (BETTER, 0.1, (-0.01, 0.21), "the interval of lateral_skid.c holds the value that changes nothing"),
        (BETTER, -0.1, (-0.15, -0.05), "physics excludes lateral_skid.c below 0: -0.1"),
    ],
)  # fmt: skip
def test_what_is_no_help_is_refused_for_one_reason(
    errors: dict[str, float], value: float, interval: tuple[float, float], reason: str
) -> None:
    said = explain(errors, value, interval)
    assert said.startswith(reason)
    assert ";" not in said


def test_one_number_that_is_not_nothing_is_enough() -> None:
    lag = find_effect("turn_lag")(tau_mean=0.3, tau_diff=0.0)
    intervals = {"turn_lag.tau_mean": (0.2, 0.4), "turn_lag.tau_diff": (-0.1, 0.1)}
    assert explain_refusal(BELOW, BETTER, [lag], intervals) == ""
    both = intervals | {"turn_lag.tau_mean": (-0.1, 0.4)}
    assert "turn_lag.tau_mean and turn_lag.tau_diff" in explain_refusal(BELOW, BETTER, [lag], both)
