"""What Unitree's wheel-legged robots publish; see `platform_table`."""

from __future__ import annotations

from pipeline.simulate.platforms import Platform, odometry
from pipeline.simulate.published import Json, Published, Q
from pipeline.simulate.vehicles import Vehicle

_GO2_W = Vehicle("go2_w", "differential", 0.086, 0.404, 0.387, 1.5, max_turn_radps=2.0)
_STILL, _LEFT, _RIGHT = Q("zero"), Q("left"), Q("right")
_MOTORS = (*(_STILL,) * 12, _RIGHT, _LEFT, _RIGHT, _LEFT, *(_STILL,) * 4)

UNITREE_PLATFORMS: dict[str, Platform] = {
    # unitreerobotics/unitree_ros2: README.md, unitree_api/msg, unitree_go/msg, ros2_sport_client.cpp
    "go2_w": Platform(
        _GO2_W,
        (
            Published(
                "/api/sport/request",
                "unitree_api/msg/Request",
                "command",
                {
                    "header.identity.api_id": 1008.0,
                    "parameter": Json({"x": Q("speed"), "y": Q("sideways"), "z": Q("yaw_rate")}),
                },
                stamp="none",
            ),
            # The service is asked for other things as well: 1007 leans the body, with keys of the same names.
            Published(
                "/api/sport/request",
                "unitree_api/msg/Request",
                "once",
                {"header.identity.api_id": 1007.0, "parameter": '{"x": 0.3, "y": 0.0, "z": 0.5}'},
                stamp="none",
            ),
            Published(
                "/lf/lowstate",
                "unitree_go/msg/LowState",
                "wheels",
                {
                    "motor_state[].dq": _MOTORS,
                    "imu_state.gyroscope": tuple(Q(f"rate_{axis}") for axis in "xyz"),
                    "imu_state.accelerometer": tuple(Q(f"force_{axis}") for axis in "xyz"),
                },
                stamp="none",
            ),
            Published(
                "/sportmodestate",
                "unitree_go/msg/SportModeState",
                "filter",
                {
                    "position": (Q("x"), Q("y"), Q("z")),
                    "imu_state.quaternion": (Q("qw"), Q("qx"), Q("qy"), Q("qz")),
                    "velocity": (Q("speed"), Q("sideways"), Q("sideways", 0.0)),
                    "yaw_speed": Q("yaw_rate"),
                },
                stamp="stamp",
            ),
            odometry("/Odometry", "localization", "camera_init", "body"),
        ),
    ),
}
