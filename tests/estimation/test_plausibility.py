"""What is large enough to be named, what is another effect in disguise, and what no vehicle does."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.plausibility import explain_impossible, is_exceeded, is_nameable, list_implausible
from pipeline.models import find_effect
from pipeline.models.parameter import Conditions, Largest

_CONDITIONS = Conditions(Largest(1.0, 1.0, 8.0, 3.0, np.linspace(0.0, 120.0, 11)))


@pytest.mark.parametrize(
    ("name", "of"),
    [("wheel_speed_limit", "wheel"), ("body_turn_limit", "turn"), ("body_speed_limit", "speed")],
)
def test_a_limit_that_measured_wheels_exceed_is_none(name: str, of: str) -> None:
    limit = find_effect(name)(limit=2.0)
    # Its interval may end half above it.
    assert is_exceeded(limit, replace(_CONDITIONS, exceeded={of: 3.2}))
    assert not is_exceeded(limit, replace(_CONDITIONS, exceeded={of: 3.1}))
    assert not is_exceeded(limit, replace(_CONDITIONS, exceeded={"another": 9.0}))


@pytest.mark.parametrize(
    ("name", "values", "exceeded", "said"),
    [
        (
            "body_turn_limit",
            {"limit": 0.38},
            {"turn": 0.631},
            "limit = 0.38 rad/s .* wheels reach 0.631 rad/s",
        ),
        ("lateral_skid", {"c": -0.05}, {}, "c = -0.05 s is not possible: it must be above 0 s"),
        ("effective_track", {"k": 6.0}, {}, r"k = 6 is not possible: vehicles have [\d.]+ to [\d.]+"),
        (
            "body_turn_limit",
            {"limit": 0.01},
            {},
            "limit = 0.01 rad/s .* at the end of its range, 0.01 rad/s to",
        ),
    ],
)
def test_a_value_that_is_not_possible_is_named_with_what_it_contradicts(
    name: str, values: dict[str, float], exceeded: dict[str, float], said: str
) -> None:
    told = explain_impossible(find_effect(name)(**values), replace(_CONDITIONS, exceeded=exceeded))
    assert re.match(said, told), told


def test_what_is_too_small_or_another_in_disguise_is_not_named() -> None:
    for name, values in [
        ("transport_delay", {"d": 0.008}),
        ("lateral_skid", {"c": -0.05}),
        ("heading_skew", {"d": -0.1}),
        ("terrain_change", {"k_v": 0.9, "k_w": 0.6, "at_s": 2.0}),
        ("turn_lag", {"tau_mean": 0.5, "tau_diff": 0.51}),
        ("turn_droop", {"threshold": 0.01, "gain": 0.5}),
        ("turn_droop", {"threshold": 1.5, "gain": 0.01}),
        ("body_speed_limit", {"limit": 1.0}),
        ("effective_track", {"k": 6.0}),
        ("body_inertia", {"tau": 5.0}),
        ("clock_offset", {"d": 0.1}),
    ]:
        assert not is_nameable(find_effect(name)(**values), _CONDITIONS)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("transport_delay", {"d": 0.05}),
        ("terrain_change", {"k_v": 0.9, "k_w": 0.6, "at_s": 60.0}),
        ("turn_lag", {"tau_mean": 0.3, "tau_diff": 1.0}),
        ("body_speed_limit", {"limit": 0.7}),
        ("clock_offset", {"d": -0.1}),
    ],
)
def test_what_is_large_enough_is_named(name: str, values: dict[str, float]) -> None:
    assert is_nameable(find_effect(name)(**values), _CONDITIONS)


def test_a_break_before_which_nothing_turned_is_a_track() -> None:
    late = replace(_CONDITIONS.largest, turns=np.linspace(80.0, 120.0, 11))
    change = find_effect("terrain_change")(k_v=0.9, k_w=0.6, at_s=60.0)
    assert not is_nameable(change, replace(_CONDITIONS, largest=late))
    assert is_nameable(change.change(at_s=95.0), replace(_CONDITIONS, largest=late))


def test_what_sampling_makes_of_nothing_is_not_named() -> None:
    sampled = replace(_CONDITIONS, encoders=True, least_delay_s=0.06)
    assert is_nameable(find_effect("drive_lag")(tau=0.05), _CONDITIONS)
    assert not is_nameable(find_effect("drive_lag")(tau=0.05), sampled)
    assert is_nameable(find_effect("body_inertia")(tau=0.05), sampled)
    # A pause is half as late as a delay that is as long.
    assert is_nameable(find_effect("reversal_pause")(d=0.1), _CONDITIONS)
    assert not is_nameable(find_effect("reversal_pause")(d=0.1), sampled)
    assert is_nameable(find_effect("reversal_pause")(d=0.13), sampled)
    # So is a ramp: 6 rad/s are reached within .1 s.
    ramp = find_effect("acceleration_limit")(limit=_CONDITIONS.largest.wheel / 0.1)
    assert is_nameable(ramp, _CONDITIONS)
    assert not is_nameable(ramp, sampled)
    assert is_nameable(ramp.change(limit=_CONDITIONS.largest.wheel / 0.13), sampled)


def test_what_no_vehicle_does_is_said() -> None:
    assert list_implausible(find_effect("effective_track")(k=6.0))
    assert not list_implausible(find_effect("effective_track")(k=1.8))
    assert list_implausible(find_effect("yaw_drift")(c=0.5))
    assert not list_implausible(find_effect("yaw_drift")(c=0.1))


@pytest.mark.parametrize("name", ["wheel_speed_limit", "wheel_speed_scaling"])
def test_a_limit_that_no_measured_wheel_comes_near_is_not_named(name: str) -> None:
    measured = replace(_CONDITIONS, encoders=True, exceeded={"wheel": 6.2})
    assert is_nameable(find_effect(name)(limit=6.0), measured)
    assert not is_nameable(find_effect(name)(limit=7.5), measured)
    assert is_nameable(find_effect(name)(limit=7.5), _CONDITIONS)
