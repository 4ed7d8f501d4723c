"""All continuous effects at once: the vectorised physics against a general differential equation solver."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.simulate import Ground, Program, Scenario, simulate_run

TRACK, RADIUS = 0.55, 0.165
EFFECTS = {
    "drive_lag": 0.35,
    "turn_lag": {"tau_mean": 0.15, "tau_diff": 0.8},
    "wheel_radius": 0.95,
    "wheel_asymmetry": 0.04,
    "effective_track": 1.7,
    "body_inertia": 0.4,
    "lateral_skid": 0.08,
    "speed_slip": 0.06,
    "turning_resistance": 0.2,
    "slope_creep": 0.5,
    "slope_slip": 0.3,
    "side_slope_creep": 0.4,
    "side_slope_slip": 0.2,
    "side_slope_turn": 0.1,
    "icr_offset": 0.1,
    "icr_lateral": -0.05,
    "transport_delay": 0.123,
    "time_drift": 0.1,
}
PITCH = 0.12
DURATION = 40.0


def change(time: float, state: np.ndarray, asked: tuple[float, float]) -> list[float]:
    """The same physics, written as one differential equation of ten numbers."""
    left_wheel, right_wheel, mean, difference, z_x, z_y, w, *_, yaw = state
    asked_left, asked_right = ((asked[0] + sign * 0.5 * TRACK * asked[1]) / RADIUS for sign in (-1.0, 1.0))
    left, right = mean - difference / 2, mean + difference / 2
    rim_left, rim_right = 0.95 * RADIUS * 0.98 * left, 0.95 * RADIUS * 1.02 * right
    fade = 1.0 - 0.1 * time / DURATION
    v0 = fade * (rim_left + rim_right) / 2
    w0 = fade * (rim_right - rim_left) / (1.7 * TRACK)
    turning = RADIUS * max(abs(left), abs(right)) > 0.01
    ahead, aside = np.sin(PITCH) * np.cos(yaw), -np.sin(PITCH) * np.sin(yaw)
    v_w = w + 0.1 * v0 * aside
    v_x = z_x - 0.06 * v0 * abs(v0) - 0.2 * v0 * abs(w0) - 0.05 * v_w
    v_x += (0.5 * turning + 0.3 * abs(v0)) * ahead
    v_y = z_y - 0.08 * v0 * w0 - 0.1 * v_w + (0.4 * turning + 0.2 * abs(v0)) * aside
    return [
        (asked_left - left_wheel) / 0.35,
        (asked_right - right_wheel) / 0.35,
        ((left_wheel + right_wheel) / 2 - mean) / 0.15,
        ((right_wheel - left_wheel) - difference) / 0.8,
        (v0 - z_x) / 0.4 + z_y * w,
        -z_y / 0.4 - z_x * w,
        (w0 - w) / 0.4,
        v_x * np.cos(yaw) - v_y * np.sin(yaw),
        v_x * np.sin(yaw) + v_y * np.cos(yaw),
        v_w,
    ]


def test_all_continuous_effects_together_agree_with_a_general_solver() -> None:
    scenario = Scenario(
        effects=EFFECTS,
        duration_s=DURATION,
        ground=Ground(pitch_rad=PITCH),
        program=Program(step_s=4.0),
        seed=9,
    )
    run = simulate_run(scenario)
    commands = run.truth.commands
    new = np.flatnonzero(np.diff(commands.speed_mps, prepend=0.0) != 0.0)
    edges = [0.0, *(commands.time_s[new] + 0.123).tolist(), DURATION]
    levels = [(0.0, 0.0), *zip(commands.speed_mps[new].tolist(), commands.turn[new].tolist(), strict=True)]
    state = np.zeros(10)
    for start, end, asked in zip(edges[:-1], edges[1:], levels, strict=True):
        solved = solve_ivp(change, (start, end), state, args=(asked,), rtol=1e-8, atol=1e-9, max_step=0.05)
        state = solved.y[:, -1]
    path = run.truth.path
    x, y, yaw = state[7:]
    in_plane = path.position[-1] / [np.cos(PITCH), 1.0, 1.0]
    # The path is some 15 m long; the threshold of turning wheels costs a fraction of a millimetre.
    assert in_plane[:2] == pytest.approx([x, y], abs=2e-3)
    turned = np.diff(path.time_s) @ path.velocity[:, 2]
    assert turned == pytest.approx(yaw, abs=2e-4)
