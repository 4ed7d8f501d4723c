"""Is the log long enough: curves end at what is stated, and say what a shorter log would have said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Fitted, Input, Problem, estimate_intervals, fit_model
from pipeline.estimation.error_regions import (
    narrow_intervals,
)
from pipeline.estimation.intervals import estimate_part, narrow_part, sum_blocks
from pipeline.models import Model, find_effect
from pipeline.run.windows import cut_run, find_driven

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": 1.7, "icr_offset": 0.1, "drive_lag": 0.3}
MODEL = Model(HUSKY, tuple(find_effect(name)() for name in TRUTH))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return fit_model(Problem([simulate(TRUTH, duration_s=180.0)], HUSKY, Input.COMMAND), MODEL, exact=True)


def test_the_last_width_is_the_stated_interval(fitted: Fitted) -> None:
    stated = {
        item.free.label: 0.5 * (item.high - item.low)
        for item in estimate_intervals(fitted.problem, fitted).items
    }
    curves = narrow_intervals(fitted)
    assert set(curves) == {"effective_track.k", "icr_offset.x_icr", "drive_lag.tau"}
    for label, curve in curves.items():
        assert curve.values[-1] == pytest.approx(stated[label], rel=1e-9)
        assert np.isinf(curve.values[0])
        assert (np.diff(curve.seconds) > 0.0).all()
    # Independent blocks narrow with the square root of the time: four times as many to a half.
    falls = [curve.values[-1] / curve.values[curve.values.size // 4] for curve in curves.values()]
    assert 0.3 < np.exp(np.mean(np.log(falls))) < 0.75


def test_a_width_on_the_way_is_that_of_a_log_that_ended_there(fitted: Fitted) -> None:
    run = fitted.problem.runs[0]
    short = Problem([cut_run(run, end_s=find_driven(run, 90.0))], HUSKY, Input.COMMAND)
    ended = narrow_intervals(fit_model(short, MODEL, exact=True))
    ratios = []
    for label, curve in narrow_intervals(fitted).items():
        place = np.searchsorted(curve.seconds, float(ended[label].seconds[-1]) - 3.5)
        ratios.append(curve.values[place] / ended[label].values[-1])
    assert np.all(np.abs(np.log(ratios)) < np.log(1.6))


def test_blocks_hold_what_their_windows_say(fitted: Fitted) -> None:
    for part, fit in zip(fitted.problem.parts, fitted.fits, strict=True):
        blocks, factor = sum_blocks(part, fit), fit.weights.factors(fit.residual)
        assert blocks.count == blocks.label.max() + 1 > 10
        late = (part.shift_clock(fit.state, 0, 5e-3) - fit.residual) / 5e-3
        clock = -part.list_clock_errors()[0] * late
        for block in (0, 3, blocks.count - 1):
            rows = blocks.label == block
            changes = np.concatenate((fit.jacobian[rows], clock[rows][:, :, None]), axis=2)
            columns = (changes * factor[rows][:, :, None]).reshape(-1, len(fit.free) + 1)
            assert np.allclose(blocks.normals[block], columns.T @ columns)
            weighed = (fit.residual[rows] * factor[rows]).reshape(-1)
            assert np.allclose(blocks.gradients[block], columns.T @ weighed)
        assert (blocks.held > 0.0).tolist() == [False] * len(fit.free) + [True]
    # All of a converged fit pulls nowhere, as its values of six digits say it; the third number, encoders'
    # delay, stands at its bound.
    blocks = sum_blocks(fitted.problem.parts[0], fitted.fits[0])
    pulled, sizes = blocks.gradients.sum(axis=0)[:2], np.abs(blocks.gradients).sum(axis=0)[:2]
    assert (np.abs(pulled) < 1e-4 * sizes).all()


def test_a_number_that_the_run_leaves_open_takes_no_other_along(fitted: Fitted) -> None:
    """Beside a column like that of a lag, a hundred millionth of its size."""
    part, fit = fitted.problem.parts[1], fitted.fits[1]
    faint = fit.jacobian * np.random.default_rng(3).normal(1.0, 0.1, fit.jacobian.shape)
    opened = replace(
        fit, free=(*fit.free, *fit.free), jacobian=np.concatenate((fit.jacobian, 1e-8 * faint), axis=2)
    )
    (lag,) = estimate_part(part, fit).items
    beside, left_open = estimate_part(part, opened).items
    assert np.isnan(left_open.low)
    assert beside.half == pytest.approx(lag.half, rel=0.01)


def test_all_blocks_in_another_order_end_at_the_same_width(fitted: Fitted) -> None:
    part, fit = fitted.problem.parts[0], fitted.fits[0]
    seconds, halves = narrow_part(part, fit)
    other, turned = narrow_part(part, fit, np.arange(seconds.size)[::-1].tolist())
    assert other[-1] == pytest.approx(seconds[-1])
    assert turned[-1] == pytest.approx(halves[-1], rel=1e-6)
    assert not np.allclose(turned[3], halves[3])
