"""Is the log long enough: curves end at what is stated, and say what a shorter log would have said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import Fitted, Input, Named, Problem, Value, estimate_intervals, fit_model
from pipeline.estimation.acceptance import compare, grow_evidence
from pipeline.estimation.error_regions import (
    BREVITY,
    Curve,
    Growth,
    extrapolate,
    format_enough,
    last_until,
    narrow_intervals,
)
from pipeline.estimation.evidence import learn_noise, tile_windows
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


def test_evidence_grows_to_that_of_the_name(fitted: Fitted) -> None:
    part, fit = fitted.problem.parts[0], fitted.fits[0]
    without = fit_model(fitted.problem, Model(HUSKY, tuple(e for e in MODEL.effects if e.id != "icr_offset")))
    before, after = without.fits[0].residual, fit.residual
    tiles = tile_windows(part)
    noise = learn_noise(tiles, part.channels, after[tiles.rows])
    seconds, t = grow_evidence(part, noise, before, after)
    assert t[-1] == pytest.approx(compare(noise, fit.weights, before, after).t)
    assert t[-1] > 2.0 * t[t.size // 6] > 0.0 or t[t.size // 6] == 0.0
    assert seconds[-1] == pytest.approx(180.0, abs=10.0)


def test_a_curve_counts_from_where_it_stays_below() -> None:
    curve = Curve(np.array([10.0, 20.0, 30.0, 40.0]), np.array([np.inf, 0.04, 0.06, 0.05]))
    assert last_until(curve, 0.05) == 40.0
    assert last_until(curve, 0.06) == 20.0
    assert np.isinf(last_until(curve, 0.04))


def test_what_stays_is_not_driven_away() -> None:
    seconds = np.arange(10.0, 210.0, 10.0)
    falling = Curve(seconds, np.sqrt(4.0 / seconds))
    assert extrapolate(falling, 0.1) == pytest.approx(400.0, rel=1e-6)
    stays = Curve(seconds, np.sqrt(4.0 / seconds + 0.09))
    assert np.isinf(extrapolate(stays, 0.29))
    assert extrapolate(stays, 0.32) == pytest.approx(4.0 / (0.32**2 - 0.09), rel=1e-6)


def _name(half: list[float]) -> Named:
    curve = Curve(10.0 * np.arange(1.0, len(half) + 1.0), np.array(half))
    value = Value(1.5, 1.5 - half[-1], 1.5 + half[-1], "1")
    return Named(
        "effective_track", {"k": value}, 0.5, (), (), corrected=False, path="command", selected=1.0,
        motion="", growth=Growth(None, {"k": curve}),
    )  # fmt: skip


def test_words_say_since_when_how_narrow_and_what_was_idle() -> None:
    idle = format_enough([_name([0.2, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05])])
    assert "effective_track.k known to 5 % after 20 s of 100 s" in idle
    assert "last 80 % of the drive narrowed no interval by more than a tenth" in idle
    vague = format_enough([_name([0.9, 0.6, 0.3])])
    assert "known to 0.3; more such driving does not narrow the interval" in vague
    # The least known is told; others may be known better, but not well.
    vaguer = format_enough([_name([0.9, 0.6, 0.3]), _name([0.9, 0.6, 0.5])])
    assert "known to 0.5 (1 more not known to 5 %)" in vaguer
    falling = _name((0.6 / np.sqrt(np.arange(1.0, 25.0))).tolist())
    # 240 s give 0.6 / sqrt(24), a twentieth of 1.5 takes 640 s: 400 s more.
    assert "known to 0.12; 7 more minutes of such driving for 5 %" in format_enough([falling])
    assert format_enough([]) == ""


def test_what_is_undetermined_is_not_known_to_anything() -> None:
    wide = _name([9.0, 4.0, 2.0])
    assert format_enough([wide]) == "1 parameter undetermined", "its interval is wider than its size"
    vague, bound = _name([0.9, 0.6, 0.3]), _name([0.9, 0.6, 0.3])
    at_bound = replace(bound, parameters={"k": replace(bound.parameters["k"], at_bound=True)})
    said = format_enough([vague, at_bound, wide])
    assert said.count("known to") == 1
    assert said.endswith("; 2 parameters undetermined")


def test_a_run_that_is_too_short_promises_nothing_of_more_driving() -> None:
    brief = [{"id": BREVITY}]
    assert format_enough([_name([0.9, 0.6, 0.3])], brief) == "effective_track.k known to 0.3"
    idle = _name([0.2, *[0.05] * 9])
    assert format_enough([idle], brief) == "effective_track.k known to 5 % after 20 s of 100 s"
