"""What popular platforms publish, so that logs with exactly their topics, types and frames can be made.

Sources of names, types and geometry: the platforms' own repositories, named beside each.
"""

from __future__ import annotations

import math

from pipeline.simulate.errors import unknown_name
from pipeline.simulate.farm_ng_table import FARM_NG_PLATFORMS
from pipeline.simulate.mecanum_table import MECANUM_PLATFORMS
from pipeline.simulate.platforms import (
    Fields,
    Platform,
    describe,
    fix,
    ground_velocity,
    imu,
    joints,
    odometry,
    pose_fields,
    pose_with_covariance,
    transform,
    twist,
)
from pipeline.simulate.published import Published, Q, Source
from pipeline.simulate.unitree_table import UNITREE_PLATFORMS
from pipeline.simulate.vehicles import Vehicle

_TICKS = 508.8
_RPM = 60.0 / (2.0 * math.pi)
_RIGHT_FIRST = ("right", "left", "left", "right")
_SIDES = ("left", "right")
_FOUR = ("front_left", "front_right", "rear_left", "rear_right")
_CAR = ("rear_left", "rear_right", "steer_front_left", "steer_front_right")


def _clearpath(model: str, vehicle: Vehicle) -> Platform:
    # clearpathrobotics/clearpath_common: control.launch.py, localization.launch.py, twist_mux.yaml
    space = f"/{model}_0042"
    wheel = "{}_wheel_joint"
    return Platform(
        vehicle,
        (
            twist(f"{space}/platform/cmd_vel_unstamped"),
            twist(f"{space}/joy_teleop/cmd_vel", source="wish"),
            joints(f"{space}/platform/joint_states", wheel, _FOUR),
            odometry(f"{space}/platform/odom", "odometry", "odom", "base_link"),
            odometry(f"{space}/platform/odom/filtered", "filter", "odom", "base_link"),
            transform(f"{space}/tf", "filter", "odom", "base_link"),
            odometry(f"{space}/lidar/icp_odom", "localization", "map", "base_link"),
            imu(f"{space}/sensors/imu_0/data"),
            describe(f"{space}/robot_description", model, vehicle, wheel, _FOUR),
        ),
    )


def _turtlebot3(vehicle: Vehicle) -> Platform:
    # ROBOTIS-GIT/turtlebot3: turtlebot3_bringup/param, turtlebot3_description/urdf
    wheel = "wheel_{}_joint"
    return Platform(
        vehicle,
        (
            twist("/cmd_vel", stamped=True),
            twist("/cmd_vel_nav", stamped=True, source="wish"),
            joints("/joint_states", wheel, _SIDES),
            odometry("/odom", "filter", "odom", "base_footprint"),
            pose_with_covariance("/amcl_pose", 20),
            transform("/tf", "odometry", "odom", "base_footprint"),
            transform("/tf", "correction", "map", "odom"),
            imu("/imu"),
            describe("/robot_description", vehicle.name, vehicle, wheel, _SIDES),
        ),
    )


def _husarion(name: str, vehicle: Vehicle) -> Platform:
    # husarion/husarion_ugv_ros: ROS_API.md, husarion_ugv_controller/config
    wheel = "{}_wheel_joint"
    return Platform(
        vehicle,
        (
            twist(f"/{name}/cmd_vel", stamped=True),
            twist(f"/{name}/autonomous/cmd_vel", stamped=True, source="wish"),
            Published(
                f"/{name}/joint_states",
                "sensor_msgs/msg/JointState",
                "wheels",
                {
                    "name": [wheel.format(place) for place in ("fl", "fr", "rl", "rr")],
                    "position": tuple(Q(f"{side}_angle") for side in _SIDES * 2),
                    "velocity": tuple(Q(side) for side in _SIDES * 2),
                },
            ),
            odometry(f"/{name}/odometry/wheels", "odometry", f"{name}/odom", f"{name}/base_link"),
            odometry(f"/{name}/odometry/filtered", "filter", f"{name}/odom", f"{name}/base_link"),
            odometry("/kiss/odometry", "localization", "odom_lidar", "base_link"),
            fix(f"/{name}/gps/fix"),
            ground_velocity(f"/{name}/gps/vel"),
            imu(f"/{name}/imu/data"),
        ),
    )


def _vehicle(
    name: str, radius: float, track: float, base: float, speed: float, turn: float, multiplier: float = 1.0
) -> Vehicle:
    return Vehicle(
        name,
        "differential",
        radius,
        track,
        base,
        speed,
        max_turn_radps=turn,
        controller_track_multiplier=multiplier,
    )


def _car(name: str, radius: float, track: float, base: float, speed: float, steering: float) -> Vehicle:
    return Vehicle(name, "ackermann", radius, track, base, speed, max_steering_rad=steering)


def _px4_stamped(topic: str, kind: str, source: Source, fields: Fields) -> Published:
    return Published(f"/fmu/{topic}", f"px4_msgs/msg/{kind}", source, fields, stamp="timestamp")


_A200 = _vehicle("a200", 0.1651, 0.555, 0.512, 1.0, 1.0, 1.875)
_J100 = _vehicle("j100", 0.098, 0.37559, 0.262, 2.0, 2.0, 1.5)
_W200 = _vehicle("w200", 0.3, 1.08, 0.916, 5.0, 2.0, 1.5625)
_BURGER = _vehicle("turtlebot3_burger", 0.033, 0.16, 0.08, 0.22, 2.0)
_WAFFLE = _vehicle("turtlebot3_waffle", 0.033, 0.287, 0.1, 0.26, 1.8)
_CREATE3 = _vehicle("create3", 0.03575, 0.233, 0.1, 0.46, 1.9)
_SCOUT = _vehicle("scout_v2", 0.16459, 0.58306, 0.498, 1.5, 1.2)
_HUNTER = _car("hunter_v2", 0.165, 0.605, 0.65, 1.5, 0.45)
_SAMPLE = _car("sample_vehicle", 0.383, 1.64, 2.79, 8.0, 0.5)
_F1TENTH = _car("f1tenth", 0.0508, 0.2, 0.25, 4.0, 0.36)
_LEO = _vehicle("leo", 0.0625, 0.33, 0.3, 0.4, 1.0, 1.91)
_LINO = _vehicle("linorobot2", 0.07162, 0.271, 0.24, 0.5, 2.0)
_DUCK = _vehicle("duckiebot", 0.0318, 0.1, 0.1, 0.6, 4.0)
_PLAIN = _vehicle("diffbot", 0.1, 0.4, 0.3, 1.0, 1.5)
_BICYCLE = _car("ackermann_bot", 0.15, 0.6, 0.9, 2.0, 0.5)
_ROVER = _vehicle("px4_rover", 0.11, 0.45, 0.4, 1.5, 1.5)
_ROSBOT = _vehicle("rosbot", 0.0425, 0.186, 0.17, 0.9, 2.0, 1.45)
_WHEELED = "{}_wheel_joint"

PLATFORMS: dict[str, Platform] = {
    "husky_a200": _clearpath("a200", _A200),
    "jackal": _clearpath("j100", _J100),
    "warthog": _clearpath("w200", _W200),
    "turtlebot3_burger": _turtlebot3(_BURGER),
    "turtlebot3_waffle": _turtlebot3(_WAFFLE),
    # iRobotEducation/create3_sim, irobot_create_msgs; turtlebot/turtlebot4 turtlebot4_navigation
    "turtlebot4": Platform(
        _CREATE3,
        (
            twist("/cmd_vel", stamped=True),
            Published(
                "/wheel_vels",
                "irobot_create_msgs/msg/WheelVels",
                "wheels",
                {"velocity_left": Q("left"), "velocity_right": Q("right")},
            ),
            Published(
                "/wheel_ticks",
                "irobot_create_msgs/msg/WheelTicks",
                "wheels",
                {f"ticks_{side}": Q(f"{side}_turns", _TICKS, whole=True) for side in _SIDES},
            ),
            odometry("/odom", "odometry", "odom", "base_link"),
            pose_with_covariance("/amcl_pose", 20),
            transform("/tf", "odometry", "odom", "base_link"),
            transform("/tf", "correction", "map", "odom"),
            imu("/imu"),
        ),
    ),
    "panther": _husarion("panther", _vehicle("panther", 0.1825, 0.697, 0.44, 2.0, 2.0, 1.5)),
    "lynx": _husarion("lynx", _vehicle("lynx", 0.1388, 0.45, 0.4, 1.5, 2.0, 1.6)),
    # husarion/rosbot_ros: ROS_API.md, rosbot_bringup/config/ekf.yaml
    "rosbot_2r": Platform(
        _ROSBOT,
        (
            twist("/cmd_vel"),
            joints("/joint_states", "{}_wheel_joint", _FOUR),
            odometry("/rosbot_base_controller/odom", "odometry", "odom", "base_link"),
            odometry("/odometry/filtered", "filter", "odom", "base_link"),
            transform("/tf", "filter", "odom", "base_link"),
            odometry("/slam/odom", "localization", "map", "base_link"),
            imu("/imu_broadcaster/imu"),
            describe("/robot_description", "rosbot", _ROSBOT, _WHEELED, _FOUR),
        ),
    ),
    # agilexrobotics/scout_ros2: scout_messenger.hpp, scout_msgs; FAST-LIO's frames
    "scout_2": Platform(
        _SCOUT,
        (
            twist("/cmd_vel"),
            Published(
                "/scout_status",
                "scout_msgs/msg/ScoutStatus",
                "wheels",
                {
                    "linear_velocity": Q("speed"),
                    "angular_velocity": Q("yaw_rate"),
                    "actuator_states[].rpm": tuple(Q(side, _RPM, whole=True) for side in _RIGHT_FIRST),
                },
            ),
            odometry("/odom", "odometry", "odom", "base_link"),
            odometry("/Odometry", "localization", "camera_init", "body"),
            imu("/imu/data"),
        ),
    ),
    # agilexrobotics/hunter_ros2: hunter_messenger.hpp, hunter_msgs
    "hunter_2": Platform(
        _HUNTER,
        (
            twist("/cmd_vel"),
            Published(
                "/hunter_status",
                "hunter_msgs/msg/HunterStatus",
                "wheels",
                {"linear_velocity": Q("speed"), "steering_angle": Q("steering")},
            ),
            odometry("/odom", "odometry", "odom", "base_link"),
            odometry("/Odometry", "localization", "camera_init", "body"),
            imu("/imu/data"),
        ),
    ),
    # ros-controls/ros2_controllers: diff_drive_controller/doc/userdoc.rst
    "diff_drive_controller": Platform(
        _PLAIN,
        (
            twist("/diffbot_base_controller/cmd_vel", stamped=True),
            twist("/diffbot_base_controller/cmd_vel_out", stamped=True),
            joints("/joint_states", _WHEELED, _SIDES),
            odometry("/diffbot_base_controller/odom", "odometry", "odom", "base_link"),
            transform("/tf", "odometry", "odom", "base_link"),
            transform("/tf", "correction", "map", "odom"),
            imu("/imu"),
            describe("/robot_description", "diffbot", _PLAIN, _WHEELED, _SIDES),
        ),
    ),
    # ros-controls/ros2_controllers: steering_controllers_library/doc/userdoc.rst
    "ackermann_steering_controller": Platform(
        _BICYCLE,
        (
            twist("/ackermann_steering_controller/reference", stamped=True),
            Published(
                "/ackermann_steering_controller/controller_state",
                "control_msgs/msg/SteeringControllerStatus",
                "wheels",
                {
                    "traction_wheels_velocity": (Q("left"), Q("right")),
                    "steer_positions": (Q("steering"), Q("steering")),
                },
            ),
            joints("/joint_states", _WHEELED, _CAR),
            odometry("/ackermann_steering_controller/odometry", "odometry", "odom", "base_link"),
            odometry("/lio/odometry", "localization", "map", "base_link"),
            imu("/imu"),
            describe("/robot_description", "ackermann_bot", _BICYCLE, _WHEELED, _CAR),
        ),
    ),
    # ros-navigation/navigation2: nav2_bringup/params/nav2_params.yaml, launch/navigation_launch.py
    "nav2": Platform(
        _WAFFLE,
        (
            twist("/cmd_vel_nav", source="wish"),
            twist("/cmd_vel_smoothed", source="wish"),
            twist("/cmd_vel"),
            joints("/joint_states", "wheel_{}_joint", _SIDES, "position"),
            odometry("/odom", "odometry", "odom", "base_footprint"),
            pose_with_covariance("/amcl_pose", 20),
            transform("/tf", "odometry", "odom", "base_footprint"),
            transform("/tf", "correction", "map", "odom"),
            imu("/imu"),
            describe("/robot_description", "turtlebot3_waffle", _WAFFLE, "wheel_{}_joint", _SIDES),
        ),
    ),
    # autowarefoundation/autoware_msgs; sample_vehicle_launch
    "autoware": Platform(
        _SAMPLE,
        (
            Published(
                "/control/command/control_cmd",
                "autoware_control_msgs/msg/Control",
                "command",
                {"longitudinal.velocity": Q("speed"), "lateral.steering_tire_angle": Q("steering")},
                stamp="stamp",
            ),
            Published(
                "/vehicle/status/velocity_status",
                "autoware_vehicle_msgs/msg/VelocityReport",
                "wheels",
                {"longitudinal_velocity": Q("speed"), "heading_rate": Q("yaw_rate")},
            ),
            Published(
                "/vehicle/status/steering_status",
                "autoware_vehicle_msgs/msg/SteeringReport",
                "wheels",
                {"steering_tire_angle": Q("steering")},
                stamp="stamp",
            ),
            odometry("/localization/kinematic_state", "localization", "map", "base_link"),
            imu("/sensing/imu/imu_data"),
        ),
    ),
    # f1tenth/f1tenth_system: f1tenth_stack/config/vesc.yaml, README.md; f1tenth/vesc
    "f1tenth": Platform(
        _F1TENTH,
        (
            Published(
                "/drive",
                "ackermann_msgs/msg/AckermannDriveStamped",
                "command",
                {"drive.speed": Q("speed"), "drive.steering_angle": Q("steering")},
            ),
            Published(
                "/commands/motor/speed",
                "std_msgs/msg/Float64",
                "command",
                {"data": Q("speed", 4614.0)},
                stamp="none",
            ),
            Published(
                "/commands/servo/position",
                "std_msgs/msg/Float64",
                "command",
                {"data": Q("steering", -1.2135, 0.5304)},
                stamp="none",
            ),
            Published(
                "/sensors/core",
                "vesc_msgs/msg/VescStateStamped",
                "wheels",
                {"state.speed": Q("speed", 4614.0)},
            ),
            Published(
                "/sensors/servo_position_command",
                "std_msgs/msg/Float64",
                "wheels",
                {"data": Q("steering", -1.2135, 0.5304)},
                stamp="none",
            ),
            odometry("/odom", "odometry", "odom", "base_link"),
            odometry("/pf/pose/odom", "localization", "map", "laser"),
            imu("/sensors/imu/raw"),
        ),
    ),
    # PX4/px4_msgs
    "px4_rover": Platform(
        _ROVER,
        (
            _px4_stamped(
                "in/rover_speed_setpoint", "RoverSpeedSetpoint", "command", {"speed_body_x": Q("speed")}
            ),
            _px4_stamped(
                "in/rover_rate_setpoint",
                "RoverRateSetpoint",
                "command",
                {"yaw_rate_setpoint": Q("yaw_rate", -1.0)},
            ),
            _px4_stamped(
                "out/wheel_encoders",
                "WheelEncoders",
                "wheels",
                {
                    "wheel_speed": (Q("right"), Q("left")),
                    "wheel_angle": (Q("right_angle"), Q("left_angle")),
                },
            ),
            Published(
                "/fmu/out/vehicle_odometry",
                "px4_msgs/msg/VehicleOdometry",
                "localization",
                {
                    "position": (Q("y"), Q("x"), Q("z", -1.0)),
                    "q": (Q("ned_qw"), Q("ned_qx"), Q("ned_qy"), Q("ned_qz")),
                    "pose_frame": 1.0,
                },
                stamp="timestamp_sample",
            ),
            _px4_stamped(
                "out/sensor_combined",
                "SensorCombined",
                "imu",
                {
                    "gyro_rad": (Q("rate_x"), Q("rate_y", -1.0), Q("rate_z", -1.0)),
                    "accelerometer_m_s2": (Q("force_x"), Q("force_y", -1.0), Q("force_z", -1.0)),
                },
            ),
        ),
    ),
    # duckietown/dt-ros-commons, dt-car-interface
    "duckiebot": Platform(
        _DUCK,
        (
            Published(
                "/autobot01/wheels_driver_node/wheels_cmd_executed",
                "duckietown_msgs/msg/WheelsCmdStamped",
                "command",
                {"vel_left": Q("left", 1.0 / 27.0), "vel_right": Q("right", 1.0 / 27.0)},
            ),
            *(
                Published(
                    f"/autobot01/{side}_wheel_encoder_node/tick",
                    "duckietown_msgs/msg/WheelEncoderStamped",
                    "wheels",
                    {"data": Q(f"{side}_turns", 135.0, whole=True), "resolution": 135.0},
                )
                for side in _SIDES
            ),
            Published(
                "/mocap/autobot01/pose",
                "geometry_msgs/msg/PoseStamped",
                "localization",
                {**pose_fields("pose.position", "pose.orientation"), "header.frame_id": "world"},
            ),
        ),
    ),
    # LeoRover/leo_common-ros2, leo_firmware
    "leo_rover": Platform(
        _LEO,
        (
            twist("/cmd_vel"),
            Published(
                "/firmware/wheel_states",
                "leo_msgs/msg/WheelStates",
                "wheels",
                {"velocity": (Q("left"), Q("left"), Q("right"), Q("right"))},
                stamp="stamp",
            ),
            Published(
                "/firmware/wheel_odom",
                "leo_msgs/msg/WheelOdom",
                "odometry",
                {
                    "velocity_lin": Q("speed"),
                    "velocity_ang": Q("yaw_rate"),
                    "pose_x": Q("x"),
                    "pose_y": Q("y"),
                },
                stamp="stamp",
            ),
            odometry("/merged_odom", "filter", "odom", "base_footprint"),
            odometry("/rtabmap/odom", "localization", "map", "base_link"),
            imu("/imu/data_raw"),
        ),
    ),
    # linorobot/linorobot2: linorobot2_base/config/ekf.yaml, linorobot2_description/urdf
    "linorobot2": Platform(
        _LINO,
        (
            twist("/cmd_vel"),
            odometry("/odom/unfiltered", "odometry", "odom", "base_footprint"),
            odometry("/odom", "filter", "odom", "base_footprint"),
            transform("/tf", "filter", "odom", "base_footprint"),
            odometry("/lio_sam/mapping/odometry", "localization", "map", "base_link"),
            imu("/imu/data"),
            describe("/robot_description", "linorobot2", _LINO, "{}_wheel_joint", _FOUR),
        ),
    ),
    **MECANUM_PLATFORMS,
    **UNITREE_PLATFORMS,
    **FARM_NG_PLATFORMS,
}


def find_platform(name: str) -> Platform:
    """The named platform.

    Raises:
        SimulateError: ``unknown_platform``.
    """
    if name not in PLATFORMS:
        raise unknown_name("platform", name, sorted(PLATFORMS))
    return PLATFORMS[name]
