"""What platforms on mecanum wheels publish; see `platform_table`."""

from __future__ import annotations

from pipeline.simulate.drivetrain import CORNERS
from pipeline.simulate.platforms import Platform, describe, imu, mecanum_joints, odometry, transform, twist
from pipeline.simulate.vehicles import VEHICLES, Vehicle

_SHORT = ("fl", "fr", "rl", "rr")
_DO100 = Vehicle(
    "do100",
    "mecanum",
    0.05,
    0.4208,
    0.57,
    1.0,
    max_turn_radps=1.5,
    max_sideways_mps=1.0,
    controller_track_multiplier=2.0186,
)
_ROSBOT_XL = Vehicle(
    "rosbot_xl",
    "mecanum",
    0.04935,
    0.27,
    0.17,
    0.8,
    max_turn_radps=2.0,
    max_sideways_mps=0.8,
    controller_track_multiplier=0.95,
)
_R100 = Vehicle(
    "r100",
    "mecanum",
    0.0759,
    0.551,
    0.638,
    1.0,
    max_turn_radps=1.5,
    max_sideways_mps=1.0,
    controller_track_multiplier=0.9924,
)
_YOUBOT = VEHICLES["youbot"]


def _clearpath(model: str, vehicle: Vehicle) -> Platform:
    # clearpathrobotics/clearpath_common: control.launch.py, localization.launch.py
    space = f"/{model}_0042"
    return Platform(
        vehicle,
        (
            twist(f"{space}/platform/cmd_vel_unstamped", sideways=True),
            twist(f"{space}/joy_teleop/cmd_vel", source="wish", sideways=True),
            mecanum_joints(
                f"{space}/platform/joint_states", {place: f"{place}_wheel_joint" for place in CORNERS}
            ),
            odometry(f"{space}/platform/odom", "odometry", "odom", "base_link", sideways=True),
            odometry(f"{space}/platform/odom/filtered", "filter", "odom", "base_link", sideways=True),
            transform(f"{space}/tf", "filter", "odom", "base_link"),
            odometry(f"{space}/lidar/icp_odom", "localization", "map", "base_link"),
            imu(f"{space}/sensors/imu_0/data"),
            describe(f"{space}/robot_description", model, vehicle, "{}_wheel_joint", CORNERS),
        ),
    )


MECANUM_PLATFORMS: dict[str, Platform] = {
    # config/do100/control.yaml
    "dingo_o": _clearpath("do100", _DO100),
    # config/r100/control/omni_4wd.yaml: the sum .59 over .5945 of the description
    "ridgeback": _clearpath("r100", _R100),
    # husarion/rosbot_ros: ROS_API.md, rosbot_controller/config/rosbot_xl/mecanum_drive_controller.yaml
    "rosbot_xl_mecanum": Platform(
        _ROSBOT_XL,
        (
            twist("/cmd_vel", stamped=True, sideways=True),
            mecanum_joints(
                "/joint_states",
                {place: f"{short}_wheel_joint" for place, short in zip(CORNERS, _SHORT, strict=True)},
            ),
            odometry("/rosbot_base_controller/odom", "odometry", "odom", "base_link", sideways=True),
            odometry("/odometry/filtered", "filter", "odom", "base_link", sideways=True),
            transform("/tf", "filter", "odom", "base_link"),
            odometry("/slam/odom", "localization", "map", "base_link"),
            imu("/imu_broadcaster/imu"),
            describe("/robot_description", "rosbot_xl", _ROSBOT_XL, "{}_wheel_joint", CORNERS),
        ),
    ),
    # youbot/youbot_driver: config/youbot-base.cfg; joints of the youBot's robot description
    "youbot": Platform(
        _YOUBOT,
        (
            twist("/cmd_vel", sideways=True),
            mecanum_joints(
                "/joint_states",
                {
                    place: f"wheel_joint_{short}"
                    for place, short in zip(CORNERS, ("fl", "fr", "bl", "br"), strict=True)
                },
            ),
            odometry("/odom", "odometry", "odom", "base_footprint", sideways=True),
            transform("/tf", "odometry", "odom", "base_footprint"),
            transform("/tf", "correction", "map", "odom"),
            imu("/imu/data"),
            describe("/robot_description", "youbot", _YOUBOT, "wheel_joint_{}", CORNERS),
        ),
    ),
}
