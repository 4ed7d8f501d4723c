"""Limits agree with the measured wheels, and states of the drive begin where these are."""

import numpy as np
import polars as pl
import pytest
from few import few
from motion_runs import align, extract, make_scenario, simulate, vehicle_of

from pipeline.estimation import EstimationData, Input
from pipeline.estimation.path_residuals import WheelResiduals
from pipeline.models import Place, find_effect, list_effects
from pipeline.models.parameter import OVERSHOOT
from pipeline.run import load_run
from pipeline.simulate import VEHICLES, Program, simulate_run

HUSKY = vehicle_of("husky_a200")


def test_a_limit_is_searched_above_what_wheels_exceed() -> None:
    run = simulate({"wheel_speed_limit": 4.0}, duration_s=60.0)
    data = EstimationData([run], HUSKY, Input.COMMAND)
    assert data.exceeded["wheel"] == pytest.approx(4.0, rel=0.03)
    (path,) = (one for one in data.paths if isinstance(one, WheelResiduals))
    number, late = path.list_free(data.start_state([find_effect("wheel_speed_limit")(limit=4.0)]))
    assert number.bounds[0] == pytest.approx(data.exceeded["wheel"] / OVERSHOOT)
    lag, _ = path.list_free(data.start_state([find_effect("drive_lag")(tau=0.3)]))
    assert lag.bounds[0] == 0.0
    # What encoders report is up to two periods old; a jump after a reading seems half a period early.
    period = data.runs[0].wheel_period_s
    assert late.label == "timing.encoder_delay_s"
    assert late.bounds == pytest.approx((-0.5 * period, 2.0 * period))
    # A delay of the commands is that of the encoders, too.
    (delay,) = path.list_free(data.start_state([find_effect("transport_delay")(d=0.2)]))
    assert delay.label == "transport_delay.d"


@pytest.mark.parametrize(
    ("name", "values"),
    few([("acceleration_limit", {"limit": 6.0}), ("torque_limit", {"tau": 0.4, "limit": 6.0})], 2),
)
def test_four_wheels_that_turn_against_each_other_go_on_where_a_prediction_begins(
    name: str, values: dict[str, float]
) -> None:
    """Errors of the heading over 2 s were 36 times as large as without the limit."""
    youbot, errors = vehicle_of("youbot"), []
    for effects in ({}, {name: values}):
        run = simulate(effects, vehicle=VEHICLES["youbot"], duration_s=60.0)
        data = EstimationData([run], youbot, Input.COMMAND)
        (run_residuals,), state = data.residuals_by_run, data.start_state()
        known = [find_effect(key)(**numbers) for key, numbers in effects.items()]
        found = run_residuals.find_horizon_errors(known, state.timing[0])
        errors.append(float(np.sqrt(np.mean(found.yaw**2))))
    assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize(
    ("name", "values"), [("steering_lag", {"tau": 0.6}), ("steering_rate_limit", {"limit": 0.2})]
)
def test_after_a_gap_a_car_goes_on_with_the_measured_steering(name: str, values: dict[str, float]) -> None:
    """The steering [rad] began at the speed of the left wheel [rad/s]: 100 rad/s of wrong yaw rate."""
    half_speed, car = Program(speed_scale=0.5), vehicle_of("ackermann_car")
    made = simulate_run(make_scenario({name: values}, vehicle=VEHICLES["car"], program=half_speed))
    whole = extract(made, car)
    times, steering = whole["wheels"]["t"].to_numpy(), whole["wheels"]["steering"].to_numpy()
    middle = (times > 30.0) & (times < 100.0)
    end = float(times[np.argmax(np.abs(np.gradient(steering**2, times)) * middle)])
    outside = (pl.col("t") < end - 10.0) | (pl.col("t") > end)
    cut = {key: table.filter(outside) for key, table in whole.items()}
    rates = []
    for tables in (whole, cut):
        data = EstimationData([load_run(align(tables, car), car, name="cut")], car, Input.COMMAND)
        (run_residuals,), timing = data.residuals_by_run, data.start_state().timing[0]
        velocity = run_residuals.predict_velocity([find_effect(name)(**values)], timing)
        rates.append((run_residuals.grid.times, velocity.w))
    assert run_residuals.grid.starts.size == 2
    after = (run_residuals.grid.times > end) & (run_residuals.grid.times < end + 20.0)
    expected = np.interp(run_residuals.grid.times[after], *rates[0])
    error, size = rates[1][1][after] - expected, np.sqrt(np.mean(expected**2))
    assert np.abs(steering[np.searchsorted(times, end)]) > 0.1
    assert np.sqrt(np.mean(error**2)) < 0.05 * size


@pytest.mark.parametrize("name", ["drive_gain", "gain_drift", "difference_gain", "side_gain"])
def test_gains_come_before_what_begins_at_the_measured_wheels(name: str) -> None:
    """A gain behind a ramp scaled the measured speed with which the ramp begins."""
    gain = find_effect(name)
    later = [effect for effect in list_effects() if effect.place is Place.DRIVE and effect.has_state]
    assert len(later) > 5
    assert all(effect.rank > gain.rank for effect in later)
