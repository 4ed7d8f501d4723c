"""What the projects that people run declare: names of parameters, bounds of doubles, sizes of arrays."""

from __future__ import annotations

import math

DOUBLE = (-math.inf, math.inf)
POSITIVE = (1e-12, math.inf)
UP, DOWN = (0.0, math.inf), (-math.inf, 0.0)
ALL = "/**.ros__parameters."
FOLLOW = "controller_server.ros__parameters.FollowPath."
SMOOTHER = "velocity_smoother.ros__parameters."
DIFF = "diff_drive_controller.ros__parameters."
STEER = "ackermann_steering_controller.ros__parameters."
TRACTION = "traction_monitor.ros__parameters."
FILTER = "ekf_filter_node.ros__parameters."

# Names, and bounds of doubles or the number of entries, as the projects' own files declare them.
SCHEMAS: dict[str, dict[str, tuple[float, float] | int]] = {
    # ros-controls/ros2_controllers: diff_drive_controller/src/diff_drive_controller_parameter.yaml and
    # ackermann_steering_controller/src/ackermann_steering_controller.yaml, branches jazzy and master
    "ros2_control": {
        **{DIFF + name: POSITIVE for name in ("wheel_separation", "wheel_radius")},
        **{DIFF + f"{name}_multiplier": DOUBLE for name in ("wheel_separation", "left_wheel_radius")},
        DIFF + "right_wheel_radius_multiplier": DOUBLE,
        **{
            DIFF + f"{axis}.{name}": bounds
            for axis in ("linear.x", "angular.z")
            for name, bounds in (
                ("max_velocity", UP),
                ("min_velocity", DOWN),
                ("max_acceleration", UP),
                ("max_deceleration", DOWN),
            )
        },
        **{
            STEER + name: POSITIVE for name in ("wheelbase", "traction_track_width", "traction_wheels_radius")
        },
    },
    # ros-navigation/navigation2, branch lyrical: getParam of nav2_mppi_controller/src/optimizer.cpp, of
    # motion_models.hpp and critics/velocity_deadband_critic.cpp; declare_or_get_parameter of
    # nav2_regulated_pure_pursuit_controller/src/parameter_handler.cpp and nav2_velocity_smoother
    "nav2": {
        **{FOLLOW + f"model_delay_{axis}": UP for axis in ("vx", "wz")},
        **{FOLLOW + name: UP for name in ("vx_max", "wz_max", "ax_max", "az_max")},
        **{FOLLOW + name: DOWN for name in ("vx_min", "ax_min")},
        FOLLOW + "ackermann.min_turning_r": POSITIVE,
        FOLLOW + "VelocityDeadbandCritic.deadband_velocities": 3,
        **{FOLLOW + f"max_{axis}_{name}": UP for axis in ("linear", "angular") for name in ("vel", "accel")},
        **{FOLLOW + f"min_{axis}_vel": DOWN for axis in ("linear", "angular")},
        **{FOLLOW + f"max_{axis}_decel": DOWN for axis in ("linear", "angular")},
        **{SMOOTHER + name: 3 for name in ("max_velocity", "min_velocity", "max_accel", "max_decel")},
    },
    # our own: arguments of `trace_traction`
    "nav2_traction": {
        TRACTION + name: UP
        for name in (
            "usual_gain",
            "live",
            "margin",
            "window_s",
            "steady",
            "falls_s",
            "drop",
            "half",
            "lost",
            "excess",
            "dig_hold_s",
            "sudden_s",
            "hold_s",
        )
    },
    # autowarefoundation/autoware_universe: README of autoware_simple_planning_simulator,
    # control/autoware_mpc_lateral_controller/param/lateral_controller_defaults.param.yaml,
    # the README of autoware_pid_longitudinal_controller, and vehicle_info.param.yaml of sample_vehicle_launch
    "autoware": {
        **{ALL + name: POSITIVE for name in ("wheel_radius", "wheel_base", "wheel_tread", "max_steer_angle")},
        **{ALL + name: UP for name in ("input_delay", "vehicle_model_steer_tau", "delay_compensation_time")},
        **{
            ALL + f"{what}_{name}": UP
            for what in ("vel", "steer")
            for name in ("time_delay", "time_constant")
        },
        **{ALL + name: UP for name in ("vel_lim", "vel_rate_lim")},
        ALL + "steer_bias": DOUBLE,
    },
    # f1tenth/vesc, branch ros2: vesc_ackermann/src/ackermann_to_vesc.cpp; f1tenth/f1tenth_system: vesc.yaml
    "vesc": {
        ALL + "speed_to_erpm_gain": DOUBLE,
        ALL + "steering_angle_to_servo_gain": DOUBLE,
        ALL + "steering_angle_to_servo_offset": DOUBLE,
        "vesc_to_odom_node.ros__parameters.wheelbase": POSITIVE,
        "throttle_interpolator.ros__parameters.max_acceleration": UP,
    },
    # PX4/PX4-Autopilot: src/modules/rover_differential/module.yaml, src/modules/rover_ackermann/module.yaml,
    # src/lib/rover_control/rovercontrol_params.yaml; all of type float
    "px4": {
        "RD_WHEEL_TRACK": (0.0, 100.0),
        "RA_WHEEL_BASE": (0.0, 100.0),
        "RA_MAX_STR_ANG": (0.0, 1.5708),
        "RO_YAW_RATE_CORR": (0.01, 10000.0),
        "RO_MAX_THR_SPEED": (0.0, 100.0),
        "RO_SPEED_LIM": (-1.0, 100.0),
        "RO_YAW_RATE_LIM": (0.0, 10000.0),
        "RO_ACCEL_LIM": (-1.0, 100.0),
        "RO_DECEL_LIM": (-1.0, 100.0),
        "RO_YAW_ACCEL_LIM": (-1.0, 10000.0),
        "RO_YAW_DECEL_LIM": (-1.0, 10000.0),
    },
    # cra-ros-pkg/robot_localization 3.6.0: params/ekf.yaml; ros2_controllers as above
    "robot_localization": {
        FILTER + "odom0_config": 15,
        FILTER + "acceleration_limits": 6,
        FILTER + "deceleration_limits": 6,
        DIFF + "twist_covariance_diagonal": 6,
        STEER + "twist_covariance_diagonal": 6,
    },
    # gazebosim/gz-sim 11, src/systems: diff_drive/DiffDrive.hh and ackermann_steering/AckermannSteering.hh
    "gazebo": {
        **dict.fromkeys(("wheel_radius", "wheel_separation", "wheel_base", "steering_limit"), POSITIVE),
        **{
            f"{end}_{axis}{name}": bounds
            for end, bounds in (("min", DOWN), ("max", UP))
            for axis in ("", "linear_", "angular_")
            for name in ("velocity", "acceleration")
        },
    },
}
