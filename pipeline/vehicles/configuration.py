"""The configuration of a run: what `run.toml`, `fleet.toml`, presets and the command line may say.

Every section is optional. Unknown keys are errors, so that a misspelt one is not silently ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import msgspec

from pipeline.vehicles.kinematics import list_kinds

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
RunningGear = Literal["wheels", "tracks"]
KIND_WORDS: Mapping[str, Mapping[str, str]] = {
    "skid_steer": {"kind": "differential"},
    "tracked": {"kind": "differential", "running_gear": "tracks"},
}
"""What vehicles are called that have another's kinematics."""
if TYPE_CHECKING:
    Kind: TypeAlias = str
    KindWord: TypeAlias = str
else:
    Kind = Literal[list_kinds()]
    KindWord = Literal[(*list_kinds(), *KIND_WORDS)]
Clock = Literal["header", "log", "publish"]
Unit = Literal["rad/s", "rpm", "deg/s", "m/s", "mm/s", "rad", "deg", "ticks", "erpm", "duty"]


class VehicleSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[vehicle]``: a preset, values of one's own, or both (the values win).

    Attributes:
        preset: name or alias of a preset.
        name: what to call the vehicle.
        kind: ideal model, the name of a file in `kinematics`; or a word of `KIND_WORDS`.
        wheel_radius_m: r.
        track_width_m: b, between the middles of the left and right wheels.
        wheelbase_m: l, between the axles.
        base_to_rear_axle_m: how far base_link lies ahead of the rear axle (Ackermann).
        mass_kg: mass as driven.
        max_speed_mps: largest speed the drive accepts.
        max_yaw_rate_radps: largest yaw rate the drive accepts.
        max_steering_rad: largest steering angle.
        controller_track_multiplier: what the controller multiplies the track width by when it turns a
            body command into wheel speeds.
        running_gear: what it stands on; the kinematics are the same.
    """

    preset: str | None = None
    name: str | None = None
    kind: KindWord | None = None
    wheel_radius_m: Positive | None = None
    track_width_m: Positive | None = None
    wheelbase_m: Positive | None = None
    base_to_rear_axle_m: float | None = None
    mass_kg: Positive | None = None
    max_speed_mps: Positive | None = None
    max_yaw_rate_radps: Positive | None = None
    max_steering_rad: Positive | None = None
    controller_track_multiplier: Positive | None = None
    running_gear: RunningGear | None = None

    def list_values(self) -> dict[str, object]:
        """What is said, by name, words for a kind replaced by what they mean."""
        values = {key: value for key, value in msgspec.structs.asdict(self).items() if value is not None}
        return {**values, **KIND_WORDS.get(self.kind or "", {})}


class RunSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[run]``: which dataset and terrain the run belongs to."""

    dataset: str | None = None
    terrain: str | None = None


class DriveSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[command]`` or ``[wheels]``: where wheel speeds, a body command, or speed and steering are recorded.

    A topic may be followed by a field path: ``/drive/status.velocity[0]``.

    Attributes:
        topic: JointState, body command (Twist, TwistStamped) or AckermannDrive(Stamped).
        left: joint names of the left side.
        right: joint names of the right side.
        front: joint names of the front wheels (mecanum).
        left_topic: topic of the left side.
        right_topic: topic of the right side.
        speed_topic: speed, or forward speed of a body command when ``yaw_rate_topic`` is given.
        yaw_rate_topic: yaw rate of a body command.
        steering_topic: steering angle [rad].
        steering_joint: joint of ``topic`` whose position is the steering angle.
        unit: unit of wheel speeds, or of wheel angles; what the message type says where it is not given.
        per_turn: how many ticks a turn of the wheel has.
        sign: -1 where forward is recorded as negative.
        time: which of the message's times to use.
        hold_s: how long a command stays valid.
    """

    topic: str | None = None
    left: list[str] | None = None
    right: list[str] | None = None
    front: list[str] | None = None
    left_topic: str | None = None
    right_topic: str | None = None
    speed_topic: str | None = None
    yaw_rate_topic: str | None = None
    steering_topic: str | None = None
    steering_joint: str | None = None
    unit: Unit | None = None
    per_turn: Positive | None = None
    sign: Literal[1, -1] = 1
    time: Clock | None = None
    hold_s: Positive | None = None


class PoseSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[pose]``: a pose topic, or a pair of frames out of the transforms.

    Attributes:
        topic: poses, fixes of satellites, or velocities over ground.
        name: model, link or joint, where a message of the topic holds the poses of several.
        frames: parent and child.
        time: which of the message's times to use.
    """

    topic: str | None = None
    name: str | None = None
    frames: Annotated[list[str], msgspec.Meta(min_length=2, max_length=2)] | None = None
    time: Clock | None = None


class ImuSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[imu]``: the gyro."""

    topic: str | None = None
    time: Clock | None = None


class VelocitySection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[velocity]``: how poses become velocities.

    Attributes:
        rate_hz: rate of the uniform grid.
        window_s: width of the local quadratic fit.
        yaw: whose yaw rate the slip tables use.
        jump_m: smallest jump of the position that cuts a segment.
        jump_rad: smallest jump of the heading that cuts a segment.
        gap_s: shortest hole in the poses that cuts a segment.
    """

    rate_hz: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)] = 20.0
    window_s: Annotated[float, msgspec.Meta(ge=0.05, le=10.0)] = 0.75
    yaw: Literal["pose", "imu"] = "pose"
    jump_m: Positive = 0.1
    jump_rad: Positive = 0.1
    gap_s: Positive = 0.12


class SlipSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[slip]``: the length scale L of the modulus and the transitory span after a command step."""

    length_scale_m: Positive = 1.0
    transitory_s: Positive = 2.0


class IntervalSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[interval]]``: when commands are live: while a String topic equals a text, or between two times."""

    topic: str | None = None
    equals: str | None = None
    start_s: float | None = None
    end_s: float | None = None


class Configuration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that may be configured for one run."""

    vehicle: VehicleSection = VehicleSection()
    run: RunSection = RunSection()
    command: DriveSection = DriveSection()
    wheels: DriveSection = DriveSection()
    pose: PoseSection = PoseSection()
    imu: ImuSection = ImuSection()
    velocity: VelocitySection = VelocitySection()
    slip: SlipSection = SlipSection()
    interval: list[IntervalSection] = []
    use_intervals: Literal["recorded", "all"] = "recorded"
