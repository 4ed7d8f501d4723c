"""Topic layouts: which topics a robot's log has, and in which form each carries its numbers.

The names are those of the published recordings and of common robot configurations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from pipeline.simulate.errors import SimulateError, unknown_name
from pipeline.simulate.facts import read_facts

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


def _read_layout(given: dict[str, Any]) -> Layout:
    commands = msgspec.convert(given.pop("commands"), tuple[CommandTopic, ...])
    wheels = msgspec.convert(given.pop("wheels", []), tuple[WheelTopic, ...])
    return Layout(given.pop("kind"), commands, wheels, PoseTopic(**given.pop("pose")), **given)


LAYOUTS: dict[str, Layout] = {name: _read_layout(given) for name, given in read_facts("layouts.toml").items()}


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
        what = f"this layout is for {found.kind} vehicles, this one is {vehicle.kind}"
        raise SimulateError("wrong_vehicle", what, where=name, hint=f"Choose one of {', '.join(fitting)}")
    return found


def _choose_usual(vehicle: Vehicle) -> str:
    if vehicle.kind != "differential":
        return vehicle.kind
    return {"husky_a200": "husky", "warthog": "warthog"}.get(vehicle.name, "tf")
