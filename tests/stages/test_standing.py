"""Time in which a vehicle stands, and is asked to, is no driving: no number rests on it."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from motion_runs import as_run, make_scenario, vehicle_of
from stage_logs import FIELD, TakeThrough

from pipeline.core import Floats
from pipeline.estimation import EstimationData, Input
from pipeline.estimation.driving_need import measure_driven
from pipeline.estimation.ladder import judge_whole
from pipeline.models import Model
from pipeline.simulate import Scenario, simulate_run
from pipeline.simulate.scenario import Commands
from pipeline.stages.inputs import Ideal
from pipeline.stages.slip_stage import aggregate_run, find_standing_share
from pipeline.stages.standing import mark_standing

STANDS_S = 120.0
"""The noise of a drive is another after it: medians differ by a seventh, and by ten times if it counts."""
TIMES = np.arange(0.0, 60.0, 0.05)


def mark(moved: Floats, **inputs: Floats) -> Floats:
    """Times [s] at which a body with this motion forward [m], and these inputs [m/s], stands."""
    speed = np.gradient(moved, TIMES)
    still, known = np.zeros_like(TIMES), np.zeros(TIMES.size, dtype=bool)
    velocities = pl.DataFrame({"t": TIMES, "segment": known.astype(np.int32), "v_x": speed})
    ideals = {
        name: Ideal(np.column_stack((one, still, still)), known, ~known) for name, one in inputs.items()
    }
    return TIMES[mark_standing(velocities.with_columns(v_y=0.0, v_w=0.0), ideals)]


def while_between(first: float, last: float, value: float) -> Floats:
    return value * ((first <= TIMES) & (last > TIMES))


STILL = np.zeros_like(TIMES)
NOISE = 0.01 * np.random.default_rng(1).standard_normal(TIMES.size)


@pytest.mark.parametrize(
    ("moved", "inputs"),
    [
        (STILL, {"command": while_between(20.0, 40.0, 0.5)}),
        (NOISE, {"command": while_between(20.0, 40.0, 0.5)}),
        (NOISE, {"command": STILL, "measured": while_between(20.0, 40.0, 0.3)}),
        (np.cumsum(while_between(20.0, 40.0, 0.05)) * 0.05, {"command": STILL, "measured": STILL}),
    ],
    ids=["commanded and stuck", "stuck, by noisy poses", "wheels turn", "body creeps"],
)
def test_what_is_commanded_or_moves_is_driving_and_all_else_stands(
    moved: Floats, inputs: dict[str, Floats]
) -> None:
    standing = mark(moved, **inputs)
    assert not ((standing > 20.0) & (standing < 40.0)).any()
    calm = TIMES[(TIMES < 17.0) | (TIMES > 43.0)]
    assert np.isin(calm, standing).all()


def test_a_stop_of_some_seconds_belongs_to_the_drive() -> None:
    stops = while_between(0.0, 28.0, 0.5) + while_between(31.5, 60.0, 0.5)
    assert mark(np.cumsum(stops) * 0.05, command=stops).size == 0


def delay(scenario: Scenario) -> Scenario:
    """The same drive after standing under commands of zero."""
    asked = simulate_run(scenario).commands
    late = Commands(
        np.concatenate((np.arange(0.0, STANDS_S, 0.1), asked.time_s + STANDS_S)),
        *(np.pad(one, (round(STANDS_S * 10.0), 0)) for one in (asked.speed_mps, asked.turn)),
    )
    return replace(scenario, played=late, duration_s=scenario.duration_s + STANDS_S)


def test_standing_before_a_drive_changes_no_median(drive: TakeThrough) -> None:
    numbers = []
    for scenario in (FIELD, delay(FIELD)):
        taken = drive(scenario)
        parts = taken.result.slip, taken.result.windows, taken.velocities
        made = aggregate_run(*parts, vehicle=taken.aligned.vehicle, length=1.0)
        numbers.append(made.filter(pl.col("subset") == "all"))
    assert find_standing_share(taken.result.slip, "command") == pytest.approx(2.0 / 3.0, abs=0.03)
    for name, tolerance in (("median_modulus", 0.2), ("median_window_norm", 0.2), ("duration", 0.05)):
        alone, after = (one[name].to_list() for one in numbers)
        assert after == pytest.approx(alone, rel=tolerance), name


def test_standing_before_a_drive_is_no_driving_to_diagnose_from() -> None:
    scenario = make_scenario({"effective_track": 1.8}, duration_s=60.0)
    alone, after = (
        EstimationData([as_run(simulate_run(one))], vehicle_of("husky_a200"), Input.COMMAND)
        for one in (scenario, delay(scenario))
    )
    assert measure_driven(after)[0] == pytest.approx(measure_driven(alone)[0], abs=3.0)
    context = after.residuals_by_run[0].context
    assert context.start_s == pytest.approx(STANDS_S, abs=3.0)
    assert context.duration_s == pytest.approx(scenario.duration_s, abs=3.0)
    errors = [judge_whole(one, Model(one.vehicle)).errors for one in (alone, after)]
    assert errors[1].t_mrmse_m == pytest.approx(errors[0].t_mrmse_m, rel=0.15)
    assert errors[1].r_mrmse_rad == pytest.approx(errors[0].r_mrmse_rad, rel=0.15)
