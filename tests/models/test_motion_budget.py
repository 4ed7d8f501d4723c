"""The budget: shares that are fair to the order and add up; and numbers of what was not named."""

from dataclasses import replace
from itertools import combinations
from math import factorial

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Fitted, Input, estimate_intervals, fit_model
from pipeline.estimation.apportion import (
    QUANTITIES,
    apportion,
    find_moments,
    jackknife_ratio,
    share_out,
)
from pipeline.estimation.estimates import estimate_unnamed
from pipeline.estimation.ladder import ModelAssessment, assess_model
from pipeline.models import Model, find_effect
from pipeline.words.errors import describe_moments

TRUE = {"effective_track": {"k": 1.6}, "lateral_skid": {"c": 0.08}}


@pytest.fixture(scope="module")
def judged() -> ModelAssessment:
    data = EstimationData([simulate(TRUE)], vehicle_of("husky_a200"), Input.MEASURED)
    model = Model(data.vehicle, tuple(find_effect(name)() for name in (*TRUE, "speed_slip")))
    return assess_model(data, model)


def shapley_by_subsets(names: tuple[str, ...], loss: dict[frozenset[str], float], name: str) -> float:
    """The textbook sum over subsets, written apart from what is tested."""
    others, count = [other for other in names if other != name], len(names)
    total = 0.0
    for size in range(count):
        for subset in combinations(others, size):
            weight = factorial(size) * factorial(count - size - 1) / factorial(count)
            total += weight * (loss[frozenset(subset)] - loss[frozenset((*subset, name))])
    return total


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_shares_are_the_shapley_values_of_any_loss(count: int, seed: int) -> None:
    names = tuple("abcde"[:count])
    draw = np.random.default_rng(seed).uniform(0.0, 1.0, 2**count)
    loss = {
        frozenset(name for bit, name in enumerate(names) if code >> bit & 1): np.array([value])
        for code, value in enumerate(draw.tolist())
    }
    split = share_out(names, loss)
    for name in names:
        assert split.parts[name][0] == pytest.approx(shapley_by_subsets(names, loss, name), abs=1e-12)


def test_a_budget_adds_up_to_the_ladders_numbers(judged: ModelAssessment) -> None:
    slip, position, heading = apportion(judged, length_scale_m=0.5)
    ideal = judged.ladder.steps[0].errors
    x, y, w = ideal.velocity_rms
    assert slip.total == pytest.approx(x**2 + y**2 + (0.5 * w) ** 2)
    assert position.total == pytest.approx(ideal.t_mrmse_m**2)
    assert heading.total == pytest.approx(ideal.r_mrmse_rad**2)
    for budget in (slip, position, heading):
        assert budget.unit == QUANTITIES[budget.quantity]
        assert sum(share.share for _, share in budget.causes) == pytest.approx(1.0)
        left = sum(share.share for kind, share in budget.causes if kind != "effect") * budget.total
        whole = judged.whole.errors
        x, y, w = whole.velocity_rms
        squares = {
            "slip": x**2 + y**2 + (0.5 * w) ** 2,
            "position": whole.t_mrmse_m**2,
            "heading": whole.r_mrmse_rad**2,
        }
        assert left == pytest.approx(squares[budget.quantity])


def test_what_was_put_into_a_run_carries_its_slip_and_what_was_not_carries_none(
    judged: ModelAssessment,
) -> None:
    slip = apportion(judged)[0]
    shares = {share.effect: share for share in slip.shares}
    assert [share.effect for share in slip.shares][:2] == ["effective_track", "lateral_skid"]
    assert shares["effective_track"].share > 0.5
    assert shares["lateral_skid"].low > 0.0
    assert abs(shares["speed_slip"].share) < 0.001


def test_the_times_with_half_of_the_error_are_found_where_it_is_above_the_noise(
    judged: ModelAssessment,
) -> None:
    assert find_moments(judged) == ()
    held, floor = judged.whole.held_out, judged.floor.r_mrmse_rad
    middle = judged.data.residuals_by_run[0].horizons.times.mean(axis=1)
    size = np.select(
        [(middle > 20.0) & (middle < 24.0), (middle > 40.0) & (middle < 42.0)], [30.0, 20.0], 1.0
    )
    worse = replace(judged, whole=replace(judged.whole, held_out=replace(held, yaw=(floor * size,))))
    (heading,) = find_moments(worse)
    start, end, share = msgspec.structs.astuple(heading.spans[0])
    assert (heading.run, heading.quantity, start, end) == (0, "heading", 20.0, 24.0)
    whole = float(np.sum(size**2))
    assert share == pytest.approx(float(np.sum(size[(middle >= 20.0) & (middle < 24.0)] ** 2)) / whole)
    assert heading.time_share < 0.1
    assert describe_moments(heading).endswith(f"largest parts: 20 to 24 s ({100.0 * share:.0f} %)")


def test_intervals_of_a_ratio_hold_it_as_often_as_they_say() -> None:
    rng, held = np.random.default_rng(5), 0
    for _ in range(400):
        whole = rng.gamma(2.0, 1.0, 30)
        part = whole * 0.4 + rng.normal(0.0, 0.3, 30)
        ratio, half = jackknife_ratio(part, whole)
        held += abs(ratio - 0.4) <= half
    assert 0.92 <= held / 400 <= 0.98


def test_effects_that_were_not_named_have_numbers_that_hold_the_truth() -> None:
    vehicle = vehicle_of("husky_a200")

    def fit(seed: int, *more: str) -> Fitted:
        data = EstimationData([simulate(TRUE, seed=seed)], vehicle, Input.MEASURED)
        effects = tuple(find_effect(name)() for name in ("effective_track", *more))
        return fit_model(data, Model(vehicle, effects), exact=True)

    rivals = [find_effect(name)() for name in ("lateral_skid", "wheel_radius", "body_speed_limit")]
    for seed in (1, 2):
        found = {item.free.label: item for item in estimate_unnamed(fit(seed), rivals)}
        # A limit has no neutral value to start a step from.
        assert set(found) == {"lateral_skid.c", "wheel_radius.k"}
        assert found["lateral_skid.c"].value == pytest.approx(0.08, abs=0.02)
        assert found["lateral_skid.c"].low < 0.08 < found["lateral_skid.c"].high
        assert found["wheel_radius.k"].low < 1.0 < found["wheel_radius.k"].high
        # It is known as well as it is where it was named.
        with_skid = fit(seed, "lateral_skid")
        named = estimate_intervals(with_skid).find("lateral_skid.c")
        assert found["lateral_skid.c"].standard_error == pytest.approx(named.standard_error, rel=0.2)
