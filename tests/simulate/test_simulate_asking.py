"""What may be asked for, and the one clear line that answers a wrong question."""

import tomllib
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.simulate import (
    SLOPE_EFFECTS,
    VEHICLES,
    Ground,
    Program,
    Scenario,
    find_case,
    find_vehicle,
    list_cases,
    make_scenario,
    simulate_run,
)
from pipeline.simulate.facts import find_layout, open_stream
from pipeline.simulate.programs import hold_on_grid, lag_signal, limit_rate, make_commands
from pipeline.simulate.scenario import ProgramName


def test_a_vehicle_has_the_geometry_of_the_preset_that_its_logs_name() -> None:
    for vehicle in VEHICLES.values():
        preset = Path(__file__).parents[2] / "pipeline" / "sources" / "presets" / f"{vehicle.name}.toml"
        numbers = tomllib.loads(preset.read_text())
        assert numbers["kind"] == vehicle.kind
        assert numbers["wheel_radius_m"] == vehicle.wheel_radius_m
        assert numbers["track_width_m"] == vehicle.track_width_m
        if vehicle.kind == "ackermann":
            assert numbers["wheelbase_m"] == vehicle.wheelbase_m


def test_changes_are_added_to_a_case() -> None:
    scenario = make_scenario(
        "husky_tile", {"lateral_skid": 0.1, "effective_track": 1.5}, seed=5, duration_s=60.0
    )
    assert scenario.effects == {
        **find_case("husky_tile").scenario.effects,
        "lateral_skid": 0.1,
        "effective_track": 1.5,
    }
    assert (scenario.seed, scenario.duration_s) == (5, 60.0)


def test_an_empty_effect_means_its_usual_size() -> None:
    assert make_scenario(None, {"icr_offset": {}}).effects["icr_offset"] == {"x_icr": 0.12}


def test_an_effect_of_slopes_brings_hills_along() -> None:
    for name in [*SLOPE_EFFECTS, "grade_load"]:
        assert make_scenario(None, {name: 0.5}).ground.hill_m > 0.0
        assert make_scenario(None, {}).ground == Ground()


def test_a_case_keeps_its_slope() -> None:
    assert make_scenario("jackal_slope").ground == find_case("jackal_slope").scenario.ground


def test_a_vehicle_brings_a_layout_that_fits() -> None:
    for name, vehicle in VEHICLES.items():
        scenario = make_scenario(None, vehicle=name)
        assert find_layout(scenario.recording.layout, vehicle).kind == vehicle.kind
    assert find_vehicle("husky_a200") is find_vehicle("husky")


def test_every_case_can_be_made() -> None:
    names = [case.name for case in list_cases()]
    assert {"husky_tile", "warthog_ice", "ackermann_gravel"} <= set(names)
    assert len(set(names)) == len(names)
    for case in list_cases():
        run = simulate_run(replace(case.scenario, duration_s=12.0))
        assert run.poses.stamp_s.size > 50


def test_programs_stay_inside_the_command_space_and_repeat() -> None:
    for name, vehicle in [
        pair
        for pair in product(get_args(ProgramName), ("husky", "car", "youbot"))
        if pair != ("spins", "car")
    ]:
        machine = VEHICLES[vehicle]
        program = Program(name, jitter_s=0.004, speed_scale=0.8, turn_scale=0.5)  # type: ignore[arg-type]
        first, second = (
            make_commands(program, machine, duration_s=120.0, generator=open_stream(3, "program"))
            for _ in range(2)
        )
        assert first.time_s.tobytes() == second.time_s.tobytes()
        assert first.speed_mps.tobytes() == second.speed_mps.tobytes()
        assert (np.diff(first.time_s) > 0.0).all()
        assert np.abs(first.speed_mps).max() <= 0.8 * machine.max_speed_mps + 1e-12
        assert np.abs(first.turn).max() <= 0.5 * max(machine.max_turn_radps, machine.max_steering_rad) + 1e-12
        assert first.speed_mps.any() or first.turn.any()
        assert np.abs(first.sideways).max() <= 0.8 * machine.max_sideways_mps + 1e-12
        assert (first.sideways_mps is None) == (vehicle != "youbot")
        resting = (first.time_s < 1.9) | (first.time_s > 118.1)
        assert not first.speed_mps[resting].any()
        assert not first.turn[resting].any()


def test_drive_steps_cover_the_space_both_ways_in_steps_of_six_seconds() -> None:
    commands = make_commands(
        Program(), VEHICLES["husky"], duration_s=600.0, generator=open_stream(0, "program")
    )
    for drawn in (commands.speed_mps, commands.turn):
        assert drawn.min() < -0.85
        assert drawn.max() > 0.85
        changes = commands.time_s[1:][np.diff(drawn) != 0.0][1:-1]
        np.testing.assert_allclose(np.diff(changes), 6.0, atol=1e-9)


def test_special_programs_do_what_they_are_called() -> None:
    def draw(name: str) -> tuple[np.ndarray, np.ndarray]:
        program = Program(name)  # type: ignore[arg-type]
        made = make_commands(
            program, VEHICLES["husky"], duration_s=120.0, generator=open_stream(1, "program")
        )
        live = (made.time_s > 2.1) & (made.time_s < 117.9)
        return made.speed_mps[live], made.turn[live]

    assert not draw("straight")[1].any()
    assert not draw("spins")[0].any()
    assert np.ptp(draw("circle")[0]) == np.ptp(draw("circle")[1]) == 0.0
    assert np.ptp(draw("slalom")[0]) == 0.0 < np.ptp(draw("slalom")[1])
    assert np.mean(draw("stop_and_go")[0] == 0.0) == pytest.approx(0.5, abs=0.06)
    assert draw("teleop")[0].size < draw("smooth")[0].size
    assert np.unique(np.round(draw("teleop")[0] * 32, 9) % 1.0).tolist() == [0.0]
    assert np.abs(np.diff(draw("ramps")[0])).max() < 0.02


TIMES = st.lists(st.floats(0.0, 0.5), min_size=1, max_size=12, unique=True).map(sorted)


@settings(max_examples=60, deadline=None)
@given(times=TIMES, delay=st.floats(0.0, 0.2), data=st.data())
def test_held_signals_keep_their_integral(times: list[float], delay: float, data: st.DataObject) -> None:
    values = np.array(data.draw(st.lists(st.floats(-5, 5), min_size=len(times), max_size=len(times))))
    cells = hold_on_grid(np.array(times), values, delay_s=delay, step_s=0.01, cell_count=100)
    ends = np.append(np.array(times) + delay, 1.0)
    assert cells.sum() * 0.01 == pytest.approx(float(np.sum(values * np.diff(ends))), abs=1e-9)
    assert np.abs(cells).max() <= np.abs(values).max() + 1e-9


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), limit=st.floats(0.1, 50.0))
def test_a_limited_rate_never_exceeds_its_limit(seed: int, limit: float) -> None:
    signal = np.random.default_rng(seed).standard_normal(300).cumsum()
    followed = limit_rate(signal, per_second=limit, step_s=0.01)
    assert np.abs(np.diff(followed, prepend=0.0)).max() <= limit * 0.01 * (1.0 + 1e-9)


def test_a_lag_does_not_depend_on_the_step() -> None:
    fine = lag_signal(np.ones(4000), tau_s=0.3, step_s=0.0005)
    coarse = lag_signal(np.ones(400), tau_s=0.3, step_s=0.005)
    np.testing.assert_allclose(fine.reshape(-1, 10).mean(axis=1), coarse, atol=3e-5)


def test_the_integration_step_does_not_matter() -> None:
    effects = {"effective_track": 1.8, "drive_lag": 0.4, "body_inertia": 0.3, "lateral_skid": 0.1}
    ends = [
        simulate_run(Scenario(effects=effects, duration_s=60.0, step_s=step)).truth.path.position[-1]
        for step in (0.0005, 0.001, 0.005)
    ]
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-4)
    np.testing.assert_allclose(ends[2], ends[0], atol=2e-3)
