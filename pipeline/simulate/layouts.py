"""Topic layouts: which topics a robot's log has, and in which form each carries its numbers.

The names are those of the published recordings and of common robot configurations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pipeline.simulate.errors import SimulateError, unknown_name

if TYPE_CHECKING:
    from pipeline.simulate.published import Published
    from pipeline.simulate.vehicles import Kind, Vehicle

CommandForm = Literal[
    "joint_state", "float_sides", "twist", "twist_stamped", "ackermann", "float_speed_steering"
]
WheelForm = Literal["joint_state", "float_sides", "ackermann", "float_speed_steering"]
PoseContent = Literal["odometry", "pose_stamped", "pose_covariance", "tf"]


@dataclass(frozen=True)
class CommandTopic:
    """Topics of a command: one, or a pair (left, right) or (speed, steering)."""

    form: CommandForm
    topics: tuple[str, ...]


@dataclass(frozen=True)
class WheelTopic:
    """Topics of measured wheels: one, or a pair (left, right) or (speed, steering)."""

    form: WheelForm
    topics: tuple[str, ...]


@dataclass(frozen=True)
class PoseTopic:
    """Topic of the pose."""

    form: PoseContent
    topic: str


@dataclass(frozen=True)
class Layout:
    """The topics of a log.

    Attributes:
        kind: vehicles that have it.
        commands: what was asked, possibly on several topics.
        wheels: what the encoders measured; empty when the robot does not publish it.
        pose: where the localization reports.
        imu: topic of the inertial unit, empty when there is none.
        joints: names of the wheel joints of JointState messages, with ``{}`` for ``front_left`` and the like.
        topics: everything in the log of a platform; nothing else is written then.
    """

    kind: Kind
    commands: tuple[CommandTopic, ...]
    wheels: tuple[WheelTopic, ...]
    pose: PoseTopic
    imu: str = ""
    joints: str = "{}_wheel"
    topics: tuple[Published, ...] = ()


_ICP = PoseTopic("odometry", "/mapping/icp_odom")
_JOINTS = (WheelTopic("joint_state", ("/joint_states",)),)
_TWIST = (CommandTopic("twist", ("/cmd_vel",)),)
_CONTROLLER = CommandTopic("twist_stamped", ("/controller/cmd_vel",))

LAYOUTS: dict[str, Layout] = {
    "husky": Layout(
        "differential",
        (CommandTopic("joint_state", ("/wheel_commands",)), _CONTROLLER),
        _JOINTS,
        _ICP,
        "/mti100/data",
    ),
    "husky_joint_commands": Layout(
        "differential",
        (CommandTopic("joint_state", ("/husky/joint_commands",)),),
        _JOINTS,
        _ICP,
        "/mti100/data",
        joints="{}_wheel_joint",
    ),
    "husky_body_command": Layout("differential", (_CONTROLLER,), _JOINTS, _ICP, "/mti100/data"),
    "warthog": Layout(
        "differential",
        (CommandTopic("float_sides", ("/left_drive/velocity", "/right_drive/velocity")),),
        (WheelTopic("float_sides", ("/left_drive/status/speed", "/right_drive/status/speed")),),
        _ICP,
        "/mti30/data",
    ),
    "warthog_platform": Layout(
        "differential",
        (
            CommandTopic(
                "float_sides",
                (
                    "/warthog/platform/motor/left/cmd_velocity",
                    "/warthog/platform/motor/right/cmd_velocity",
                ),
            ),
            _CONTROLLER,
        ),
        (
            WheelTopic(
                "float_sides",
                (
                    "/warthog/platform/motor/left/status/velocity",
                    "/warthog/platform/motor/right/status/velocity",
                ),
            ),
        ),
        _ICP,
        "/mti30/data",
    ),
    "body_command": Layout("differential", _TWIST, (), _ICP),
    "wheel_float": Layout(
        "differential",
        (CommandTopic("float_sides", ("/wheel_left/cmd", "/wheel_right/cmd")),),
        (WheelTopic("float_sides", ("/wheel_left/velocity", "/wheel_right/velocity")),),
        PoseTopic("pose_covariance", "/localization/pose"),
        "/imu/data",
    ),
    "tf": Layout(
        "differential", _TWIST, _JOINTS, PoseTopic("tf", "/tf"), "/imu/data", joints="{}_wheel_joint"
    ),
    "pose_stamped": Layout(
        "differential", _TWIST, _JOINTS, PoseTopic("pose_stamped", "/robot/pose"), "/imu/data"
    ),
    "pose_covariance": Layout("differential", _TWIST, (), PoseTopic("pose_covariance", "/amcl_pose")),
    "mecanum": Layout("mecanum", _TWIST, _JOINTS, _ICP, "/imu/data", joints="{}_wheel_joint"),
    "omni": Layout("omni", _TWIST, (), _ICP, "/imu/data"),
    "ackermann": Layout(
        "ackermann",
        (CommandTopic("ackermann", ("/ackermann_cmd",)),),
        _JOINTS,
        _ICP,
        "/imu/data",
    ),
    "ackermann_status": Layout(
        "ackermann",
        (CommandTopic("ackermann", ("/drive",)),),
        (WheelTopic("ackermann", ("/drive/status",)),),
        PoseTopic("pose_stamped", "/localization/pose"),
    ),
    "ackermann_floats": Layout(
        "ackermann",
        (CommandTopic("float_speed_steering", ("/vehicle/speed_command", "/vehicle/steering_command")),),
        (WheelTopic("float_speed_steering", ("/vehicle/speed", "/vehicle/steering")),),
        PoseTopic("tf", "/tf"),
        "/imu/data",
    ),
}


def find_layout(layout: str | Layout, vehicle: Vehicle) -> Layout:
    """The layout of that name, or the one given, if it fits the vehicle.

    Args:
        layout: a name of `LAYOUTS`, ``usual`` for what such a vehicle usually has, or a layout.
        vehicle: whose log it shall be.

    Raises:
        SimulateError: ``unknown_layout`` or ``wrong_vehicle``.
    """
    if isinstance(layout, str):
        name = _choose_usual(vehicle) if layout == "usual" else layout
        if name not in LAYOUTS:
            raise unknown_name("layout", name, ["usual", *sorted(LAYOUTS)])
        found = LAYOUTS[name]
    else:
        name, found = "layout", layout
    if found.kind != vehicle.kind:
        fitting = sorted(key for key, item in LAYOUTS.items() if item.kind == vehicle.kind)
        raise SimulateError(
            "wrong_vehicle",
            f"this layout is for {found.kind} vehicles, this one is {vehicle.kind}",
            where=name,
            hint=f"Choose one of {', '.join(fitting)}",
        )
    return found


def _choose_usual(vehicle: Vehicle) -> str:
    if vehicle.kind != "differential":
        return vehicle.kind
    return {"husky_a200": "husky", "warthog": "warthog"}.get(vehicle.name, "tf")
