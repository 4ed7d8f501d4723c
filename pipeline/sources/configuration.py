"""The configuration of a run, and vehicles from presets and configurations."""

import functools
import math
import re
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import TYPE_CHECKING, Annotated, Final, Literal, TypeAlias

import msgspec

from pipeline.core import SlipError, list_nearest, suffix_unit
from pipeline.sources.kinematics import Kinematics, find_kinematics, list_kinds


class ConfigurationError(SlipError):
    """An unusable configuration, or a choice that the user must make."""


# The configuration of a run: keys of `run.toml`, `fleet.toml`, presets and the command line.
#
# Every section is optional. Unknown keys are errors, so that a misspelt one is not silently ignored.

# Every number has a range in SI units, so that no value can break the arithmetic of a stage.

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Radius = Annotated[float, msgspec.Meta(ge=1e-3, le=2.5)]
Track = Annotated[float, msgspec.Meta(ge=5e-3, le=15.0)]
Wheelbase = Annotated[float, msgspec.Meta(ge=5e-3, le=25.0)]
AxleDistance = Annotated[float, msgspec.Meta(ge=-25.0, le=25.0)]
Mass = Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)]
Rate = Annotated[float, msgspec.Meta(ge=1e-3, le=100.0)]
"""A vehicle's largest speed [m/s] or yaw rate [rad/s]."""
Steering = Annotated[float, msgspec.Meta(ge=1e-3, le=math.pi)]
TrackMultiplier = Annotated[float, msgspec.Meta(ge=1e-2, le=100.0)]
# Bounds of a vehicle: above the largest mining trucks (wheels of 2.0 m, a track of 9 m, a wheelbase of 8 m,
# 620 t), and below robots of a centimetre.

Instant = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A time after the start of a log, or a difference of two clocks [s]: 30 years."""
Span = Annotated[float, msgspec.Meta(ge=1e-3, le=86400.0)]
"""A duration [s]: from the resolution of clocks to a day."""
Factor = Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)]
"""Factor of a side or a joint; encoders in the smallest and the largest known unit differ by less."""
RunningGear = Literal["wheels", "tracks"]
KIND_WORDS: Mapping[str, Mapping[str, str]] = {
    "skid_steer": {"kind": "differential"},
    "tracked": {"kind": "differential", "running_gear": "tracks"},
}
"""Names of vehicle types with the kinematics of another kind."""
if TYPE_CHECKING:
    Kind: TypeAlias = str
    KindWord: TypeAlias = str
else:
    Kind = Literal[list_kinds()]
    KindWord = Literal[(*list_kinds(), *KIND_WORDS)]
Clock = Literal["header", "log", "publish"]
Unit = Literal[
    "rad/s",
    "mrad/s",
    "rpm",
    "rev/s",
    "deg/s",
    "m/s",
    "km/h",
    "cm/s",
    "mm/s",
    "rad",
    "deg",
    "ticks",
    "erpm",
    "duty",
]


StandIn = Literal["wheel_radius_m", "track_width_m", "wheelbase_m"]


class VehicleSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[vehicle]``: a preset, explicit values, or both (the values have priority).

    Attributes:
        preset: name or alias of a preset.
        name: display name of the vehicle.
        kind: ideal model; ``skid_steer`` and ``tracked`` stand for ``differential``.
        wheel_radius_m: r.
        track_width_m: b, between the centres of the left and right wheels.
        wheelbase_m: l, between the axles.
        base_to_rear_axle_m: distance of base_link ahead of the rear axle (Ackermann).
        mass_kg: mass as driven.
        max_speed_mps: largest speed that the drive accepts.
        max_yaw_rate_radps: largest yaw rate that the drive accepts.
        max_steering_rad: largest steering angle.
        controller_track_multiplier: factor on the track width in the controller's conversion of a body
            command into wheel speeds.
        running_gear: wheels or tracks; the kinematics are the same.
    """

    preset: str | None = None
    name: str | None = None
    kind: KindWord | None = None
    wheel_radius_m: Radius | None = None
    track_width_m: Track | None = None
    wheelbase_m: Wheelbase | None = None
    base_to_rear_axle_m: AxleDistance | None = None
    mass_kg: Mass | None = None
    max_speed_mps: Rate | None = None
    max_yaw_rate_radps: Rate | None = None
    max_steering_rad: Steering | None = None
    controller_track_multiplier: TrackMultiplier | None = None
    running_gear: RunningGear | None = None

    def list_values(self) -> dict[str, object]:
        """The given values by name; aliases of a kind are replaced by the kind."""
        values = {key: value for key, value in msgspec.structs.asdict(self).items() if value is not None}
        return {**values, **KIND_WORDS.get(self.kind or "", {})}


class RunSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[run]``: dataset and terrain of the run.

    Attributes:
        dataset: runs that are evaluated together.
        terrain: name of the terrain.
    """

    dataset: str | None = None
    terrain: str | None = None


class TruthSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[truth]``: what was measured by hand, for a log without any localization.

    Attributes:
        distance_m: distance between start and end of a straight drive by a tape, to 5 mm or 0.5 %.
        turns: whole and part turns on the spot as counted, to a tenth; those to either side add up.
    """

    distance_m: Annotated[float, msgspec.Meta(ge=1e-3, le=1e5)] | None = None
    turns: Annotated[float, msgspec.Meta(ge=0.25, le=1e4)] | None = None


class OutageSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``ignore`` of ``[wheels]``: readings that are none, of one side or of both.

    Attributes:
        side: ``left``, ``right`` or ``both``.
        start_s: first of them, in seconds after the start of the log; by default its start.
        end_s: end of them; by default that of the log.
    """

    side: Literal["left", "right", "both"] = "both"
    start_s: Instant | None = None
    end_s: Instant | None = None


class DriveSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[command]`` or ``[wheels]``: source of wheel speeds, of a body command, or of speed and steering.

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
        unit: unit of wheel speeds, or of wheel angles; by default that of the message type.
        per_turn: ticks per turn of the wheel.
        yaw_unit: unit of the yaw rate of a body command; by default that of the message type.
        steering_unit: unit of the steering angle; by default that of the message type.
        sign: -1 if forward is recorded as negative.
        reversed: side that counts backward, by its name; ``none``: neither.
        exchanged: whether left and right are exchanged.
        scale: factor on recorded speeds, where encoders count low or high.
        factors: the same of a side (``left``, ``right``) or of a joint, below zero where it counts backward.
        ignore: spans whose readings are none; empty: all are taken as recorded.
        interpolate: whether commands that the recorder lost are taken to be between the ones around them.
        time: which of the message's times to use.
        late_s: how much later than its moment a message is stamped; below zero: earlier.
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
    per_turn: Annotated[float, msgspec.Meta(ge=1e-2, le=1e9)] | None = None
    yaw_unit: Literal["rad/s", "deg/s", "mrad/s"] | None = None
    steering_unit: Literal["rad", "deg"] | None = None
    sign: Literal[1, -1] | None = None
    reversed: Literal["left", "right", "none"] | None = None
    exchanged: bool | None = None
    scale: Annotated[float, msgspec.Meta(ge=1e-4, le=1e4)] | None = None
    factors: dict[str, Factor] | None = None
    ignore: list[OutageSection] | None = None
    interpolate: bool | None = None
    time: Clock | None = None
    late_s: Instant | None = None
    hold_s: Span | None = None

    @property
    def direction(self) -> int:
        """Factor on recorded speeds that makes forward positive."""
        return self.sign or 1


LENGTH_UNITS: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units of positions [m]."""


class PoseSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[pose]``: a pose topic, three fields of a topic, or a pair of frames of the transforms.

    Attributes:
        topic: poses, satellite fixes, or velocities over ground.
        x: field with the position along x [m], such as ``/tracker.x``, for a topic of any type.
        y: field of the same topic with the position along y [m].
        yaw: field of the same topic with the heading, counterclockwise from x.
        yaw_unit: unit of a heading that is one number; by default that with which the body moves along it.
        name: model, link or joint, if a message of the topic contains the poses of several.
        frames: parent and child.
        axes: ``enu``: y to the left of x, z up, as by default; ``ned``: y to the right, z down (north, east,
            down).
        up: axis of the poses' frames that points up, where it is not as ``axes`` says: ``y`` of motion
            capture, ``-y`` of a camera's optical frame.
        heading_deg: angle from the recorded heading to the vehicle's own [degrees], counterclockwise.
        unit: of the positions; by default metres.
        track: which of the tracks of two publishers on one topic, by their first poses.
        time: which of the message's times to use.
    """

    topic: str | None = None
    x: str | None = None
    y: str | None = None
    yaw: str | None = None
    yaw_unit: Literal["rad", "deg"] | None = None
    name: str | None = None
    frames: Annotated[list[str], msgspec.Meta(min_length=2, max_length=2)] | None = None
    axes: Literal["enu", "ned"] | None = None
    up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None
    heading_deg: Annotated[float, msgspec.Meta(ge=-360.0, le=360.0)] | None = None
    unit: Literal["m", "cm", "mm"] | None = None
    track: Literal[1, 2] | None = None
    time: Clock | None = None


class ImuSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[imu]``: the gyro.

    Attributes:
        topic: with the rates of turning.
        unit: of the rates; by default that of the message type.
        sign: -1 if turning to the left is recorded as negative.
        time: which of the message's times to use.
    """

    topic: str | None = None
    unit: Literal["rad/s", "deg/s"] | None = None
    sign: Literal[1, -1] | None = None
    time: Clock | None = None


class VelocitySection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[velocity]``: conversion of poses into velocities.

    Attributes:
        rate_hz: rate of the uniform grid.
        window_s: width of the local quadratic fit.
        yaw: source of the yaw rate in the slip tables.
        jump_m: smallest position jump that cuts a segment.
        jump_rad: smallest heading jump that cuts a segment.
        gap_s: shortest gap between poses that cuts a segment.
    """

    rate_hz: Annotated[float, msgspec.Meta(ge=0.1, le=1000.0)] = 20.0
    window_s: Annotated[float, msgspec.Meta(ge=0.05, le=10.0)] = 0.75
    yaw: Literal["pose", "imu"] = "pose"
    jump_m: Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)] = 0.1
    jump_rad: Annotated[float, msgspec.Meta(ge=1e-6, le=2.0 * math.pi)] = 0.1
    gap_s: Span = 0.12


class SlipSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[slip]``: the length scale L of the modulus and the transitory span after a command step."""

    length_scale_m: Annotated[float, msgspec.Meta(ge=1e-3, le=1e3)] = 1.0
    transitory_s: Span = 2.0


class IntervalSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[[interval]]``: span of live commands: while a String topic equals a text, or between two times."""

    topic: str | None = None
    equals: str | None = None
    start_s: Instant | None = None
    end_s: Instant | None = None


class Configuration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The complete configuration of one run."""

    vehicle: VehicleSection = VehicleSection()
    run: RunSection = RunSection()
    truth: TruthSection = TruthSection()
    command: DriveSection = DriveSection()
    wheels: DriveSection = DriveSection()
    pose: PoseSection = PoseSection()
    imu: ImuSection = ImuSection()
    velocity: VelocitySection = VelocitySection()
    slip: SlipSection = SlipSection()
    interval: list[IntervalSection] = []
    use_intervals: Literal["recorded", "all"] = "recorded"


_DRIVE_AS_RECORDED: Final[Mapping[str, object]] = {
    "yaw_unit": "rad/s", "steering_unit": "rad", "sign": 1, "reversed": "none", "exchanged": False,
    "scale": 1, "factors": {}, "late_s": 0, "time": "header",
}  # fmt: skip
AS_RECORDED: Final[Mapping[str, Mapping[str, object]]] = {
    "command": {**_DRIVE_AS_RECORDED, "unit": "m/s"},
    "wheels": {**_DRIVE_AS_RECORDED, "unit": "rad/s"},
    "pose": {"axes": "enu", "up": "z", "heading_deg": 0, "unit": "m"},
    "imu": {"unit": "rad/s", "sign": 1},
}
"""Values by section and key that change nothing of a usual log: written, they keep it as it is recorded."""


class UsualTopics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Usual topic names of a vehicle, by role; the first is preferred.

    ``misnamed`` lists topics whose content differs from their type, with the actual content.
    """

    command: list[str] = []
    wheels: list[str] = []
    pose: list[str] = []
    imu: list[str] = []
    misnamed: dict[str, str] = {}


class VendorController(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The vendor's controller and its use of body commands.

    Attributes:
        topics: ends of the names of its input topics.
        track_multiplier: factor on the vehicle's track width.
    """

    topics: list[str] = []
    track_multiplier: Positive = 1.0


class OwnUnit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A platform-specific unit: raw = per * value + offset.

    Attributes:
        per: raw units per unit of the value.
        unit: unit of the value.
        offset: raw number at zero.
    """

    per: float
    unit: Literal["rad/s", "m/s", "rad"]
    offset: float = 0.0


RADII_M: Final = (0.02, 1.0)
"""Radii [m] that wheels of vehicles have."""
UNKNOWN_VEHICLE: Final = "unknown"
"""Id of the vehicle that stands in where nothing identifies the log's."""


class Vehicle(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A vehicle's geometry and limits; units are in the names.

    Attributes:
        id: name in tables and file names, lower case with underscores.
        running_gear: wheels or tracks: tracks have the kinematics of a differential drive.
        source: source of a preset's numbers.
        recognized_by: words of namespaces, hosts and robot descriptions, and packages of message types, that
            identify the platform.
        sideways_preset: the same platform with wheels that allow sideways motion, under the same names; the
            commands distinguish the two.
        controller: the vendor's.
        units: units of the platform's topics, by name.
        stand_ins: names of dimensions that are not known. Their values only convert body motion into wheel
            speeds and back, and are none of the vehicle's.
        errors: standard errors of the dimensions that were estimated from a log, by name [m].
    """

    id: str
    name: str
    kind: Kind
    wheel_radius_m: Positive
    track_width_m: Positive | None = None
    wheelbase_m: Positive | None = None
    base_to_rear_axle_m: float = 0.0
    mass_kg: Positive | None = None
    max_speed_mps: Positive | None = None
    max_yaw_rate_radps: Positive | None = None
    max_steering_rad: Positive | None = None
    controller_track_multiplier: Positive = 1.0
    running_gear: RunningGear = "wheels"
    aliases: Annotated[list[str], msgspec.Meta(description="other names")] = []
    topics: UsualTopics = UsualTopics()
    source: str = ""
    recognized_by: list[str] = []
    sideways_preset: str = ""
    controller: VendorController = VendorController()
    units: dict[str, OwnUnit] = {}
    stand_ins: list[StandIn] = []
    errors: dict[str, float] = {}

    @property
    def kinematics(self) -> Kinematics:
        """Kinematics of its kind."""
        return find_kinematics(self.kind)

    def format_unknown(self) -> str:
        """Line on the dimensions that are not known, and how to give them; empty if all are known."""
        return f"Not known: {' and '.join(self.stand_ins)}. {GIVE_GEOMETRY}" if self.stand_ins else ""


# Without a command's options: a comment in XML must not contain two adjacent dashes.
GIVE_GEOMETRY: Final = (
    "Give the vehicle or its dimensions under [vehicle] in a run.toml beside the log, analyze it again, and "
    "apply its diagnosis to a new model."
)


@functools.cache
def list_presets() -> tuple[Vehicle, ...]:
    """All presets, sorted by id."""
    folder = resources.files("pipeline.sources") / "presets"
    presets = []
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith(".toml"):
            content = tomllib.loads(entry.read_text(encoding="utf-8"))
            presets.append(msgspec.convert({"id": entry.name[:-5], **content}, Vehicle))
    return tuple(presets)


def find_preset(name: str) -> Vehicle | None:
    """The preset of that id or alias, ignoring case, spaces and dashes; None if there is none."""
    wanted = _plain(name)
    for vehicle in list_presets():
        if wanted in {_plain(vehicle.id), *map(_plain, vehicle.aliases)}:
            return vehicle
    return None


def _plain(name: str) -> str:
    return name.strip().lower().replace("-", "_").replace(" ", "_")


_LONGEST_ID: Final = 64
"""Longest id of a vehicle, which stands in names of files and in errors, as long as that of an effect."""


def make_id(name: str) -> str:
    """Id of a vehicle of that name: lower case, with underscores in place of all but letters and digits."""
    return re.sub(r"\W+", "_", name.strip().lower())[:_LONGEST_ID] or "vehicle"


def resolve_vehicle(
    section: VehicleSection, *, recorded: str | None, where: str, recognized: Vehicle | None = None
) -> Vehicle:
    """The vehicle of a run.

    Args:
        section: values of the configuration and the command line.
        recorded: vehicle named in the log's `deployment` record, used when the configuration names none.
        where: the log, for the error message.
        recognized: vehicle recognized from the rest of the log, used when neither names a preset.

    Raises:
        ConfigurationError: no vehicle is named, the name is unknown, or a value is missing.
    """
    values = section.list_values()
    named = values.pop("preset", None)
    # A full geometry needs no preset; an unknown vehicle name in the log is then only a name.
    base = find_preset(str(recorded or "") if named is None else str(named))
    if named is not None and base is None:
        raise _unknown(f"no vehicle preset is called {named!r}", where, named=str(named))
    if base is None and not {"wheel_radius_m", "kind"} & set(values):
        base = recognized
    if base is None:
        if "wheel_radius_m" not in values:
            said = f"names {recorded!r}, which is not a preset" if recorded else "does not name one"
            raise _unknown(f"the vehicle cannot be determined: the log {said}", where)
        label = str(values.pop("name", None) or recorded or "vehicle")
        values = {"kind": list_kinds()[0], "id": make_id(label), "name": label, **values}
        return _require_geometry(msgspec.convert(values, Vehicle), where)
    if "name" in values:
        values["id"] = make_id(str(values["name"]))
    return _require_geometry(msgspec.structs.replace(base, **values), where)


def list_ranges(kind: type[msgspec.Struct]) -> dict[str, tuple[float, float]]:
    """Smallest and largest allowed value of the numbers of a section, by key."""
    fields = msgspec.inspect.type_info(kind).fields  # type: ignore[attr-defined]
    ranges = {field.encode_name: list_bounds(field.type) for field in fields}
    return {key: bounds for key, bounds in ranges.items() if bounds is not None}


def list_bounds(kind: msgspec.inspect.Type) -> tuple[float, float] | None:
    """Smallest and largest value of a type; None if it is not that of a number."""
    kinds = kind.types if isinstance(kind, msgspec.inspect.UnionType) else (kind,)
    for one in kinds:
        if isinstance(one, msgspec.inspect.FloatType | msgspec.inspect.IntType):
            return (
                -math.inf if one.ge is None else float(one.ge),
                math.inf if one.le is None else float(one.le),
            )
    return None


RANGES: Final = list_ranges(VehicleSection)
"""Bounds of a vehicle's values in SI units, by name."""
_SMALLER: Final = {
    "m": (("centimetres", 1e-2), ("millimetres", 1e-3)),
    "rad": (("degrees", math.pi / 180.0),),
    "s": (("milliseconds", 1e-3),),
}
_UNITS: Final = {"mps": "m/s", "radps": "rad/s", "hz": "Hz", "deg": "degrees"}
"""Units by the end of a key that is not the unit itself."""
_PLAIN_UNITS: Final = ("m", "s", "rad", "kg")


def explain_range(key: str, value: float, bounds: tuple[float, float]) -> tuple[str, str]:
    """What is wrong with a number outside its range, with its unit, and a hint."""
    least, largest = bounds
    end = key.rpartition(".")[2].rpartition("_")[2]
    fits = [(word, value * factor) for word, factor in _SMALLER.get(end, ())]
    fits = [(word, number) for word, number in fits if least <= number <= largest]
    unit = end if end in _PLAIN_UNITS else _UNITS.get(end)
    what = f"{key} = {value:g} is outside its range, {least:g} to {largest:g}{suffix_unit(unit)}"
    written = "; ".join(f"if it is in {word}, write {number:g}" for word, number in fits)
    return what, f"{written[0].upper()}{written[1:]}." if written else "Write a value of that range."


def _require_geometry(vehicle: Vehicle, where: str) -> Vehicle:
    required = [quantity.name for quantity in vehicle.kinematics.geometry if quantity.required]
    needed = next((name for name in required if getattr(vehicle, name) is None), None)
    if needed is not None:
        raise ConfigurationError(
            "vehicle_incomplete",
            f"a vehicle of kind {vehicle.kind!r} needs {needed}",
            where=where,
            hint=f"Set vehicle.{needed} in run.toml"
            + (" or give --track-width." if needed == "track_width_m" else "."),
        )
    check_geometry(vehicle, where)
    return vehicle


def check_geometry(vehicle: Vehicle, where: str) -> None:
    """Refuse a vehicle with a value that no vehicle has.

    Raises:
        ConfigurationError: ``implausible_geometry``.
    """
    for name, bounds in RANGES.items():
        value = getattr(vehicle, name)
        if value is not None and not bounds[0] <= value <= bounds[1]:
            what, hint = explain_range(name, value, bounds)
            raise ConfigurationError("implausible_geometry", what, where=where, hint=hint)


def _unknown(what: str, where: str, *, named: str = "") -> ConfigurationError:
    if named:
        hint = suggest_presets(named)
    else:
        names = ", ".join(vehicle.id for vehicle in list_presets())
        hint = (
            f"Give --vehicle NAME (make: VEHICLE=NAME) with one of {names}; "
            "or --wheel-radius and --track-width in metres."
        )
    return ConfigurationError("vehicle_unknown", what, where=where, hint=hint)


def suggest_presets(name: str) -> str:
    """Hint for a preset of a name that does not exist: the nearest three."""
    presets = [vehicle.id for vehicle in list_presets()]
    return (
        f"The nearest of {len(presets)} presets are {', '.join(list_nearest(name, presets))}; or give the"
        " vehicle's own values in its place."
    )


_KNOWN: Final[Mapping[str, tuple[float, str]]] = {
    "rad/s": (1.0, "rad/s"),
    "rpm": (2.0 * math.pi / 60.0, "rad/s"),
    "rev/s": (2.0 * math.pi, "rad/s"),
    "deg/s": (math.pi / 180.0, "rad/s"),
    "m/s": (1.0, "m/s"),
    "mm/s": (1e-3, "m/s"),
    "cm/s": (1e-2, "m/s"),
    "km/h": (1.0 / 3.6, "m/s"),
    "mrad/s": (1e-3, "rad/s"),
    "rad": (1.0, "rad"),
    "deg": (math.pi / 180.0, "rad"),
}


def list_factors(*made: str) -> dict[str, float]:
    """Factors from other units that encoders have to SI units.

    Args:
        made: SI units of the result.
    """
    rest = {"cm/s", "km/h", "mrad/s", "rev/s"}
    return {unit: factor for unit, (factor, si) in _KNOWN.items() if si in made and unit not in {si, *rest}}


def convert_unit(unit: str, own: Mapping[str, OwnUnit], *, where: str) -> tuple[float, float, str]:
    """Scale, offset and unit that convert raw numbers to SI: value = scale * (raw - offset).

    Args:
        unit: of the raw numbers.
        own: platform-specific units, which have priority.
        where: topic, for the error.

    Raises:
        ConfigurationError: ``unit_unknown``, the unit depends on the platform, which is unknown.
    """
    if unit in own:
        return 1.0 / own[unit].per, own[unit].offset, own[unit].unit
    if unit in _KNOWN:
        scale, made = _KNOWN[unit]
        return scale, 0.0, made
    remedy = (
        "per_turn = N (ticks a turn of the wheel)" if unit == "ticks" else 'unit = "rad/s", or a --vehicle'
    )
    raise ConfigurationError(
        "unit_unknown",
        f"{where} is in {unit}, whose scale on this vehicle is not known",
        where=where,
        hint=f"Set it in run.toml: {remedy}.",
    )
