"""Logs whose effects a rise of some other error kept from a name: each kind drawn anew, and named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from few import few
from motion_runs import as_run, vehicle_of

from pipeline.estimation import Input, choose_input
from pipeline.estimation.decision import Search
from pipeline.estimation.estimation_data import prepare_data
from pipeline.estimation.model_state import ModelState
from pipeline.simulate import VEHICLES, Disturbance, Program, Scenario, simulate_run

_USUAL = Disturbance(0.02, 0.03)


def _delay_steering(draw: np.random.Generator, seed: int) -> Scenario:
    """The heading fell from 41 to .08 degrees, and the position rose by some hundredths of a millimetre."""
    effects = {"steering_lag": draw.uniform(0.25, 0.4), "drive_lag": draw.uniform(0.2, 0.5)}
    program = Program(("smooth", "teleop", "drive_steps")[seed % 3])
    return Scenario(VEHICLES["car"], effects, program=program, duration_s=120.0, disturbance=_USUAL)


def _shrink_wheels(draw: np.random.Generator, _seed: int) -> Scenario:
    """One number over four minutes, the whole stretch, rose by chance."""
    effects = {"wheel_radius": draw.uniform(0.9, 0.95)}
    rough = Disturbance(0.03, 0.05)
    return Scenario(effects=effects, program=Program("stop_and_go"), duration_s=240.0, disturbance=rough)


def _understeer(draw: np.random.Generator, seed: int) -> Scenario:
    """An error rose until the offset was in, too."""
    sizes = {"understeer": (0.05, 0.15), "steering_offset": (0.02, 0.05), "drive_lag": (0.2, 0.4)}
    effects = {name: draw.uniform(*between) for name, between in sizes.items()}
    program = Program(("smooth", "teleop")[seed % 2])
    return Scenario(VEHICLES["car"], effects, program=program, duration_s=150.0, disturbance=_USUAL)


@pytest.mark.parametrize("seed", few(range(10), 5))
@pytest.mark.parametrize("draw", [_delay_steering, _shrink_wheels, _understeer])
def test_no_small_rise_keeps_what_is_there_from_a_name(
    draw: Callable[[np.random.Generator, int], Scenario], seed: int
) -> None:
    scenario = replace(draw(np.random.default_rng([7, seed]), seed), seed=900 + seed)
    run, vehicle = as_run(simulate_run(scenario)), vehicle_of(scenario.vehicle.name)
    source = choose_input([run], None, ()).source
    data = prepare_data([run], vehicle, source)
    ground, start = data, Input.COMMAND
    if data.has_encoders:
        ground, start = data.behind_wheels, Input.MEASURED
    found = Search(ground.paths[0], ground.list_candidates(start), data.conditions).run(ground.start_state())
    named = set(found.new)
    if data.has_encoders:
        state = ModelState((), found.final.state.timing)
        named |= set(Search(data.paths[1], data.list_drivetrain(), data.conditions).run(state).new)
    assert named == set(scenario.effects)
