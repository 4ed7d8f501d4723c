"""Sentences of findings: one template an id, formatted with the values of the finding."""

import math
import string
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from pipeline.core import (
    enumerate_texts,
    format_count,
    format_duration,
    format_errors,
    format_length,
    format_line,
    format_share,
    group_by,
    name_first,
    suffix_unit,
)
from pipeline.recording import Finding
from pipeline.sources import RADII_M

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
        return fill_template(finding)
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
    return _fill(template, {"where": finding.where, **finding.values})


def _fill(template: Template, values: Values) -> str:
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


def _coarse_stamps(of: Values) -> str:
    ticks = "whole seconds" if of["value"] == 1.0 else f"steps of {of['value']:g} s"
    return (
        f"the stamps of {of['where']} count {ticks}, and its messages come every {of['period_s']:.2g} s: "
        "they are no times of its messages, and log times were used"
    )


def _several_robots(of: Values, *, why: str) -> str:
    return (
        f"{of['where']} holds the transforms of several robots ({name_first(of['frames'])}): {of['child']} "
        f"is taken, {why.format(**of)}"
    )


def _counter_jumps(of: Values) -> str:
    return (
        f"the counters of {', '.join(of['names'])} in {of['where']} jump {format_count(of['count'], 'time')} "
        f"(by {of['value']:.5g}), as one does that runs over or is set to zero: these steps were left out"
    )


def _velocity_zero(of: Values) -> str:
    return (
        f"the velocity of {', '.join(of['names'])} in {of['where']} is zero while the position turns: it is "
        "not measured, and the positions were differentiated"
    )


def _list_ratios(of: Values) -> str:
    return ", ".join(f"{one['ratio']:.3g} times for {one['name']}" for one in of["ratios"])


def _positions_too_fast(of: Values) -> str:
    return (
        f"the velocities of {of['where']} are not what its positions turn ({_list_ratios(of)}), which no "
        f"wheel does ({of['value']:.3g} rad/s): the velocities are used, and the positions may be counts of "
        "an encoder"
    )


def _positions_contradicted(of: Values) -> str:
    why = "its sign" if of["is_opposite"] else "a gear, a unit"
    return (
        f"the velocities of {of['where']} contradict its positions: they are {_list_ratios(of)} what these "
        f"turn ({why} or a scale of the driver): the positions were differentiated"
    )


def _unusual_value(of: Values) -> str:
    unit = suffix_unit(of["unit"])
    return (
        f"{of['parameter']} = {of['value']:.3g}{unit} of {of['where']} is unusual (usual: {of['low']:g} to "
        f"{of['high']:g}{unit}), and the data prove it: a wrong unit, scale or length has the same effect"
    )


def _interval_applied(of: Values) -> str:
    states = " or ".join(map(repr, of["states"]))
    return f"only stretches in which {of['where']} says {states} were used ({of['count']} of them)"


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
    if "position_s" in of:
        heading, position = map(_format_late, (of["value"], of["position_s"]))
        return f"the heading of the poses is {heading} against the gyro, their position {position} by the fit"
    return f"the poses are {_format_late(of['value'])} against the gyro: corrected"


def _format_late(value: float) -> str:
    return f"{abs(value):.2g} s {'late' if value > 0.0 else 'early'}"


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
    seen = (
        f"the vehicle covers {format_share(gain)} of the distance that wheels with a radius of "
        f"{of['radius_m']:.3g} m roll"
    )
    if not RADII_M[0] <= radius <= RADII_M[1]:
        return f"{seen}: a unit is wrong, of the wheels or of the positions, or the positions have no scale"
    return (
        f"{seen}: if the radius is {radius:.3g} m, give --wheel-radius {radius:.3g} or "
        f"another --vehicle (in the controller: a wheel radius multiplier of {gain:.2g}); or the positions "
        "have no scale, as those of a single camera"
    )


def _gain_assumed(of: Values) -> str:
    lines = " and ".join(f"[{one}]" for one in of["sections"])
    ratio = of["scale"]
    is_computed = of["by"] == "odometry"
    source = f"{of['source']} of this log" if is_computed else f"the way of {of['source']}"
    return (
        f"a gain of {of['used']:g} {of['unit']} per m/s is assumed, that of the preset; {source} says "
        f"{of['value']:.4g}, so that the speeds of {lines} are {max(ratio, 1.0 / ratio):.2g} times too "
        f"{'large' if ratio < 1.0 else 'small'}{'' if is_computed else ', if it is no slip'}: "
        f"scale = {ratio:.4g} under {lines} in run.toml corrects them"
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


def _format_turning(of: Values) -> str:
    """The share that was made of the turning that was asked for; empty where none was."""
    if "turned_rad" not in of:
        return ""
    degrees = math.degrees(of["turned_rad"])
    return f" and {format_share(abs(of['turning']), 0)} of the {degrees:.0f} degrees of turning"


def _wheels_stand(of: Values) -> str:
    rolled = f"{format_share(of['value'], 0)} of the {_format_path(of)}"
    return f"the wheels do not turn: they rolled {rolled}{_format_turning(of)}"


def _body_stands(of: Values) -> str:
    return (
        f"the vehicle does not move: it covered {format_share(of['value'], 0)} of the "
        f"{_format_path(of)}{_format_turning(of)}, and stayed within {of['moved_m']:.2g} m (wheels in the "
        "air, blocked, or stopped)"
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
    "coarse_stamps": _coarse_stamps,
    "several_robots": {
        "of the command": partial(_several_robots, why="in the namespace of {drive}"),
        "undecided": partial(
            _several_robots,
            why="and no namespace of {drive} says which is driven; [pose] frames = [parent, child] names "
            "another",
        ),
    },
    "counter_jumps": _counter_jumps,
    "velocity_zero": _velocity_zero,
    "position_unit": "the positions of {where} are what its velocities turn, in {unit}: the velocities are "
    "used",
    "velocity_not_of_position": {
        "positions too fast": _positions_too_fast,
        "contradicted": _positions_contradicted,
    },
    "unusual_value": _unusual_value,
    "drive_not_followed": "the measured wheels do not do what the commands ask: no model of the drivetrain "
    "explains half of their motion, and none of its effects is named ([command] topic in run.toml names the "
    "command of this drive)",
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
    "state_unknown": "{where} may have changed in what the log lost: for {seconds:duration}, until its next "
    "message, its state is unknown; left out",
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
    "sliding": "the vehicle moved faster than its wheels turned: it slid, or, where it is back at once, its "
    "localization jumped",
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
    "kept_command": "in pauses of the commands ({count}, of up to {value:.1f} s beyond command.hold_s) the "
    "vehicle continues its last command until the next: the base holds its last command; hold_s = {hold_s:g} "
    "under [command] in run.toml includes these stretches",
    "stopped": "the vehicle stood still under live commands: an emergency stop, or a drive that was off, "
    "blocked or too weak to move it; left out of all fits",
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
    "imu_sign": "the gyro's yaw rate has the wrong sign and was inverted, as sign = -1 under [imu] in "
    "run.toml does; sign = 1 takes it as recorded: inverted, it differs from the yaw rate of the poses by "
    "{residual:share}",
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
        "pause": partial(_pause, silent="nothing"),
        "pause of topics in use": partial(_pause, silent="no topic in use"),
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
    "gain_assumed": _gain_assumed,
    "wheels_dead": "the measured wheels are zero throughout while commands are live: an emergency stop was "
    "pressed, or the encoders are dead",
    "not_moving": {
        "hardly commanded": _hardly_commanded,
        "wheels stand": _wheels_stand,
        "body stands": _body_stands,
    },
    "command_beyond_limit": _command_beyond_limit,
}


# Of the recording


def _controller_multiplier(of: Values) -> str:
    used = of["used"]
    track = "the nominal track width" if used == 1.0 else f"{used:g} times the nominal track width"
    return (
        f"in turns the difference of the wheels is {of['turns']:.2f} times the one commanded with {track}: "
        f"vehicle.controller_track_multiplier = {of['value']:.3g} was used"
    )


def _wheels_scaled(of: Values) -> str:
    times, radius = of["value"], of["radius_m"]
    seen = f"in slow driving the wheels turn {times:.2f} times as fast as commanded, and the body moves as "
    other = f"radius is {radius / times:.3g} m and not {radius:.3g} m"
    if "track_m" in of:
        track = f"the track is {of['other_track_m']:.3g} m and not {of['track_m']:.3g} m"
        return f"{seen}commanded: the wheels' {other}, and {track}: name another vehicle (--vehicle)"
    return (
        f"{seen}commanded: their readings are {times:.2f} times what they should be "
        f"(scale = {1.0 / times:.3g} under [wheels] in run.toml), or their {other}"
    )


def _command_scaled(of: Values) -> str:
    seen = f"in slow driving the wheels turn {of['forward']:.2f} times as fast as commanded"
    if "turning" in of:
        seen += f", in turns their difference is {of['turning']:.2f} times the commanded one (median)"
    if "vehicle" in of:
        other = of["vehicle"]
        sizes = f"wheel radius {other['wheel_radius_m']:g} m, track {other['track_width_m']:g} m"
        cause = f"that of another vehicle ({other['name']}: {sizes})"
        sides = f"mean of the sides times {of['value']:.2f}, their difference times {of['turn_scale']:.2f}"
        done = f"corrected ({sides})"
    else:
        if "turning" in of:
            seen += ": no single scale fits, and slip from commands in turns depends on it"
        cause = "in another scale (another vehicle's wheel radius, a unit, or a gain of the drive)"
        done = f"commands are multiplied by {of['value']:.2f}"
    return f"the recorded command is {cause}: {seen}; {done}, also for models and exports"


def _command_not_scaled(of: Values) -> str:
    why = "over all of the drive they do not clearly follow a command of that scale better"
    if "turning" in of:
        why = (
            f"in turns their difference is {of['turning']:.2f} times the commanded one (median): no single "
            "scale fits"
        )
    return (
        f"in slow driving the wheels turn {of['forward']:.2f} times as fast as commanded; {why}: the "
        "commands are taken as recorded"
    )


def _tape_contradicts(of: Values) -> str:
    radius = f" and a wheel radius of {of['radius_m']:.4g} m" if "radius_m" in of else ""
    known = f"the {of['vehicle']}" if of["is_named"] else "the other signals"
    return (
        f"the distance that was measured by hand contradicts {known}: by {of['source']}{radius} it drove "
        f"{of['value']:.3g} times as far in this log. No length is taken from it: measure all that the log "
        "holds, or record the measured drive alone"
    )


def _taped_both_ways(of: Values) -> str:
    return (
        f"what was measured by hand shows no length: by {of['source']} the vehicle drove forward and back "
        f"({format_share(of['share'])} of the way against the rest), and a tape measures from start to end: "
        "record a drive in one direction"
    )


def _taped_no_vehicle(of: Values) -> str:
    return (
        f"by what was measured by hand and {of['source']}, {of['key']} is {of['value']:.3g}, which no "
        f"vehicle has ({of['least']:g} to {of['most']:g} m): it is not taken. Measure all that the log "
        "holds, and check the unit of the wheel speeds (unit under [wheels] in run.toml)"
    )


def _by_tape(of: Values) -> str:
    """Lengths by what was measured by hand, as lines of run.toml, or gains of a body's motion."""
    names = {"ahead": "drives", "turning": "turns"}
    texts = []
    for name in ("wheel_radius_m", "track_width_m", "ahead", "turning"):
        if name not in of:
            continue
        value, low, high = (f"{one:.4g}" for one in of[name])
        said = f"it {names[name]} {value} times what they say" if name in names else f"{name} = {value}"
        texts.append(f"{said} ({low} to {high})")
    lines = "lines of [vehicle] in run.toml, " if of["kind"] == "sides" else ""
    shown = f"what was measured by hand and {of['source']} show ({lines}with what such measuring allows)"
    return f"{shown}: {enumerate_texts(texts)}"


def _preset_differs(of: Values) -> str:
    key, described = of["key"], f"{of['described']:.4g}"
    return (
        f"the robot description says {key} = {described}, the preset {of['preset']} {of['known']:g}: the "
        f"preset is used; vehicle.{key} = {described} uses the other"
    )


def _name_source(source: str) -> str:
    """What names a vehicle, in words."""
    return source.replace("_", " ")


def _controller_differs(of: Values) -> str:
    return (
        f"the parameters of {of['controller']} say {of['key']} = {of['set']:.4g}, the "
        f"{_name_source(of['source'])} {of['known']:.4g}: the parameters are used"
    )


def _radius_contradicted(of: Values) -> str:
    commanded, rolled = (
        f"{radius:.3g} m ({low:.3g} to {high:.3g} m)"
        for radius, low, high in (of["commanded_m"], of["rolled_m"])
    )
    return (
        f"not used: {of['wheels']}: by the commands the wheel radius is {commanded}, by the poses {rolled}, "
        f"as if the wheels covered {format_share(of['rolled_m'][0] / of['commanded_m'][0])} of the distance "
        "(--wheel-radius and --track-width, or --vehicle, decide)"
    )


def _no_readable_text(of: Values) -> str:
    subject = "the topic was" if len(of["topics"]) == 1 else "the topics were"
    return f"no message of {name_first(of['topics'])} is a readable command: {subject} left out"


def _vehicle_contradiction(of: Values) -> str:
    named = (
        f"run.toml or the log's metadata states {of['vehicle']}, which is used: check [vehicle] or --vehicle"
    )
    if of["is_flag"]:
        named = f"{of['vehicle']} was given: check --vehicle"
    return (
        f"the {_name_source(of['source'])} of the log indicates a {of['indicated']} "
        f"({', '.join(of['differing'])}), but {named}"
    )


def _vehicle_by_motion(of: Values) -> str:
    given = "--vehicle" if of["is_flag"] else "[vehicle]"
    return (
        f"by the motion the wheels have a radius of {of['value']:.3g} m, as those of the {of['indicated']} "
        f"that the {_name_source(of['source'])} of the log indicates, and not {of['radius_m']:.3g} m, as "
        f"those of the {of['vehicle']} that is stated: correct {given}"
    )


def format_other_vehicles(contradictions: Sequence[tuple[str, Values]]) -> list[str]:
    """One sentence for each vehicle that is stated for several logs which indicate another one.

    Args:
        contradictions: each run with the values of its finding ``vehicle_contradiction``.
    """
    groups = group_by(((str(of.get("vehicle")), str(of.get("indicated"))), run) for run, of in contradictions)
    return [
        f"{format_count(len(runs), 'log')} indicate{'s' * (len(runs) == 1)} a {indicated}, and not the "
        f"{vehicle} that is stated and used: {name_first(runs)}; check [vehicle] in run.toml and fleet.toml, "
        "or --vehicle"
        for (vehicle, indicated), runs in sorted(groups.items())
    ]


_LENGTHS = {"wheel_radius_m": "a wheel radius", "track_width_m": "a track", "wheelbase_m": "a wheelbase"}


def _wheels_alone(of: Values) -> str:
    taken = " and ".join(f"{_LENGTHS[key]} of {value:g} m" for key, value in of["assumed"].items())
    return (
        "no vehicle is given: commands and measurements are of the same wheels, and shares of slip need "
        f"none; lengths in metres are for {taken} ([vehicle] {', '.join(of['assumed'])} in run.toml: others)"
    )


def _body_alone(of: Values) -> str:
    text = (
        "no vehicle is given: commands and measurements of the drive are body motion, "
        "whose slip does not depend on wheel radius and track width"
    )
    if "track_m" in of:
        track = f"{of['track_m']:g} m"
        text += f"; a difference of the wheels is that at a track of {track} (--track-width: another)"
    if of["is_omni"]:
        text += " (sideways motion is commanded: --vehicle reads joints as mecanum wheels)"
    return text


def _lengths_of_vehicle(of: Values) -> str:
    by: dict[str, list[str]] = {"given": [], "controller": [], "motion": []}
    for one in of["lengths"]:
        article = f"a{'n' * one['name'].startswith('e')}"
        by[one["by"]].append(f"{article} {one['name']} of {one['value']:.3g} m")
    own, commanded, moved = (" and ".join(parts) for parts in by.values())
    fitted = [one for one in of["lengths"] if one["by"] != "given"]
    is_differential = of["vehicle_kind"] == "differential"
    text = f"the vehicle has {own}, as given or recorded"
    if fitted:
        text = "the log does not identify the vehicle" + (f": {own} as given or recorded" if own else "")
    if commanded:
        verb = "are" if " and " in commanded else "is"
        text += f"; its controller turns commands into wheel speeds by {commanded}, which {verb} used"
    if moved:
        verb = "fit" if len(by["motion"]) > 1 else "fits"
        text += f"; {moved} {verb} the motion, so that no effect is reported of it"
    if is_differential and not of["has_track"]:
        text += "; there is too little turning for a track, or it is too uneven: give --track-width"
    if fitted:
        options = " or --wheel-radius and --track-width" if is_differential else ""
        ranges = ", ".join(f"{one['name']} {one['low']:.3g} to {one['high']:.3g} m" for one in fitted)
        text += (
            f"; it is a guess (95 % of ten-second blocks of the drive: {ranges}), and slip from wheel "
            f"encoders is as uncertain: [vehicle] in run.toml, as slip inspect shows it,{options} corrects it"
        )
    return text + _name_alike(of)


def _name_alike(of: Values) -> str:
    """Platforms with the lengths of a vehicle, in brackets; empty without."""
    alike = of["alike"]
    if not alike:
        return ""
    if of["has_track_of_alike"]:
        first, called = next(iter(alike.items()))
        return f" (a {called} has about these: if it is one, give --vehicle {first})"
    turns = f"turns at {format_share(of['turns'])} of the ideal rate"
    return (
        f" (if it is a {' or '.join(alike.values())}, which has such wheels, it {turns}: give --vehicle "
        f"{' or '.join(alike)}; else pass this by)"
    )


def _vehicle_of_folder(of: Values) -> str:
    logs = of["logs"]
    who = f"{logs[0]} of its folder with the same topics is"
    if len(logs) > 1:
        who = f"{logs[0]} and {len(logs) - 1} more of its folder with the same topics are"
    return (
        "the end of the recording is lost, and it does not name its vehicle: it is taken to be a "
        f"{of['vehicle']}, as {who}; another: --vehicle, or in run.toml: "
        f'vehicle = {{preset = "{of["preset"]}"}}'
    )


_FAULTS_OF_SIGNS = {
    "pose_backward": "the frame of the poses points to the rear, as that of a sensor that is mounted "
    "backward",
    "pose_mirrored": "the poses' frame is of the other hand, as north, east, down",
    "command_ahead": "the sign of linear.x is wrong where it is sent, or both motors are reversed",
    "command_turned": "the sign of angular.z or of the steering is inverted, or left and right are exchanged",
    "command_aside": "the sign of linear.y is wrong where it is sent",
    "command_mirrored": "left and right are exchanged where it is sent",
    "command_both": "its sign is wrong where it is sent, or both motors are wired backward",
    "wheels_both": "both encoders count backward",
    "wheels_exchanged": "left and right encoders are exchanged",
    "wheels_exchanged_both": "both encoders count backward, and are exchanged",
    "gyro": "the gyro is mounted upside down",
}
_REMEDIES = {
    "pose_backward": " (heading_deg = 180 under [pose] in run.toml)",
    "pose_mirrored": ' (up = "-z" under [pose] in run.toml)',
    "command_turned": ', which is to be corrected on the robot (up = "-z" under [pose] in run.toml reads '
    "this log all the same, with left and right exchanged)",
    "wheels_both": " (sign = -1 under [wheels] in run.toml)",
    "wheels_exchanged": " (exchanged = true under [wheels] in run.toml)",
    "wheels_exchanged_both": " (sign = -1 and exchanged = true under [wheels] in run.toml)",
}
_SIGNALS = {"command": "the commands", "wheels": "the measured wheels", "gyro": "the gyro"}
_VERBS = {"ahead": "drive", "turned": "turn", "aside": "move sideways"}


def _signal_reversed(of: Values) -> str:
    faults = "; or ".join(_FAULTS_OF_SIGNS[one] for one in of["faults"])
    return f"{of['source']} contradicts all other signals: {faults}"


def _signal_against_poses(of: Values) -> str:
    against = " and ".join(_SIGNALS[name] for name in of["against"])
    verbs = " and ".join(_VERBS[axis] for axis in of["axes"])
    options = "; or ".join(
        " and ".join(f"{_FAULTS_OF_SIGNS[name]}{_REMEDIES.get(name, '')}" for name in names)
        for names in of["ways"]
    )
    return (
        f"{against} and the poses {verbs} opposite ways, and no third signal tells which of them is wrong: "
        f"either {options}"
    )


def _command_against_wheels(of: Values) -> str:
    what = "one side of the wheels runs backward against its command"
    if of["verbs"]:
        what = f"the wheels {enumerate_texts(of['verbs'])} the other way than {of['source']} commands"
    return (
        f"{what}, and no third signal shows which of them is wrong: either the encoders ({of['change']} "
        "under [wheels] in run.toml), or the command or the polarity of the motors, which are to be "
        "corrected on the robot"
    )


def _joint(of: Values) -> str:
    factor = of["factor"]
    how = "counts backward" if factor < 0.0 else "counts"
    against = "against" if abs(factor) == 1.0 else f"{1.0 / abs(factor):.3g} times as fast as"
    return f"{of['joint']} of {of['source']} {how} {against} the other wheels"


def _side_scale(of: Values) -> str:
    return (
        f"the {of['side']} wheels' encoder counts {1.0 / of['factor']:.3g} times as much as the "
        f"{of['other']} one for the same motion (another gear or resolution?)"
    )


_WITNESSES = {"command": "commands", "wheels": "wheels", "gyro": "the gyro"}


def _name_witnesses(names: Sequence[str]) -> str:
    return enumerate_texts([_WITNESSES[name] for name in names]) or "the other signals"


def _axis_up(of: Values) -> str:
    direction, axis = ("down" if of["up"].startswith("-") else "up"), of["up"].removeprefix("-")
    why = ", as of motion capture or of a camera's optical frame: the body turns about it"
    if axis == "z":
        why = " (north, east, down)"
    who = _name_witnesses(of["witnesses"])
    return f"the {axis} axis of the poses of {of['source']} points {direction}{why}, as {who} show"


def _heading_off(of: Values) -> str:
    off = f"{abs(of['offset_deg']):.0f} degrees to the {'right' if of['offset_deg'] > 0.0 else 'left'}"
    drivers = _name_witnesses(of["witnesses"])
    return f"the heading of {of['source']} is {off} of the course of {drivers}"


def _looks_to_the_rear(of: Values) -> str:
    return (
        f"the poses of {of['source']} look to the rear where {_name_witnesses(of['witnesses'])} drive ahead "
        "(a sensor that is mounted backward, or base_link points to the rear)"
    )


_FOLLOWED = {"wheels": "the wheels", "pose": "poses"}
"""What follows a command, in words."""


def _late_stamps(of: Values) -> str:
    late, followed = f"{of['late_s']:.2f} s", _FOLLOWED[of["followed"]]
    return f"the stamps of {of['source']} are {late} late, for {followed} follow it before it is sent"


def _unit(of: Values) -> str:
    unsure = ", or has no unit, as percent of a throttle, whose gains say nothing of the robot"
    return f"the {of['what']} of {of['source']} is in {of['unit']}{'' if of['is_sure'] else unsure}"


def _unit_of_wheels(of: Values) -> str:
    unit = of["unit"] or "no usual unit"
    text = f"the wheel speeds of {of['source']} are in {unit}"
    if "rolled_m" in of:
        text += (
            f": in rad/s they would be those of wheels with a radius of {of['rolled_m']:.3g} m. They are "
            f"{of['times']:.3g} times those of wheels of {of['usual_m']} m, as ticks are, or turns "
            "before a gear, or those of a motor's field by its pole pairs"
        )
    if "taken_m" in of:
        taken = f"taken as those of wheels of {of['taken_m']} m, which alters no slip"
        text += f"; {taken}" if "rolled_m" in of else f": {taken}"
    return text


def _contradicts_itself(of: Values) -> str:
    is_pose, step = of["kind"] == "pose", of["step_s"]
    speeds = f"the speeds of {of['velocity']}" if "velocity" in of else "its own speeds"
    text = f"the pose of {of['source']} {of['what']} {of['value']:.3g} times as far as {speeds} say"
    if step is not None:
        made = "added up without" if is_pose else "changes that are not divided by"
        text += f", as if these were {made} the time step of {step:.3g} s"
    if not is_pose and "velocity" in of:
        return f"{text}; of these only the direction is used"
    return f"{text}; not used: its {of['kind']}"


FAULTS: Mapping[str, Template] = {
    **_FAULTS_OF_SIGNS,
    "joint": _joint,
    "idle joints": "the drive does not turn {joints:and} of {source}, as it does the other wheels of its "
    "side",
    "side scale": _side_scale,
    "side backward": "the {side} wheels' encoder counts backward",
    "sides by motion": "the joints of {source} do not name their side; by the motion {left:list} are left "
    "and {right:list} right",
    "speed backward": "the speed of {source} counts backward",
    "clock ahead": "the stamps of {source} lie {ahead_s:duration} after they were recorded, and those of the "
    "other topics do not: its clock runs ahead",
    "axis up": _axis_up,
    "heading off": _heading_off,
    "looks to the rear": _looks_to_the_rear,
    "late stamps": _late_stamps,
    "gyro in degrees": "the gyro of {gyro} is in degrees per second",
    "unit of positions": "the positions of {source} are in {unit}",
    "unit as measured": "the wheel speeds of {source} are in {unit}, as those that are measured",
    "unit of a drive": _unit,
    "unit of wheels": _unit_of_wheels,
}
"""What is wrong in a log and corrected by a line of run.toml, by the value ``fault`` of the finding."""


def _corrected(of: Values) -> str:
    otherwise = "".join(f"; {line} takes them as recorded" for line in of["otherwise"])
    fault = _fill(FAULTS[of["fault"]], of)
    return f"{fault}: corrected, as {of['line']} under [{of['where']}] in run.toml does{otherwise}"


def _configured(of: Values, taken: str = "") -> str:
    fault, given = _fill(FAULTS[of["fault"]], of), enumerate_texts(of["given"])
    instead = f"{of['line']} in its place agrees with the other signals"
    return f"{fault}, but [{of['where']}] in run.toml gives {given}{taken}: {instead}"


def _configured_wrongly(of: Values) -> str:
    given = [format_line(key, value) for key, value in of["given"].items()]
    instead = of.get("instead")
    agree = f"{enumerate_texts(instead)} is found, and they agree" if instead else "they agree"
    return (
        f"[{of['where']}] in run.toml (or in a fleet.toml above it) gives {enumerate_texts(given)}, which "
        f"contradicts the other signals; without it {agree}: take it out"
    )


def _contradicted(of: Values) -> str:
    one, other = of["halves"]
    return (
        f"{_fill(FAULTS[of['fault']], of)} by all of the drive, but its parts contradict each other: in the "
        f"first the motion is {one:.3g} times the signal, in the last {other:.3g} times. Not corrected "
        f"({of['line']} under [{of['where']}] in run.toml takes it so)"
    )


def _unit_undecided(of: Values) -> str:
    seen = f": the body moves {of['value']:.3g} times as far as it says" if "value" in of else ""
    key = of["key"]
    return (
        f"the {of['what']} of {of['source']} may be in {of['other']}{seen}; it is taken as {of['unit']}, and "
        f'no other signal tells which ({key} = "{of["other"]}" under [{of["where"]}] in run.toml takes it '
        f'so, {key} = "{of["unit"]}" settles it)'
    )


def _mixed(of: Values, done: str) -> str:
    when = f"from {of['start_s']:.0f} to {of['end_s']:.0f} s"
    when += f" and in {of['count'] - 1} further stretches" if of["count"] > 1 else ""
    return (
        f"two publishers send commands on {of['source']} by turns {when} ({format_share(of['value'])} of the "
        "messages there are zero): which of them the drive obeys depends on when it reads; let one send at a "
        f"time (twist_mux does){done}"
    )


def _tracks(of: Values, rest: str) -> str:
    """Poses that alternate between two tracks, and what follows."""
    frames = f" of {' -> '.join(of['frames'])}" if of["frames"] else ""
    return (
        f"two publishers{frames} send on {of['source']} by turns: its poses jump to and fro between two "
        f"tracks, {rest}"
    )


_ONE_TRACK = "let one publish, or give each its own frames"
_NO_TRACK = f"{_ONE_TRACK}; [pose] track = 1 or 2 in run.toml takes those of one"


def _track_taken(of: Values) -> str:
    which = ("first", "second")[of["number"] - 1]
    return _tracks(
        of,
        f"and those of the {which} one are taken, which follow {of['by']} ([pose] track = {of['number']} in "
        f"run.toml; track = {3 - of['number']} takes the others); {_ONE_TRACK}",
    )


def _mixed_left_out(of: Values) -> str:
    return _mixed(of, f": left out, as {of['line']} under [command] in run.toml does; ignore = [] takes them")


def _mixed_replaced(of: Values) -> str:
    return _mixed(of, f": {of['source']} is not used, and the run is analyzed from its wheels")


def _motor_reversed(of: Values) -> str:
    also = {
        "encoder too": "and its encoder with it",
        "encoder right": "and its encoder counts what it does",
        "no encoder": "as far as commands and poses tell",
    }[of["kind"]]
    return (
        f"the {of['side']} side of the drive runs backward against its command, {also}: the polarity of its "
        "motor is wrong; exchange its wires, or turn its sign in the driver"
    )


def _wheel_dead(of: Values) -> str:
    rest = "the log holds no pose that could take its place"
    if of["has_pose"]:
        rest = f"take --input command, or correct [wheels] {of['side']}"
    if "messages" in of:
        return (
            f"the {of['side']} wheels' encoder is silent: {format_count(of['messages'], 'message')} of it "
            f"{'is' if of['messages'] == 1 else 'are'} recorded, {of['of_other']} of the {of['other']} "
            f"wheels' ({rest})"
        )
    return (
        f"the {of['side']} wheels' encoder reads the same throughout while the {of['other']} wheels turn: it "
        f"is dead ({rest})"
    )


_READS = {
    "nothing": "no reading is recorded",
    "zero": "zero is recorded",
    "one value": "one value is repeated",
    "noise": "noise is recorded",
}
_GOES_ON = {"command": "the commands", "pose": "the poses", "other wheels": "the other wheels"}


def _encoder_dead(of: Values) -> str:
    witnesses = enumerate_texts([_GOES_ON[name] for name in of["witnesses"]])
    texts = []
    for one in of["stretches"]:
        side = one["side"]
        who = "both wheels' encoders read" if side == "both" else f"the {side} wheels' encoder reads"
        when = f"until {one['end_s']:.0f} s" if "end_s" in one else "throughout"
        if "start_s" in one:
            end = f"to {one['end_s']:.0f} s" if "end_s" in one else "s on"
            when = f"from {one['start_s']:.0f} {end}"
        texts.append(f"{who} nothing {when} ({_READS[one['reads']]} while {witnesses} go on)")
    return (
        f"{'; '.join(texts)}: left out, as {of['line']} under [wheels] in run.toml does; ignore = [] takes "
        "it as recorded"
    )


def _pose_angle(of: Values) -> str:
    side = "left" if of["value"] > 0.0 else "right"
    return (
        f"the body moves {abs(math.degrees(of['value'])):.1f} degrees (±{of['half_deg']:.2g}) to the {side} "
        f"of the headings of {of['pose']}: their frame is turned, or the body crabs or drifts, as on a bent "
        "axle or along a slope; no other signal tells which "
        f"(heading_deg = {of['heading_deg']:.1f} under [pose] in "
        "run.toml turns it)"
    )


def _pose_lever(of: Values) -> str:
    size, half = format_length(abs(of["value"])), format_length(of["half_m"])
    side = "ahead of" if of["value"] > 0.0 else "behind"
    return (
        f"the point whose poses {of['pose']} gives lies {size} (±{half}) {side} the axis about which the "
        "body turns: it is not corrected, since wheels that grip unlike front and rear move that axis, too"
    )


def _command_timeout(of: Values) -> str:
    seconds, low, high, hold = (of[name] for name in ("value", "low", "high", "hold_s"))
    held = "commands are held for this time"
    if not low <= hold <= high and hold != seconds:
        held = f"command.hold_s = {hold:g} holds them {'longer' if hold > seconds else 'shorter'}"
    return (
        f"the base begins to stop {seconds:.2f} s ({low:.2f} to {high:.2f} s) after the last command (from "
        f"{of['count']} pauses): {held}"
    )


def _commands_in_bursts(of: Values) -> str:
    return (
        f"{_command_timeout(of)}; commands are rarer than that, so that it drives in bursts: send them more "
        "often. It is taken to be as fast as commanded in them: gains of the drive are not known from such a "
        "log"
    )


def _command_delay(of: Values) -> str:
    from pipeline.models import name_term  # noqa: PLC0415 - heavy

    late, explained = of["value"], of.get("explained_by")
    if explained:
        causes = enumerate_texts(list(map(name_term, explained)))
        return (
            f"{_FOLLOWED[of['followed']]} seem to follow {of['source']} {late:.2f} s after its stamps, then "
            f"with a lag of {of['lag_s']:.2f} s: the diagnosis explains both by {causes}, without a dead time"
        )
    return (
        f"{_FOLLOWED[of['followed']]} begin to follow {of['source']} {late:.2f} s after its stamps, then "
        f"with a lag of {of['lag_s']:.2f} s: the drive answers so late, or the stamps are early; no other "
        f"signal tells which (late_s = {-late:.2f} under [command] in run.toml takes them for early)"
    )


def _command_late(of: Values) -> str:
    followed, late = _FOLLOWED[of["followed"]], of["value"]
    return (
        f"{followed} follow {of['source']} {late:.2f} s before it is sent, which nothing can: its stamps are "
        f"late, or those of {followed} early, and no other signal tells which (late_s = {late:g} under "
        "[command] in run.toml corrects the first)"
    )


def _commands_lost(of: Values, rest: str = "") -> str:
    return (
        f"{format_share(of['value'])} of the messages of {of['source']} are missing: they come every "
        f"{of['period_s']:.2g} s, or after two, three or more times that, at random. They were lost, as over "
        f"a radio link or with QoS best effort{rest}"
    )


def _commands_undecided(of: Values) -> str:
    lag = 1e3 * of["period_s"] * of["value"] / (1.0 - of["value"])
    return _commands_lost(
        of,
        ". The last one is held, for no signal shows whether the base got them: if it did, a lag of the "
        f"drive is up to {lag:.0f} ms longer than found",
    )


_RECORDING: Mapping[str, Template | Mapping[str, Template]] = {
    "controller_multiplier": _controller_multiplier,
    "wheels_scaled": _wheels_scaled,
    "command_scale": {
        "of the wheels": _command_scaled,
        "not followed": _command_not_scaled,
        "without a unit": "the numbers of {source} have no sure unit: as they are read, they are multiplied "
        "by {value:.3g} ahead and {turn:.3g} in turning, with which the body moves as far as they say; gains "
        "of the drive and the ground are not known from them",
    },
    "wheelbase_contradicted": "[vehicle] in run.toml gives wheelbase_m = {given:g}, but by commands and "
    "poses the vehicle turns as one with a wheelbase of {value:.3g} m ({low:.3g} to {high:.3g} m): check the "
    "line, and the unit of the steering angle",
    "late_as_configured": "the motion follows {source} {value:.2f} s after its stamps, and {given} under "
    "[command] in run.toml moves them by as much: without that line there is hardly a delay. Take it out, "
    "unless the stamps are known to be late",
    "lengths_by_tape": _by_tape,
    "tape_contradicts_vehicle": _tape_contradicts,
    "no_length_by_tape": {
        "both ways": _taped_both_ways,
        "no vehicle": _taped_no_vehicle,
        "no radius": "the counted turns show no track: the wheel radius is not known (--wheel-radius gives "
        "it, or --drove with the distance of a straight drive in the same log)",
    },
    "poses_left_out": "{all} topics or frames hold poses: the {compared} with most messages were compared",
    "vehicle_choice": {"description": _preset_differs, "parameters": _controller_differs},
    "no_command": "the log contains no commands: it is analyzed from wheel encoders",
    "wheels_left_out": {
        "radius contradicted": _radius_contradicted,
        "no sides": "not used: {wheels}: no speeds of both sides are found in it (left and right under "
        "[wheels] name the joints)",
        "radius unknown": "not used: {wheels}: the vehicle is not known, and its motion does not show the "
        "radius of its wheels (--vehicle, or --wheel-radius and --track-width, give it)",
        "sides not found": "not used: {wheels}: no speeds of both sides are found in it; {taken} is taken "
        "for the wheels",
        "not followed": "not used: {wheels}: the motion does not follow it; {taken} is taken for the wheels",
    },
    "vehicle_fitted": {
        "wheels alone": _wheels_alone,
        "body alone": _body_alone,
        "lengths": _lengths_of_vehicle,
    },
    "no_readable_text": _no_readable_text,
    "vehicle_contradiction": _vehicle_contradiction,
    "vehicle_by_motion": _vehicle_by_motion,
    "numbers_not_used": "not used: {what}",
    "odometry_contradicts_itself": {"pose": _contradicts_itself, "speeds": _contradicts_itself},
    "pose_contradicts_itself": "the pose of {source} is wrong, and nothing else shows the motion: no other "
    "pose is recorded, nor wheels that follow the command",
    "pose_of_another": "{pose} is taken for the pose, and not {other}: what drives the vehicle explains the "
    "one better",
    "topic_left_out": "{where} is left out: {why}",
    "topic_without_messages": {
        "none": "{topic} is recorded without any message: by its name and type it may be the {where}, and "
        "the log has no other",
        "another": "{topic} is recorded without any message: by its name and type it may be the {where}, "
        "and {taken} is taken for it",
    },
    "ground_unobservable": "the log holds no pose: the motion of the wheels ({wheels}) stands in for it, so "
    "that the drivetrain (delays, gains and limits between commands and wheels) is diagnosed; what the "
    "ground does is not observable, and slip in these results is the difference between commanded and "
    "measured wheels",
    "sides_by_name": "{left} and {right}, of a type that is not known, are taken for the left and right "
    "wheels by their names ([wheels] in run.toml names others)",
    "vehicle_of_folder": {
        "several": "the end of the recording is lost, and it does not name its vehicle; recordings of its "
        "folder with the same topics name several ({vehicles:and}): none is taken",
        "one": _vehicle_of_folder,
    },
    "halves_contradict": _contradicted,
    "wheels_corrected": _corrected,
    "imu_corrected": _corrected,
    "pose_turned": _corrected,
    "command_corrected": {
        "corrected": _corrected,
        "steering angles": "{source} holds steering angles in place of yaw rates: the vehicle turns by the "
        'speed times their tangent: read so, as speed_topic = "{speed}" and steering_topic = "{turn}" under '
        "[command] in run.toml do",
    },
    "configured_wrongly": _configured_wrongly,
    "signs_contradict": {
        "configured": _configured,
        "command and wheels": _command_against_wheels,
        "signal and poses": _signal_against_poses,
    },
    "wheels_reversed": _signal_reversed,
    "command_reversed": _signal_reversed,
    "unit_undecided": _unit_undecided,
    "command_mixed": {"left out": _mixed_left_out, "replaced": _mixed_replaced},
    "commands_mixed": partial(_mixed, done=""),
    "track_taken": _track_taken,
    "tracks_mixed": {
        "both": partial(_tracks, rest=f"both of which follow what drives the vehicle: {_NO_TRACK}"),
        "neither": partial(_tracks, rest=f"neither of which follows what drives the vehicle: {_NO_TRACK}"),
    },
    "motor_reversed": _motor_reversed,
    "wheel_dead": _wheel_dead,
    "encoder_dead": _encoder_dead,
    "pose_undecided": {
        "heading": "the body does not follow what drives it along the headings of {source}, and a little "
        "across them: their frame may be turned by 90 degrees, which too little tells; it is taken as "
        "recorded (heading_deg = {value:.0f} under [pose] in run.toml turns it, heading_deg = 0 settles it)",
        "axis": "the body turns most about the {axis} axis of {source}, but no other signal follows that "
        'clearly: z is taken to point up, as usual (up = "{axis}", or "-{axis}", under [pose] in run.toml '
        'takes another axis, up = "z" settles it)',
    },
    "kept_as_recorded": partial(_configured, taken=", and it is taken as it is recorded"),
    "pose_flipped": "the headings of {source} turn against its own path: its frame is of the other hand; "
    "correct what publishes it",
    "command_of_map": "the commands of {source} are along the axes of a map, and the base turns them by its "
    "heading (field-centric driving): record them as they are along the body's own axes",
    "no_yaw_rate": "{source} says a speed, and a yaw rate of zero throughout, though the vehicle turns: its "
    "errors of heading, and what they make of positions, say nothing (yaw_rate_topic and speed_topic in "
    "run.toml name two topics, as of a gyro)",
    "pose_angle": _pose_angle,
    "pose_lever": _pose_lever,
    "command_timeout": _command_timeout,
    "commands_in_bursts": _commands_in_bursts,
    "command_delay": _command_delay,
    "command_late": _command_late,
    "speeds_of_positions": "its speeds are differences of its positions, and scatter as the times between "
    "its messages do: they are taken over two of its readings",
    "wheels_unsigned": "not used: {wheels}: its speeds have no sign: they are never below zero, though the "
    "body is driven forward and backward",
    "not_driven": {
        "log damaged": "a part of the log is lost, and what is left does not show that the poses of {pose} "
        "move as {command} commands ([command] topic in run.toml takes it all the same)",
        "another body": "the poses of {pose} move {value:.3g} m, but not as {command} commands: they are of "
        "another body, or something else drives it ([pose] and [command] in run.toml name others)",
    },
    "role_by_motion": "{command} is taken for the command, and not {other}: the motion follows the first "
    "later, and the second measures it or is not followed; [command] in run.toml names another",
    "wheels_steered": "not used: {wheels}: {joints:and} steer, so this is not a differential drive, and it "
    "does not turn as a car that steers by the middle of them (several axles steer, or each wheel by "
    'itself); steering_joint and left and right under [wheels] and [vehicle] kind = "ackermann" in '
    "run.toml take it for a car",
    "commands_lost": {
        "told": _commands_lost,
        "interpolated": partial(
            _commands_lost,
            rest=", but the base got them: those missing are taken to be between the ones around them, as "
            "interpolate = true under [command] in run.toml does",
        ),
        "held": partial(
            _commands_lost,
            rest=", and the base did not get them: it follows the last one that is recorded",
        ),
        "undecided": _commands_undecided,
    },
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
    "file_not_read": "{why}",
    "repeated_messages": {
        "removed": "{count} messages of {where} are byte-for-byte copies of others: duplicates were removed",
        "ignored": "{count} messages of {where} are byte-for-byte copies of others: duplicates are ignored",
    },
}

TEMPLATES: Mapping[str, Template | Mapping[str, Template]] = {
    **_STAGES,
    **_RECORDING,
    **_DIAGNOSIS,
}
"""The sentences by the id of the finding; where an id has several, by its value ``kind``."""
