"""Runs fitted together, each weighed by its own misfit."""

from dataclasses import replace

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input
from pipeline.estimation.fit import fit_path
from pipeline.estimation.path_residuals import weigh_runs
from pipeline.models import find_effect
from pipeline.simulate import VEHICLES, Program

WARTHOG = vehicle_of("warthog")
HIDDEN = {
    "tau": 0.2, "reset": 0.3, "drag": 0.06, "bound": 1.3, "no_load": 5.0, "scrub": 1.2, "creep": 0.07
}  # fmt: skip


def make_problem() -> EstimationData:
    """A gentle run, which never needs all force, and a fast one that hides nothing of it."""
    programs = (Program("smooth", speed_scale=0.2, turn_scale=0.25), Program("smooth"))
    runs = [
        simulate(
            {"wheel_servo": HIDDEN}, duration_s=90.0, vehicle=VEHICLES["warthog"], program=program, seed=seed
        )
        for seed, program in enumerate(programs)
    ]
    return EstimationData(runs, WARTHOG, Input.COMMAND)


@pytest.mark.long
def test_a_servo_comes_back_from_a_gentle_and_a_fast_run() -> None:
    data = make_problem()
    drive = data.paths[1]
    start = {
        "tau": 0.25,
        "reset": 0.2,
        "drag": 0.04,
        "bound": 1.6,
        "no_load": 7.0,
        "scrub": 1.0,
        "creep": 0.1,
    }
    begun = find_effect("wheel_servo")(**start)
    fit = fit_path(drive, data.start_state([begun]))
    (found,) = fit.state.effects
    # As likely as from the truth within two steps that are not worth taking.
    true = fit_path(drive, data.start_state([find_effect("wheel_servo")(**HIDDEN)]))
    assert fit.score <= true.score + 0.1
    for name in ("tau", "reset", "scrub", "bound", "no_load"):
        assert found.values[name] == pytest.approx(HIDDEN[name], rel=0.2), name


def test_a_run_that_counts_less_leaves_the_number_to_the_others() -> None:
    runs = [
        simulate({"drive_lag": tau}, duration_s=60.0, vehicle=VEHICLES["warthog"], program=Program("smooth"))
        for tau in (0.3, 0.6)
    ]
    drive = EstimationData(runs, WARTHOG, Input.COMMAND).paths[1]
    start = EstimationData(runs, WARTHOG, Input.COMMAND).start_state([find_effect("drive_lag")(tau=0.45)])

    def fit(*shares: float) -> float:
        found = fit_path(weigh_runs(drive, np.array(shares)), start)
        assert np.isfinite(found.noise.scale[1, 2]).all()
        return found.state.effects[0].values["tau"]

    assert fit(1.0, 1.0) == fit_path(drive, start).state.effects[0].values["tau"]
    assert fit(1.0, 0.1) == pytest.approx(0.3, abs=0.03)
    assert fit(0.1, 1.0) == pytest.approx(0.6, abs=0.03)


def test_a_gentle_run_counts_as_much_as_a_fast_one() -> None:
    """What no lag explains is larger where it is driven faster, and so is what a lag does."""
    runs = [
        simulate(
            {"transport_delay": 0.25}, duration_s=60.0, vehicle=VEHICLES["warthog"],
            program=Program("smooth", speed_scale=scale, turn_scale=scale),
        )
        for scale in (0.2, 1.0)
    ]  # fmt: skip
    drive = EstimationData(runs, WARTHOG, Input.COMMAND).paths[1]
    state = EstimationData(runs, WARTHOG, Input.COMMAND).start_state([find_effect("drive_lag")(tau=0.3)])
    white = fit_path(drive, state).white
    gentle, fast = (float((white.columns[drive.run[white.rows] == run] ** 2).sum()) for run in range(2))
    # Weighed alike they would say of it as the squares of their speeds, 1 to 25.
    assert gentle > 0.3 * fast


def test_a_number_of_the_ground_is_one_on_each_ground_and_the_vehicles_is_one_on_all() -> None:
    grounds = {"gravel": (1.6, 0.3), "ice": (2.4, 0.3)}
    runs = [
        replace(
            simulate(
                {"effective_track": {"k": k}, "turn_lag": {"tau_diff": tau}}, duration_s=60.0, seed=seed,
                vehicle=VEHICLES["warthog"],
            ),
            terrain=terrain,
        )
        for seed, terrain in enumerate(("gravel", "gravel", "ice"))
        for k, tau in [grounds[terrain]]
    ]  # fmt: skip
    data = EstimationData(runs, WARTHOG, Input.COMMAND)
    body, drive = data.paths
    track = fit_path(body, data.start_state([find_effect("effective_track")(k=1.8)]))
    found = [dict(track.state.own[run])["effective_track", "k"] for run in range(3)]
    assert found[0] == found[1]
    assert found == pytest.approx([1.6, 1.6, 2.4], rel=0.01)
    lag = fit_path(drive, data.start_state([find_effect("turn_lag")(tau_diff=0.5)]))
    assert not lag.state.own
    assert lag.state.effects[0].values["tau_diff"] == pytest.approx(0.3, abs=0.02)
