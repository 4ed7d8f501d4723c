"""What the evidence promises without a fit is what a fit finds."""

from __future__ import annotations

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Input, Problem
from pipeline.estimation.acceptance import LEAST_T, compare
from pipeline.estimation.evidence import Evidence, find_gains
from pipeline.estimation.fit import PartFit, fit_part
from pipeline.estimation.parts import Part, make_weights
from pipeline.models import find_effect, list_effects
from pipeline.run import MotionRun
from pipeline.simulate import Disturbance

HUSKY = vehicle_of("husky_a200")
GROUND = ("effective_track", "icr_offset", "lateral_skid", "turning_resistance", "speed_slip", "wheel_radius")


def _fit(run: MotionRun, *names: str) -> tuple[Problem, Part, PartFit]:
    problem = Problem([run], HUSKY, Input.MEASURED)
    part, state = problem.whole, problem.start_state()
    for name in names:
        state = state.add(find_effect(name)().make_usual(problem.largest))
    weights = make_weights(part.find_residuals(problem.start_state()), part)
    fit = fit_part(part, weights, state)
    return problem, part, fit_part(part, make_weights(fit.residual, part), fit)


def _take(problem: Problem, part: Part, fit: PartFit, names: tuple[str, ...] = GROUND) -> Evidence:
    return Evidence(part, fit, [e for e in list_effects() if e.id in names], problem.largest)  # type: ignore[misc]


@pytest.fixture(scope="module")
def skidding() -> MotionRun:
    effects = {"effective_track": 1.6, "icr_offset": 0.1}
    return simulate(effects, duration_s=180.0, disturbance=Disturbance(0.03, 0.05))


def test_a_promise_is_what_the_fit_takes_off(skidding: MotionRun) -> None:
    problem, part, fit = _fit(skidding, "effective_track")
    evidence = _take(problem, part, fit)
    (best, *others) = evidence.rank_singles(10.0)
    assert best.starts[0].effect.id == "icr_offset"
    assert best.chi_square > 3.0 * max(one.chi_square for one in others)

    larger = fit_part(part, fit.weights, best.starts[0].add_to(fit.state))
    white = [evidence.noise.whiten_residual(one.residual) for one in (fit, larger)]
    taken = float((white[0] ** 2).sum() - (white[1] ** 2).sum())
    assert best.chi_square == pytest.approx(taken, rel=0.1)


def test_a_pair_promises_what_both_take_off_together(skidding: MotionRun) -> None:
    problem, part, fit = _fit(skidding)
    evidence = _take(problem, part, fit)
    (best, *_) = evidence.rank_pairs(10.0)
    assert {start.effect.id for start in best.starts} == {"effective_track", "icr_offset"}
    singles = {one.starts[0].effect.id: one.chi_square for one in evidence.rank_singles(10.0)}
    assert best.chi_square > singles["effective_track"]
    # Two that do the same promise no more together than the better one alone.
    both = [start for start in evidence.starts if start.effect.id in {"effective_track", "wheel_radius"}]
    together = evidence.expect_gain([place for start in both for place in start.places])
    assert together < 1.35 * singles["effective_track"]


def test_groups_of_columns_promise_together_what_each_promises_alone() -> None:
    random = np.random.default_rng(7)
    columns, residual = random.normal(size=(200, 6)), random.normal(size=200)
    groups = [(0,), (1, 2), (5,), (3, 4), (0, 3, 5)]
    gains = find_gains(columns.T @ columns, columns.T @ residual, groups, 0.0)
    for places, gain in zip(groups, gains.tolist(), strict=True):
        left = residual - columns[:, places] @ np.linalg.lstsq(columns[:, places], residual, rcond=None)[0]
        assert gain == pytest.approx(residual @ residual - left @ left)


def test_the_noise_is_that_of_the_true_model_before_anything_was_found(skidding: MotionRun) -> None:
    """The ideal model's residuals repeat themselves because it lacks something: that is no noise."""
    problem, part, ideal = _fit(skidding)
    _, _, true = _fit(skidding, "effective_track", "icr_offset")
    first, last = (_take(problem, part, fit).noise for fit in (ideal, true))
    innovation = [float(one.scale[place, -1]) for one in (first, last) for place in range(3)]
    assert innovation[:3] == pytest.approx(innovation[3:], rel=0.25)
    own = np.abs(ideal.residual[first.tiles.rows, 2]).mean() / np.abs(true.residual[:, 2]).mean()
    assert own > 3.0


def test_nothing_significant_is_found_where_nothing_is_hidden() -> None:
    found = []
    for seed in range(3):
        run = simulate({}, seed=40 + seed, duration_s=120.0, disturbance=Disturbance(0.03, 0.05))
        problem, part, fit = _fit(run)
        evidence = _take(problem, part, fit)
        for hypothesis in evidence.rank_singles(0.0)[:3]:
            larger = fit_part(part, fit.weights, hypothesis.starts[0].add_to(fit.state))
            found.append(compare(evidence.noise, fit.weights, fit.residual, larger.residual).t)
    assert max(found) < LEAST_T
