"""Intervals: with the errors of clocks, and with what differs from block to block."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of
from msgspec.structs import replace

from pipeline.estimation import Estimates, EstimationData, Fitted, Input, estimate_intervals, fit_model
from pipeline.estimation.ambiguity import DETECTED, _find_detectable
from pipeline.estimation.decision import LEAST_T
from pipeline.estimation.fit import invert
from pipeline.models import Model, find_effect
from pipeline.results.reading import DETECTED_SHARE
from pipeline.simulate import VEHICLES, Disturbance, Program

if TYPE_CHECKING:
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.simulate import State

HUSKY = vehicle_of("husky_a200")


def fit(effects: object, *names: str, **more: object) -> Fitted:
    usual = {"duration_s": 60.0, "program": Program("teleop"), "disturbance": Disturbance(0.03, 0.05)}
    run = simulate(effects, **{**usual, **more})  # type: ignore[arg-type]
    model = Model(HUSKY, tuple(find_effect(name)() for name in names))
    return fit_model(EstimationData([run], HUSKY, Input.MEASURED), model, exact=True)


def test_errors_of_clocks_are_carried_into_the_numbers_that_they_move(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fitted = fit({"effective_track": 1.7}, "effective_track", "lateral_skid")
    path: PathResiduals = fitted.fits[0].path
    assert (path.list_clock_errors(fitted.state) > 0.0).all()

    def estimate(error_s: float) -> Estimates:
        monkeypatch.setattr(path, "list_clock_errors", lambda _: np.array([error_s]))
        return estimate_intervals(fitted)

    exact, usual, poor = (estimate(error) for error in (0.0, 0.02, 0.1))
    for label in ("effective_track.k", "lateral_skid.c", "timing.wheel_delay_s"):
        numbers = [one.find(label) for one in (exact, usual, poor)]
        assert numbers[0].clock_error == 0.0
        assert numbers[0].half < numbers[1].half < numbers[2].half
        for number in numbers[1:]:
            assert number.standard_error == pytest.approx(
                math.hypot(numbers[0].standard_error, number.clock_error)
            )
    assert not exact.find("timing.wheel_delay_s").trades_with_clock
    assert poor.find("timing.wheel_delay_s").trades_with_clock


def test_errors_of_a_track_that_was_estimated_are_carried() -> None:
    """A track that is known to a percent gives a factor on it that is known no better."""
    run = simulate({"effective_track": 1.7}, duration_s=60.0, program=Program("teleop"))

    def estimate(errors: dict[str, float]) -> Estimates:
        vehicle = replace(HUSKY, errors=errors)
        model = Model(vehicle, (find_effect("effective_track")(),))
        return estimate_intervals(
            fit_model(EstimationData([run], vehicle, Input.MEASURED), model, exact=True)
        )

    known, estimated = estimate({}), estimate({"track_width_m": 0.01 * (HUSKY.track_width_m or 1.0)})
    exact, carried = (one.find("effective_track.k") for one in (known, estimated))
    assert carried.value == exact.value
    expected = math.hypot(exact.standard_error, 0.01 * exact.value)
    assert carried.standard_error == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("truth", [{"steering_lag": 0.4356}, {"steering_rate_limit": 0.4}])
def test_when_a_steering_sensor_was_read_is_not_known(truth: dict[str, float], seed: int) -> None:
    """Speeds that jump between two readings tell a delay of 20 ms, which was taken for that of the angle."""
    car, ((name, value),) = vehicle_of("ackermann_car"), truth.items()
    run = simulate(truth, seed=seed, vehicle=VEHICLES["car"], program=Program("drive_steps"))
    data = EstimationData([run], car, Input.COMMAND)
    fitted = fit_model(data, Model(car, (find_effect(name)(),)), exact=True)
    (number,) = (one for one in estimate_intervals(fitted).items if one.free.effect == name)
    assert number.low < value < number.high
    assert number.half < 0.1 * value


def _change_track(state: State) -> tuple[float, float, float]:
    """A track that is another one every forty seconds."""
    return 0.0, 0.0, 0.15 * state.w0 * float(np.sign(np.sin(state.t / 13.0)))


def test_a_number_that_differs_from_block_to_block_has_a_wider_interval() -> None:
    widths = {}
    for name, extra in (("one", None), ("several", _change_track)):
        fitted = fit({"effective_track": 1.6}, "effective_track", duration_s=200.0, extra=extra)
        (ground,) = fitted.fits
        plain = math.sqrt(ground.overdispersion * invert(ground.normal)[0, 0])
        widths[name] = estimate_intervals(fitted).find("effective_track.k").standard_error / plain
    assert widths["one"] < 1.6
    assert widths["several"] > 2.0


def test_a_detection_threshold_is_the_size_that_is_named_in_nine_of_ten_logs() -> None:
    assert round(100.0 * NormalDist().cdf(DETECTED - LEAST_T)) == DETECTED_SHARE
    usual = find_effect("lateral_skid")(c=0.1)
    least = usual.parameters[0].least
    for standard_errors, size in ((10.0 * DETECTED, 0.01), (2.0 * DETECTED, 0.05), (0.5 * DETECTED, 0.2)):
        (found,) = _find_detectable(usual, standard_errors)
        # What is too small for a name is never said to be seen.
        assert found.size == pytest.approx(max(size, least.size if least else 0.0))
    assert _find_detectable(find_effect("body_speed_limit")(limit=1.0), 10.0) == []
