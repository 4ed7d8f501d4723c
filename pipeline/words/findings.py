"""Sentences of findings: one template an id, formatted with the values of the finding."""

import math
import string
from collections.abc import Callable, Mapping
from typing import Any

from pipeline.core import (
    enumerate_texts,
    format_duration,
    format_errors,
    format_length,
    format_share,
    name_first,
    suffix_unit,
)
from pipeline.stages import Finding

Values = Mapping[str, Any]
"""The values of a finding, and ``where`` it is."""
Template = str | Callable[[Values], str]
"""A text with the names of values in braces, or what makes it of them."""


def format_finding(finding: Finding) -> str:
    """The sentence of a finding, without full stop.

    A finding of an error, whose ``values`` have its text under ``error``, says what the error says. One of
    stored results without the values of its sentence, as another version writes them, is named by its id.
    """
    if "error" in finding.values:
        return f"{'left out: ' * (finding.values.get('kind') == 'left out')}{finding.values['error']}"
    try:
        return finding.text or fill_template(finding)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        return finding.id.replace("_", " ")


def fill_template(finding: Finding) -> str:
    """The template of a finding with its values.

    Raises:
        LookupError: there is no template, or a value is missing.
        TypeError, ValueError: a value is of another kind.
    """
    template = TEMPLATES[finding.id]
    if isinstance(template, Mapping):
        template = template[finding.values["kind"]]
    values = {"where": finding.where, **finding.values}
    return _FILLER.vformat(template, (), values) if isinstance(template, str) else template(values)


class _Filler(string.Formatter):
    """`str.format` with the formats of this program by name: `{share:share}` is `56 %`."""

    def format_field(self, value: Any, format_spec: str) -> str:  # noqa: ANN401 - as the base class
        spell = _FORMATS.get(format_spec)
        return format(value, format_spec) if spell is None else spell(value)


_FILLER = _Filler()
_FORMATS: Mapping[str, Callable[[Any], str]] = {
    "share": format_share,
    "duration": format_duration,
    "length": format_length,
    "ms": lambda seconds: f"{seconds * 1e3:.0f} ms",
    "list": ", ".join,
    "and": enumerate_texts,
    "first": name_first,
}


# Of the stages


def _several_types(of: Values) -> str:
    types = of["types"]
    text = f"{of['where']} carries {len(types)} types, all read: {', '.join(types)}"
    if len(types) == 2:  # noqa: PLR2004 - as one says it
        text = f"{of['where']} carries two types, both read: {' and '.join(types)}"
    if of["lacks_stamps"]:
        text += "; one of them has no stamps: the times of recording are used"
    return text


def _type_left_out(of: Values) -> str:
    text = f"{of['where']} carries two types: {of['count']} messages of {of['type']}"
    if of["count"]:
        text += f", {of['first_s']:.0f} to {of['last_s']:.0f} s after the start of the log,"
    return f"{text} are left out: they do not have what is read of {', '.join(of['others'])}"


def _interval_applied(of: Values) -> str:
    says = " or ".join(map(repr, of["states"]))
    return f"only stretches in which {of['where']} says {says} were used ({of['count']} of them)"


def _slope_by_imu(of: Values) -> str:
    text = (
        f"the poses of {of['topic']} know no slope: roll, pitch and height are by {of['imu']}, up to "
        f"{math.degrees(of['value']):.0f} degrees"
    )
    mounted = math.degrees(of["mounted_rad"])
    if not mounted:
        return text
    side = "left" if mounted > 0.0 else "right"
    return f"{text}; by its accelerations it is mounted {abs(mounted):.0f} degrees to the {side} of ahead"


def _poses_apart(of: Values) -> str:
    count = of["count"]
    return (
        f"{count} pose{'s' * (count > 1)} of {of['where']} lie{'s' * (count == 1)} far from those before and "
        "after: left out"
    )


def _pose_gap(of: Values) -> str:
    gaps = "1 gap" if of["count"] == 1 else f"{of['count']} gaps"
    longest = f"{of['value']:.3g} s"
    return f"{gaps} in the poses of {of['where']}, the longest {longest}: the run is split there"


def _pose_jump(of: Values) -> str:
    often = "once" if of["count"] == 1 else f"{of['count']} times"
    return (
        f"the pose of {of['where']} jumped {often} (the map was corrected, or a late localization caught "
        "up): the run is split there"
    )


def _vehicle_frame(of: Values) -> str:
    inside = " in its namespace" * ("/" in of["frame"])
    return (
        f"no frame is called base_link: {of['frame']}, the only one that moves{inside}, is taken for the "
        "vehicle; [pose] frames = [parent, child] names others"
    )


def _antenna_unplaced(of: Values) -> str:
    return (
        f"no static transform places the antenna of {of['where']} ({of['frame'] or 'no frame'}) on the "
        "vehicle: it was taken to be at base_link (a lever arm would look like lateral slip in turns)"
    )


_BAD_POSES = {"rotated": "a rotated heading", "lost": "a motion that is not that of the wheels"}


def _bad_stretch(of: Values) -> str:
    seconds = of["seconds"]
    there = {_BAD_POSES[kind]: length for kind, length in seconds.items() if length > 0.0}
    shown = [words if len(there) == 1 else f"{words} ({length:.3g} s)" for words, length in there.items()]
    return (
        f"{sum(seconds.values()):.3g} s of the poses ({format_share(of['value'])} of the driving) have "
        f"{' or '.join(shown)}: left out of medians and fits"
    )


def _pose_delay(of: Values) -> str:
    order = "late" if of["value"] > 0.0 else "early"
    return f"the poses are {abs(of['value']):.2g} s {order} against the gyro: corrected"


def _short_segments(of: Values) -> str:
    are, hold = ("segment is", "holds") if of["count"] == 1 else ("segments are", "hold")
    return f"{of['count']} {are} shorter than {of['span_s']} s or {hold} one pose: left out"


def _heading_from_imu(of: Values) -> str:
    text = (
        f"the heading of {of['where']} is that of {of['sensor']}, aligned with the course over a minute: "
        "lateral motion that lasts longer is not observable"
    )
    if not of["value"]:
        return text
    return f"{text}; {format_share(of['value'])} of the positions are left out, where it was silent"


def _heading_from_course(of: Values) -> str:
    text = (
        f"the heading of {of['where']} is its course over ground, since no sensor that turns with it was "
        "recorded or agrees: lateral slip is not observable and reads zero"
    )
    if of["window_s"]:
        text += (
            f", and turns are smoothed over {of['window_s']:.2g} s, which makes those that change faster "
            "look smaller"
        )
    if of["value"]:
        share = format_share(of["value"])
        text += f"; {share} of the positions are left out, where the vehicle stands or turns about"
    return text


def _follows_wheels(of: Values) -> str:
    but = " but for their heading, which may be a gyro's" if of["has_other_heading"] else ""
    return (
        f"the poses follow the measured wheels to within rounding{but}: they are wheel odometry, not a "
        "localization, and the slip is zero by construction: draw no conclusion from it"
    )


def _map_uneven(of: Values) -> str:
    longer, low, high = (format_share(of[name], 2) for name in ("value", "low", "high"))
    return (
        f"by the wheels, distances in the map are {longer} ({low} to {high}) longer along its heading of "
        f"{of['heading_deg']:.0f} degrees than across: it is sheared or its axes have unequal scales, or "
        "there is a slope that the poses do not show (a scale of the whole map cannot be separated from the "
        "wheel radius)"
    )


def _pause(of: Values, silent: str) -> str:
    longest = format_duration(of["value"])
    most = longest if of["count"] == 1 else f"up to {longest}"
    return (
        f"{silent} was recorded for {most}: the recorder's clock was set, or the recording paused; that time "
        "does not count"
    )


def _simulated_time(of: Values) -> str:
    real = of["other_topics"]
    also = f"; so were the stamps of {', '.join(real)}, which are not simulated time" if real else ""
    return (
        f"the stamps run {of['value']:.3g} times as fast as the recorder's clock, and speeds are per second "
        "of the stamps: right for a simulation at this real-time factor, wrong for a robot, whose clock then "
        f"needs mending. Log times were mapped onto the stamps by those of {of['where']}{also}"
    )


def _clock_drift(of: Values) -> str:
    order = "fast" if of["value"] > 0.0 else "slow"
    return (
        f"the clock of {of['where']} runs {abs(of['value']):.0f} ppm {order} against the recorder's "
        f"({of['run_s'] * 1e3:.0f} ms over the run): its stamps were corrected"
    )


_DAY_S = 86_400.0
_LONG_S = 1e3
"""Offset of a clock [s] from which on it is said in minutes, hours and days."""


def _format_offset(seconds: float) -> str:
    if abs(seconds) > _DAY_S:
        return "more than a day (another epoch)"
    return format_duration(abs(seconds)) if abs(seconds) >= _LONG_S else f"{seconds:.3g} s"


def _stamp_after_log_time(of: Values) -> str:
    ahead = _format_offset(-of["value"])
    return f"the stamps of {of['where']} lie {ahead} after they were recorded: its clock runs ahead"


def _stamps_shifted(of: Values) -> str:
    apart = _format_offset(-of["value"])
    return f"the stamps of {of['where']} lie {apart} from the other topics' and were shifted"


def _log_times_shifted(of: Values) -> str:
    apart = _format_offset(of["recorder_s"])
    return f"the recorder's clock lies {apart} from the stamps: {of['where']}, which has none, was shifted"


def _heading_skew(of: Values) -> str:
    order = "lags" if of["value"] > 0.0 else "leads"
    return (
        f"compared with the wheels, the heading {order} the position by {abs(of['value']) * 1e3:.0f} ms: the "
        "localization delays them differently (similar to lateral skid), or the body has inertia"
    )


def _wheel_scale(of: Values) -> str:
    return (
        f"the {of['side']} wheels' encoder reads {format_share(1.0 - of['value'])} low against the other "
        "side: more is commanded there, and the vehicle does not turn accordingly (another gear or "
        "resolution?)"
    )


def _wheel_radius_wrong(of: Values) -> str:
    gain, radius = of["gain"], of["value"]
    return (
        f"the vehicle covers {format_share(gain)} of the distance that wheels with a radius of "
        f"{of['radius_m']:.3g} m roll: if the radius is {radius:.3g} m, give --wheel-radius {radius:.3g} or "
        f"another --vehicle (in the controller: a wheel radius multiplier of {gain:.2g}); or the positions "
        "have no scale, as those of a single camera"
    )


def _hardly_commanded(of: Values) -> str:
    text = f"the vehicle was hardly commanded to move: {of['value']:.2g} m of path in the whole run"
    if "moved_m" in of:
        text += f", but it moved, {of['moved_m']:.2g} m far: it was pushed, or what drove it is not recorded"
    return text


def _format_path(of: Values) -> str:
    """The path that was driven, and by what."""
    path = of["path_m"]
    source = "turned by the wheels" if of["of"] == "wheels" else "commanded"
    return f"{path:.0f} m {source}" if path >= 10.0 else f"{path:.2g} m {source}"  # noqa: PLR2004 - two digits


def _wheels_stand(of: Values) -> str:
    return f"the wheels do not turn: they rolled {format_share(of['value'], 0)} of the {_format_path(of)}"


def _body_stands(of: Values) -> str:
    return (
        f"the vehicle does not move: it covered {format_share(of['value'], 0)} of the {_format_path(of)} and "
        f"stayed within {of['moved_m']:.2g} m (wheels in the air, blocked, or stopped)"
    )


def _command_beyond_limit(of: Values) -> str:
    unit = of["unit"]
    reached = "the controller may clip it"
    if "reached" in of:
        reached = f"the vehicle then reaches {of['reached']:.2g} {unit} (median), so this limit does not act"
    return (
        f"the commanded {of['name']} exceeds the vehicle's limit ({of['limit']:g} {unit}) for "
        f"{format_share(of['value'])} of the time: {reached}"
    )


_STAGES: Mapping[str, Template | Mapping[str, Template]] = {
    "velocity_from_position": "{where} has no velocity of {joints:list}: positions were differentiated",
    "held_wheels": "the encoders are read every {value:.2g} s and each reading is repeated until the next "
    "one: interpolated between readings",
    "unit_wrong": {
        "of positions": "the velocities of {where} are what its positions turn, in {unit}: they were "
        "converted "
        '([wheels] unit = "rad/s" in run.toml where the positions are wrong)',
        "of the motion": "the measured wheels reach {fastest_mps:.3g} m/s, and the vehicle covers "
        "{value:.3g} "
        'times their distance: if they are in {unit}, set [wheels] unit = "{unit}" in run.toml',
    },
    "stale_command": {
        "lapsed": "for {seconds:duration} no command had arrived within the last {hold_s:.2g} s "
        "(command.hold_s): left out",
        "zero": "in {count} time steps the command is zero while the vehicle drives: the topic is stale, or "
        "the vehicle is driven by other means (restrict the run with [[interval]], or use --input measured)",
    },
    "steered_across": "for {seconds:duration} the steered wheel stands across, beyond 80 degrees: the speed "
    "of the rear axle does not tell how fast the vehicle turns; left out",
    "several_types": _several_types,
    "several_channels": {
        "joined": "{where} was recorded on {count} channels: their messages were put in one order",
        "fullest": "{where} was recorded on {count} channels of different types: the fullest was used",
    },
    "type_left_out": _type_left_out,
    "out_of_order": "{count} messages of {where} arrived out of order: sorted by their stamps",
    "duplicate_stamps": "{count} messages of {where} share their stamp with another",
    "interval_applied": _interval_applied,
    "body_upside_down": "the frame of the poses of {where} leans by {lean_deg:.0f} degrees, as that of a "
    "camera, or of a sensor that is mounted upside down (ahead, right, down): it was turned upright",
    "slope_by_imu": _slope_by_imu,
    "heading_unit": "the headings of {where} are in degrees: the body moves along them; converted, as "
    'yaw_unit = "deg" under [pose] in run.toml does; yaw_unit = "rad" takes them so',
    "body_chosen": "of the bodies of {where}, {body!r} is the vehicle",
    "encoder_scale_given": "the readings of the encoders are multiplied by {value:g}, as configured",
    "no_measured_wheels": "{where} was taken for measured wheels by its type, but {why}: left out",
    "sideways_command": "{value:share} of the commands of {where} ask for sideways motion, which {vehicle} "
    "({vehicle_kind}) cannot do, and that motion is left out: are its wheels mecanum or omni wheels? Then "
    '[vehicle] kind = "mecanum" (with wheelbase_m) or "omni" in run.toml, or --vehicle with one of '
    "{presets:list}",
    "absurd_values": "{count} numbers of {where} are infinite or beyond 1e12: they count as not recorded",
    "late_start": "in {count} of {starts} starts after a stop or gap the drive followed its first command "
    "late, by up to {value:.2f} s: models apply these commands with this delay",
    "digging_in": "the vehicle moved less and less per turn of its wheels: it dug in",
    "spinning": "the wheels turned and the vehicle hardly moved: the wheels spun",
    "sliding": "the vehicle moved faster than its wheels turned: it slid",
    "wheels_delay": "the encoders are {value:ms} late against the gyro (a filter or a clock): corrected",
    "pose_latency": "the latency of poses varies by {value:.2g} s: corrected with gyro and path",
    "pose_outliers": "{value:.3g} s excluded: the localization contradicts the wheels there",
    "quaternion_not_unit": "{count} quaternions of {where} were not of unit length: they were normalised",
    "bad_quaternion": "{count} poses of {where} have no orientation (a zero quaternion or not a number): "
    "left out",
    "bad_pose": "{count} poses of {where} are not numbers: left out",
    "poses_apart": _poses_apart,
    "pose_gap": _pose_gap,
    "pose_jump": _pose_jump,
    "slow_poses": "{where} gives a new pose every {value:.2g} s: too slow for velocities, so that much "
    "driving cannot be compared; record a faster localization, or the transforms (/tf): the odometry in them "
    "fills the time between its poses",
    "held_poses": "{value:share} of the poses of {where} repeat the one before: the localization is slower",
    "transforms": "poses are the transform from {parent} to {child}",
    "vehicle_frame": _vehicle_frame,
    "pose_is_odometry": {
        "transforms": "the transforms end at odom: the poses are an odometry, which drifts and may come from "
        "the wheels",
        "topic": "{where} gives poses in {parent}: they are an odometry, which drifts and may come from the "
        "wheels; slip against the wheels themselves is zero",
    },
    "sparse_corrections": "the localization corrects the odometry every {period_s:.2g} s (median): the poses "
    "between are the odometry, with each correction spread along the path before it",
    "transform_note": "{note}",
    "child_frame": {
        "pose unplaced": "{where} gives poses of {frame!r}, and no static transform leads from there to "
        "base_link: they were taken as poses of base_link (a lever arm would look like lateral slip in "
        "turns)",
        "pose moved": "{where} gives poses of {frame!r}: moved to base_link through the static transforms",
        "antenna unplaced": _antenna_unplaced,
        "antenna moved": "{where} is of an antenna {ahead_m:.2g} m ahead and {left_m:.2g} m left of "
        "base_link: moved there",
    },
    "bad_stretch": _bad_stretch,
    "commanded_otherwise": "in {count} pauses of the command, of up to {value:.1f} s, the vehicle moves "
    "otherwise than by its last one: another topic or a remote control commands it there, and these "
    "stretches are left out",
    "kept_command": "in {count} pauses the vehicle continues its last command until the next, for up to "
    "{value:.1f} s beyond command.hold_s: the base holds its last command; set command.hold_s to the longest "
    "pause to include these stretches",
    "emergency_stop": "the vehicle stood still under live commands: an emergency stop, or the drive was off; "
    "left out of all fits",
    "side_stopped": "the wheels of one side stood under live commands: one was stuck, or its motor off; left "
    "out of all fits",
    "manual_driving": "the vehicle moved without a command: by joystick, another controller, or a push; left "
    "out of all fits",
    "pushed": "the body moved while its wheels stood still: it was pushed or carried, or slid; left out of "
    "all fits",
    "commands_silent": "commands stopped arriving and the vehicle stopped: a watchdog, or a lost connection; "
    "left out of all fits",
    "stuck": "the wheels turned and the body did not move: it was stuck, dug in, or was lifted; left out of "
    "all fits",
    "localization_frozen": "the localization repeated one pose while the wheels turned: it was lost; left "
    "out of all fits",
    "imu_unchecked": "the vehicle turned too little to check the gyro against the poses: it was not used",
    "imu_disagrees": "the gyro does not agree with the poses, or is silent in part of the run: it was not "
    "used",
    "imu_sign": "the gyro's yaw rate has the wrong sign and was inverted: it then differs from the yaw rate "
    "of the poses by {residual:share}",
    "imu_scale": "the poses turn {value:.3f} times as much as the gyro says: it was scaled",
    "imu_bias": "the gyro has a bias of {value:.4f} rad/s against the poses: it was removed",
    "imu_gap": "the gyro is silent in {count} time steps: the poses' yaw rate is used there",
    "pose_delay": _pose_delay,
    "short_segments": _short_segments,
    "no_fix": "{count} messages of {where} are not a fix (a status below 0, or no place): left out",
    "no_heading": "the orientations of {where} never turn, though its positions do: they are positions alone",
    "heading_from_imu": _heading_from_imu,
    "heading_from_course": _heading_from_course,
    "velocity_disagrees": "{where} does not say how {topic} moves over ground: it was not used",
    "direction_assumed": "neither wheels nor commands show when the vehicle of {where} reversed: forward is "
    "assumed",
    "pose_from_wheels": {
        "follows the wheels": _follows_wheels,
        "is another": "the pose of {pose} is wheel odometry, not a localization: it is that of {same_as}, "
        "computed from the wheels, and says nothing about the ground; record a localization (lidar, camera, "
        "satellites, motion capture)",
        "is the only one": "the pose comes from the wheels, so forward slip is not observable: {where} is "
        "computed from them, and the log has no other pose",
    },
    "wheels_from_commands": "the measured wheels repeat the commands ({value:share} of their changes): a "
    "controller in open loop reports what it was asked for, and nothing was measured. The run is evaluated "
    "from its commands alone; record the encoders (/joint_states), or set open_loop: false in the controller",
    "map_uneven": _map_uneven,
    "clock_unset": {
        "stamps": "{count} stamps of {where} come from before the clock was set (1970): they were placed by "
        "their log times",
        "recorder": "{count} messages were recorded by a clock that is not set: it shows a time after the "
        "year 2116",
    },
    "clock_jump": {
        "pause": lambda of: _pause(of, "nothing"),
        "pause of topics in use": lambda of: _pause(of, "no topic in use"),
        "jump": "the clock of {where} jumped by up to {value:.3g} s while the recorder's ran on: its stamps "
        "were corrected with their log times, and the run is split there",
        "put back": "for about {value:.2g} s all topics are twice as dense as usual: the recorder's clock "
        "was put back, and both passes over that time were left out",
    },
    "simulated_time": _simulated_time,
    "clock_drift": _clock_drift,
    "bunched_times": "{where} has no stamps and was recorded in bunches, up to {value:ms} late: its messages "
    "were spread at the rate of their sender",
    "no_header_stamp": "the header stamps of {where} are all {stamps}: log times were used",
    "stamp_after_log_time": _stamp_after_log_time,
    "clock_offset": {"stamps": _stamps_shifted, "log times": _log_times_shifted},
    "heading_skew": _heading_skew,
    "wheel_scale": _wheel_scale,
    "wheel_radius_wrong": _wheel_radius_wrong,
    "wheels_dead": "the measured wheels are zero throughout while commands are live: an emergency stop was "
    "pressed, or the encoders are dead",
    "not_moving": {
        "hardly commanded": _hardly_commanded,
        "wheels stand": _wheels_stand,
        "body stands": _body_stands,
    },
    "command_beyond_limit": _command_beyond_limit,
}


# Of the diagnosis


def _changing_number(of: Values) -> str:
    from pipeline.models import name_term  # noqa: PLC0415 - heavy

    values = (of["before"], of["after"])
    change = abs(values[1] - values[0])
    places = max(1 - math.floor(math.log10(change)), 0) if change > 0.0 else 0
    before, after = (f"{value:.{places}f}{suffix_unit(of['unit'])}" for value in values)
    beside = f" (perhaps {enumerate_texts(list(map(name_term, of['others'])))}, too)" if of["others"] else ""
    return (
        f"the {name_term(of['where'])} changes {of['since_s']:.0f} s after the start of the run{beside}: its "
        f"{of['about']} is {before} before and {after} after; with a model for each part "
        f"{format_errors(*of['errors'])} remain"
    )


def _little_driving(of: Values) -> str:
    have = "the runs together have" if of["runs"] > 1 else "the run has"
    words = "commands" if of["input"] == "command" else "measured wheels"
    return (
        f"{have} {math.floor(of['driven_s'])} s of driving: effects estimated from {words} need at least "
        f"{of['least_s']:.0f} s, with turns and speeds of both signs"
    )


def _search_cut(of: Values) -> str:
    return (
        f"the search stopped after {of['budget_s']:g} s of CPU time: this is the best model found, and not "
        f"all alternatives were tried (--budget {2.0 * of['budget_s']:g}s continues the search)"
    )


def _encoder_scale(of: Values) -> str:
    factor = of["value"]
    return (
        f"the encoders read {format_share(abs(factor - 1.0))} {'low' if factor < 1.0 else 'high'}: the body "
        f"moves as commanded, while the wheels seem to turn {factor:.3g} times as fast as commanded and the "
        f"body to move {of['radius']:.3g} times as far as they turn. The readings were corrected for the "
        f"effects; scale = {1.0 / factor:.4g} under [wheels] in run.toml corrects the tables too. If instead "
        "the wheels have another radius and the drive has that gain by coincidence, scale = 1 names both"
    )


_DIAGNOSIS: Mapping[str, Template | Mapping[str, Template]] = {
    "changing_number": _changing_number,
    "little_driving": _little_driving,
    "search_cut": _search_cut,
    "encoder_scale": _encoder_scale,
    "model_not_followed": "{input}: {why}",
    "slippery_ground": "the vehicle covers {value:share} of the distance of its wheels: slippery ground and "
    "no wrong wheel radius, by the other runs",
    "quarantined_rows": "{count} rows of {where} break the contract ({rules:list}): they were moved to "
    "quarantine_{where}",
    "log_note": "{note}",
    "log_unchecked": "{why}",
    "repeated_messages": {
        "removed": "{count} messages of {where} are byte-for-byte copies of others: duplicates were removed",
        "ignored": "{count} messages of {where} are byte-for-byte copies of others: duplicates are ignored",
    },
}

TEMPLATES: Mapping[str, Template | Mapping[str, Template]] = {**_STAGES, **_DIAGNOSIS}
"""The sentences by the id of the finding; where an id has several, by its value ``kind``."""
