"""Is the log long enough: curves end at what is stated, and say what a shorter log would have said."""

from dataclasses import replace

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Fitted, Input, estimate_intervals, fit_model
from pipeline.estimation.driving_need import narrow_intervals
from pipeline.estimation.intervals import estimate_path
from pipeline.models import Model, find_effect
from pipeline.run.windows import cut_run, find_driven

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": 1.7, "icr_offset": 0.1, "drive_lag": 0.3}
MODEL = Model(HUSKY, tuple(find_effect(name)() for name in TRUTH))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    return fit_model(
        EstimationData([simulate(TRUTH, duration_s=180.0)], HUSKY, Input.COMMAND), MODEL, exact=True
    )


def test_the_last_width_is_the_stated_interval(fitted: Fitted) -> None:
    stated = {item.free.label: 0.5 * (item.high - item.low) for item in estimate_intervals(fitted).items}
    curves = narrow_intervals(fitted)
    assert set(curves) == {"effective_track.k", "icr_offset.x_icr", "drive_lag.tau"}
    for label, curve in curves.items():
        assert curve.values[-1] == pytest.approx(stated[label], rel=1e-9)
        assert curve.values[0] > 1.5 * curve.values[-1]
        assert (np.diff(curve.seconds) > 0.0).all()
    # Independent blocks narrow with the square root of the time: four times as many to a half.
    falls = [curve.values[-1] / curve.values[curve.values.size // 4] for curve in curves.values()]
    assert 0.3 < np.exp(np.mean(np.log(falls))) < 0.75


def test_a_width_on_the_way_is_that_of_a_log_that_ended_there(fitted: Fitted) -> None:
    run = fitted.data.runs[0]
    short = EstimationData([cut_run(run, end_s=find_driven(run, 90.0))], HUSKY, Input.COMMAND)
    ended = narrow_intervals(fit_model(short, MODEL, exact=True))
    ratios = []
    for label, curve in narrow_intervals(fitted).items():
        place = np.searchsorted(curve.seconds, float(ended[label].seconds[-1]) - 3.5)
        ratios.append(curve.values[place] / ended[label].values[-1])
    assert np.all(np.abs(np.log(ratios)) < np.log(1.6))


def test_a_number_that_the_run_leaves_open_takes_no_other_along(fitted: Fitted) -> None:
    """Beside a column like that of a lag, a hundred millionth of its size."""
    fit = fitted.fits[1]
    faint = fit.columns * np.random.default_rng(3).normal(1.0, 0.1, fit.columns.shape)
    opened = replace(
        fit, free=(*fit.free, *fit.free), columns=np.concatenate((fit.columns, 1e-8 * faint), axis=2)
    )
    lag, _ = estimate_path(fit).items
    beside, _, *left_open = estimate_path(opened).items
    assert all(np.isnan(one.low) for one in left_open)
    assert beside.half == pytest.approx(lag.half, rel=0.01)
