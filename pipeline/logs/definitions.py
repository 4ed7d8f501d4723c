"""Definitions of the standard message types: for writing, and for logs that carry none.

Each type is one line of fields, ``type name``, separated by semicolons.
"""

from __future__ import annotations

from functools import cache
from typing import Final

from pipeline.logs.schema import SIZES, Structure, leaf_paths, parse_msg, short_name

_HEADER: Final = "std_msgs/Header header"

FIELDS: Final[dict[str, str]] = {
    "ackermann_msgs/AckermannDrive": "float32 steering_angle; float32 steering_angle_velocity; "
    "float32 speed; float32 acceleration; float32 jerk",
    "ackermann_msgs/AckermannDriveStamped": f"{_HEADER}; ackermann_msgs/AckermannDrive drive",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear; geometry_msgs/Vector3 angular",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/Pose2D": "float64 x; float64 y; float64 theta",
    "geometry_msgs/PoseStamped": f"{_HEADER}; geometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose; float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": f"{_HEADER}; geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": f"{_HEADER}; string child_frame_id; geometry_msgs/Transform transform",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear; geometry_msgs/Vector3 angular",
    "geometry_msgs/TwistStamped": f"{_HEADER}; geometry_msgs/Twist twist",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist; float64[36] covariance",
    "geometry_msgs/TwistWithCovarianceStamped": f"{_HEADER}; geometry_msgs/TwistWithCovariance twist",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Vector3Stamped": f"{_HEADER}; geometry_msgs/Vector3 vector",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force; geometry_msgs/Vector3 torque",
    "nav_msgs/Odometry": f"{_HEADER}; string child_frame_id; geometry_msgs/PoseWithCovariance pose; "
    "geometry_msgs/TwistWithCovariance twist",
    "nav_msgs/Path": f"{_HEADER}; geometry_msgs/PoseStamped[] poses",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp; uint8 level; string name; string msg; string file; "
    "string function; uint32 line",
    "rcl_interfaces/Parameter": "string name; rcl_interfaces/ParameterValue value",
    "rcl_interfaces/ParameterEvent": "builtin_interfaces/Time stamp; string node; "
    "rcl_interfaces/Parameter[] new_parameters; rcl_interfaces/Parameter[] changed_parameters; "
    "rcl_interfaces/Parameter[] deleted_parameters",
    "rcl_interfaces/ParameterValue": "uint8 type; bool bool_value; int64 integer_value; "
    "float64 double_value; string string_value; uint8[] byte_array_value; bool[] bool_array_value; "
    "int64[] integer_array_value; float64[] double_array_value; string[] string_array_value",
    "rosgraph_msgs/Clock": "builtin_interfaces/Time clock",
    "sensor_msgs/Imu": f"{_HEADER}; geometry_msgs/Quaternion orientation; "
    "float64[9] orientation_covariance; geometry_msgs/Vector3 angular_velocity; "
    "float64[9] angular_velocity_covariance; geometry_msgs/Vector3 linear_acceleration; "
    "float64[9] linear_acceleration_covariance",
    "sensor_msgs/MultiDOFJointState": f"{_HEADER}; string[] joint_names; "
    "geometry_msgs/Transform[] transforms; geometry_msgs/Twist[] twist; geometry_msgs/Wrench[] wrench",
    "sensor_msgs/NavSatFix": f"{_HEADER}; sensor_msgs/NavSatStatus status; float64 latitude; "
    "float64 longitude; float64 altitude; float64[9] position_covariance; uint8 position_covariance_type",
    "sensor_msgs/NavSatStatus": "int8 status; uint16 service",
    "sensor_msgs/JointState": f"{_HEADER}; string[] name; float64[] position; float64[] velocity; "
    "float64[] effort",
    "std_msgs/Bool": "bool data",
    "std_msgs/ColorRGBA": "float32 r; float32 g; float32 b; float32 a",
    "std_msgs/Empty": "",
    "std_msgs/Float32": "float32 data",
    "std_msgs/Float32MultiArray": "std_msgs/MultiArrayLayout layout; float32[] data",
    "std_msgs/Float64": "float64 data",
    "std_msgs/Float64MultiArray": "std_msgs/MultiArrayLayout layout; float64[] data",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "std_msgs/Int32": "int32 data",
    "std_msgs/Int64": "int64 data",
    "std_msgs/MultiArrayDimension": "string label; uint32 size; uint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim; uint32 data_offset",
    "std_msgs/String": "string data",
    "std_msgs/UInt8": "uint8 data",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "visualization_msgs/Marker": f"{_HEADER}; string ns; int32 id; int32 type; int32 action; "
    "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; std_msgs/ColorRGBA color; "
    "builtin_interfaces/Duration lifetime; bool frame_locked; geometry_msgs/Point[] points; "
    "std_msgs/ColorRGBA[] colors; string text; string mesh_resource; bool mesh_use_embedded_materials",
    "autoware_control_msgs/Control": "builtin_interfaces/Time stamp; builtin_interfaces/Time control_time; "
    "autoware_control_msgs/Lateral lateral; autoware_control_msgs/Longitudinal longitudinal",
    "autoware_control_msgs/Lateral": "builtin_interfaces/Time stamp; builtin_interfaces/Time control_time; "
    "float32 steering_tire_angle; float32 steering_tire_rotation_rate; "
    "bool is_defined_steering_tire_rotation_rate",
    "autoware_control_msgs/Longitudinal": "builtin_interfaces/Time stamp; "
    "builtin_interfaces/Time control_time; "
    "float32 velocity; float32 acceleration; float32 jerk; bool is_defined_acceleration; "
    "bool is_defined_jerk",
    "autoware_vehicle_msgs/SteeringReport": "builtin_interfaces/Time stamp; float32 steering_tire_angle",
    "autoware_vehicle_msgs/VelocityReport": f"{_HEADER}; float32 longitudinal_velocity; "
    "float32 lateral_velocity; float32 heading_rate",
    "control_msgs/DynamicJointState": f"{_HEADER}; string[] joint_names; "
    "control_msgs/InterfaceValue[] interface_values",
    "control_msgs/InterfaceValue": "string[] interface_names; float64[] values",
    "control_msgs/SteeringControllerStatus": f"{_HEADER}; float64[] traction_wheels_position; "
    "float64[] traction_wheels_velocity; float64[] steer_positions; float64[] traction_command; "
    "float64[] steering_angle_command",
    "duckietown_msgs/WheelEncoderStamped": f"{_HEADER}; int32 data; uint16 resolution; uint8 type",
    "duckietown_msgs/WheelsCmdStamped": f"{_HEADER}; float32 vel_left; float32 vel_right",
    "gazebo_msgs/ModelStates": "string[] name; geometry_msgs/Pose[] pose; geometry_msgs/Twist[] twist",
    "hunter_msgs/HunterActuatorState": "uint8 motor_id; int16 rpm; float64 current; int32 pulse_count; "
    "float32 driver_voltage; float32 driver_temperature; int8 motor_temperature; uint8 driver_state",
    "hunter_msgs/HunterStatus": f"{_HEADER}; float64 linear_velocity; float64 steering_angle; "
    "uint8 vehicle_state; "
    "uint8 control_mode; uint16 error_code; float64 battery_voltage; "
    "hunter_msgs/HunterActuatorState[3] actuator_states",
    "irobot_create_msgs/WheelTicks": f"{_HEADER}; int32 ticks_left; int32 ticks_right",
    "irobot_create_msgs/WheelVels": f"{_HEADER}; float32 velocity_left; float32 velocity_right",
    "leo_msgs/WheelOdom": "builtin_interfaces/Time stamp; float32 velocity_lin; float32 velocity_ang; "
    "float32 pose_x; float32 pose_y; float32 pose_yaw",
    "leo_msgs/WheelStates": "builtin_interfaces/Time stamp; float32[4] position; float32[4] velocity; "
    "float32[4] torque; float32[4] pwm_duty_cycle",
    "px4_msgs/RoverRateSetpoint": "uint64 timestamp; float32 yaw_rate_setpoint",
    "px4_msgs/RoverSpeedSetpoint": "uint64 timestamp; float32 speed_body_x; float32 speed_body_y",
    "px4_msgs/SensorCombined": "uint64 timestamp; float32[3] gyro_rad; uint32 gyro_integral_dt; "
    "int32 accelerometer_timestamp_relative; float32[3] accelerometer_m_s2; "
    "uint32 accelerometer_integral_dt; uint8 accelerometer_clipping; uint8 gyro_clipping; "
    "uint8 accel_calibration_count; uint8 gyro_calibration_count",
    "px4_msgs/VehicleOdometry": "uint64 timestamp; uint64 timestamp_sample; "
    "uint8 pose_frame; float32[3] position; "
    "float32[4] q; uint8 velocity_frame; float32[3] velocity; float32[3] angular_velocity; "
    "float32[3] position_variance; float32[3] orientation_variance; float32[3] velocity_variance; "
    "uint8 reset_counter; int8 quality",
    "px4_msgs/WheelEncoders": "uint64 timestamp; float32[2] wheel_speed; float32[2] wheel_angle",
    "scout_msgs/ScoutActuatorState": "uint8 motor_id; int16 rpm; float64 current; int32 pulse_count; "
    "float32 driver_voltage; float32 driver_temperature; int8 motor_temperature; uint8 driver_state",
    "scout_msgs/ScoutLightState": "uint8 mode; uint8 custom_value",
    "scout_msgs/ScoutStatus": f"{_HEADER}; float64 linear_velocity; float64 angular_velocity; "
    "uint8 vehicle_state; "
    "uint8 control_mode; uint16 error_code; float64 battery_voltage; "
    "scout_msgs/ScoutActuatorState[4] actuator_states; bool light_control_enabled; "
    "scout_msgs/ScoutLightState front_light_state; scout_msgs/ScoutLightState rear_light_state",
    "unitree_api/Request": "unitree_api/RequestHeader header; string parameter; uint8[] binary",
    "unitree_api/RequestHeader": "unitree_api/RequestIdentity identity; unitree_api/RequestLease lease; "
    "unitree_api/RequestPolicy policy",
    "unitree_api/RequestIdentity": "int64 id; int64 api_id",
    "unitree_api/RequestLease": "int64 id",
    "unitree_api/RequestPolicy": "int32 priority; bool noreply",
    "unitree_go/BmsState": "uint8 version_high; uint8 version_low; uint8 status; uint8 soc; int32 current; "
    "uint16 cycle; int8[2] bq_ntc; int8[2] mcu_ntc; uint16[15] cell_vol",
    "unitree_go/IMUState": "float32[4] quaternion; float32[3] gyroscope; float32[3] accelerometer; "
    "float32[3] rpy; int8 temperature",
    "unitree_go/LowState": "uint8[2] head; uint8 level_flag; uint8 frame_reserve; uint32[2] sn; "
    "uint32[2] version; uint16 bandwidth; unitree_go/IMUState imu_state; "
    "unitree_go/MotorState[20] motor_state; unitree_go/BmsState bms_state; int16[4] foot_force; "
    "int16[4] foot_force_est; uint32 tick; uint8[40] wireless_remote; uint8 bit_flag; float32 adc_reel; "
    "int8 temperature_ntc1; int8 temperature_ntc2; float32 power_v; float32 power_a; "
    "uint16[4] fan_frequency; uint32 reserve; uint32 crc",
    "unitree_go/MotorState": "uint8 mode; float32 q; float32 dq; float32 ddq; float32 tau_est; "
    "float32 q_raw; float32 dq_raw; float32 ddq_raw; int8 temperature; uint32 lost; uint32[2] reserve",
    "unitree_go/SportModeState": "unitree_go/TimeSpec stamp; uint32 error_code; "
    "unitree_go/IMUState imu_state; uint8 mode; float32 progress; uint8 gait_type; "
    "float32 foot_raise_height; float32[3] position; float32 body_height; float32[3] velocity; "
    "float32 yaw_speed; float32[4] range_obstacle; int16[4] foot_force; float32[12] foot_position_body; "
    "float32[12] foot_speed_body",
    "unitree_go/TimeSpec": "int32 sec; uint32 nanosec",
    "vesc_msgs/VescState": "float64 voltage_input; float64 temperature_pcb; float64 current_motor; "
    "float64 current_input; float64 speed; float64 duty_cycle; float64 charge_drawn; "
    "float64 charge_regen; float64 energy_drawn; float64 energy_regen; float64 displacement; "
    "float64 distance_traveled; int32 fault_code",
    "vesc_msgs/VescStateStamped": f"{_HEADER}; vesc_msgs/VescState state",
}
"""Fields of every bundled type, by ``package/Name``."""


def definition_text(type_name: str) -> str | None:
    """The concatenated ``ros2msg`` definition of a bundled type, None when it is not bundled.

    Args:
        type_name: ``package/msg/Name`` or ``package/Name``.
    """
    root = short_name(type_name)
    if root not in FIELDS:
        return None
    order = [root]
    for name in order:
        for below in _types_below(name):
            if below not in order:
                order.append(below)
    sections = [_lines(name) if name == root else f"MSG: {name}\n{_lines(name)}" for name in order]
    return f"\n{'=' * 80}\n".join(sections) + "\n"


@cache
def bundled_structure(type_name: str) -> Structure | None:
    """The tree of a bundled type, None when it is not bundled."""
    text = definition_text(type_name)
    return None if text is None else parse_msg(type_name, text)


def bundled_types() -> tuple[str, ...]:
    """Every bundled type as ``package/msg/Name``."""
    return tuple(name.replace("/", "/msg/") for name in FIELDS)


def field_names(type_name: str) -> tuple[str, ...]:
    """Leaf field paths of a bundled type; empty when it is not bundled."""
    structure = bundled_structure(type_name)
    return () if structure is None else tuple(leaf_paths(structure))


def _lines(name: str) -> str:
    return "\n".join(field.strip() for field in FIELDS[name].split(";"))


def _types_below(name: str) -> list[str]:
    written = [field.split()[0].split("[")[0] for field in FIELDS[name].split(";") if field]
    return [kind for kind in written if kind not in SIZES and kind != "string"]
