"""How large a hidden effect is drawn."""

import math

import numpy as np

from pipeline.simulate import Scenario


def draw_size(effect: str, scenario: Scenario, share: float, draw: np.random.Generator) -> dict[str, float]:
    """Parameters of an effect: magnitudes of METHODS, section 4, times ``share``, signs drawn where free."""
    vehicle = scenario.vehicle
    sign = float(draw.choice([-1.0, 1.0]))
    size = share * float(draw.uniform(0.8, 1.2))
    speed = vehicle.max_speed_mps * scenario.program.speed_scale
    turn = vehicle.max_turn_radps * scenario.program.turn_scale
    rim = speed + 0.5 * vehicle.track_width_m * turn
    wheel = rim / vehicle.wheel_radius_m
    small = min(speed, 1.0)
    sizes: dict[str, dict[str, float]] = {
        "wheel_radius": {"k": 1.0 + sign * 0.09 * size},
        "wheel_asymmetry": {"e": sign * 0.05 * size},
        "effective_track": {"k": 1.0 + 0.8 * size},
        "icr_offset": {"x_icr": sign * 0.14 * size},
        "icr_lateral": {"y_icr": sign * 0.1 * size},
        "lateral_skid": {"c": 0.1 * size},
        "speed_slip": {"k": min(0.1 * size, 0.2 * size / speed)},
        "turning_resistance": {"k": min(0.24 * size, 0.35 * size / max(turn, 0.1))},
        "slope_slip": {"k": 1.2 * size},
        "slope_creep": {"c": 0.6 * size},
        "side_slope_slip": {"k": 0.6 * size},
        "side_slope_creep": {"c": 0.6 * size},
        "side_slope_turn": {"k": sign * 0.4 * size},
        "grade_load": {"k": 0.6 * size * speed},
        "lateral_drift": {"c": sign * 0.06 * size * small},
        "yaw_drift": {"c": sign * 0.07 * size},
        "speed_track": {"k": sign * 0.15 * size / speed},
        "time_drift": {"k": 0.15 * size},
        "terrain_change": {"k_v": 1.0 - 0.2 * size, "k_w": 1.0 - 0.25 * size},
        "drive_lag": {"tau": 0.6 * size},
        "turn_lag": {"tau_mean": 0.3 * size, "tau_diff": 1.1 * size},
        "transport_delay": {"d": 0.25 * size},
        "body_speed_limit": {"limit": (1.0 - 0.4 * size) * speed},
        "body_turn_limit": {"limit": (1.0 - 0.4 * size) * turn},
        "turn_droop": {
            "threshold": 0.4 * vehicle.track_width_m * turn / vehicle.wheel_radius_m,
            "gain": 1.0 - 0.6 * size,
        },
        "acceleration_limit": {"limit": wheel / (2.0 * size)},
        "wheel_speed_limit": {"limit": (1.0 - 0.4 * size) * wheel},
        "wheel_speed_scaling": {"limit": (1.0 - 0.4 * size) * wheel},
        "deadband": {"d": 0.2 * size * small},
        "body_inertia": {"tau": 0.5 * size},
        "contact_friction": {"friction": 0.2 / size, "creep": 0.5, "k": 1.3 + 0.7 * size, "gyration": 1.2},
        "tyre_torsion": {"tau": 0.14 * size, "damping": 0.2},
        "heading_skew": {"d": 0.12 * size},
        "yaw_misalignment": {"psi": sign * math.radians(3.5) * size},
        "lever_arm": {"l_x": 0.2 * size, "l_y": sign * 0.1 * size},
        "clock_offset": {"d": -0.2 * size},
        "steering_offset": {"o": sign * 0.04 * size},
        "steering_sensor_offset": {"o": sign * 0.04 * size},
        "steering_gain": {"g": 1.0 - 0.15 * size},
        "steering_lag": {"tau": 0.4 * size},
        "effective_wheelbase": {"k": 1.0 + sign * 0.12 * size},
        "understeer": {"K": 0.035 * size},
        "steering_play": {"g": 0.05 * size},
        "steering_sensor_play": {"g": 0.05 * size},
        "steering_rate_limit": {"limit": 0.35 / size},
        "reversal_pause": {"d": 0.4 * size},
        "wheel_servo": {
            "tau": 0.2 * size,
            "reset": 0.4,
            "drag": 0.05 * size * speed,
            "bound": 0.5 * rim / size,
            "no_load": 1.5 * rim,
            "scrub": 0.4 * size * rim,
            "creep": 0.07,
        },
        "torque_limit": {"tau": 0.3 * size, "limit": wheel / (1.5 * size)},
        "brake_lag": {"tau_drive": 0.6 * size, "tau_brake": 0.2 * size},
        "body_acceleration_limit": {"limit": speed / (2.0 * size)},
        "turn_acceleration_limit": {"limit": turn / (2.0 * size)},
        "drive_gain": {"g": 1.0 - 0.1 * size},
        "load_droop": {"d": 0.06 * size * small},
        "gain_drift": {"k": 0.15 * size},
        "difference_gain": {"g": 1.0 - 0.4 * size},
        "side_gain": {"e": sign * 0.06 * size},
        "motor_imbalance": {"e": sign * 0.2 * size},
        "side_lag": {"tau_left" if sign > 0.0 else "tau_right": 0.5 * size},
    }
    if effect not in sizes:
        what = f"{effect} has no size here"
        raise KeyError(what)
    return sizes[effect]
