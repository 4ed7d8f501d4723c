"""Units of the signals by the motion, corrected or told."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.recording.case import TAKEN_M, Candidate, Case, is_crossed
from pipeline.recording.evidence import (
    RATES,
    RIMS,
    SPEEDS,
    USUAL,
    Units,
    find_body_units,
    find_car_units,
    find_pose_unit,
    find_steering_unit,
    find_wheel_unit,
    is_unit_exact,
)
from pipeline.recording.motion import Motion, measure_motion
from pipeline.recording.readings import Bent, Reading
from pipeline.sources import DriveForm, PoseContent, plain_type
from pipeline.stages import Finding

JOYSTICK = "sensor_msgs/Joy"
"""Type of axes, whose numbers from -1 to 1 have no unit."""
_NEAR = 0.03
"""Spread of the logarithm of a gyro's scale."""


def resolve_gyro(case: Case, motion: Motion) -> tuple[Motion, Reading | None]:
    """The motion and the gyro, if there is one, fitted to it; one in degrees per second is corrected."""
    gyro = case.read_gyro()
    made = None if gyro is None else gyro.explain(motion)
    if gyro is None or made is None or not made.sign("turned") or case.configuration.imu.unit is not None:
        return motion, gyro
    if abs(np.log(abs(float(made.turned.gains[0])) / RATES["deg/s"])) > 4.0 * _NEAR:
        return motion, gyro
    case.correct("imu", "gyro in degrees", {"gyro": gyro.name}, 'unit = "deg/s"', {"unit": "deg/s"})
    # Headings of positions alone are made of the gyro.
    case.extraction.take_degrees()
    motion, gyro = measure_motion(case.extraction.poses()) or motion, case.read_gyro()
    if gyro is not None:
        gyro.explain(motion)
    return motion, gyro


def resolve_lengths(
    case: Case,
    motion: Motion,
    readings: Sequence[Reading],
    command: Candidate | None,
    wheels: Candidate | None,
) -> Motion:
    """The motion in metres, and the readings fitted to it."""
    source = case.sources.pose
    if source is None or source.content is not PoseContent.POSE or case.configuration.pose.unit:
        return motion
    gains: dict[str, float | None] = {"body": None, "sides": None, "steering": None}
    for drive in (command, wheels):
        made = None if drive is None else drive.reading.explained
        if drive is not None and made is not None and drive.sign("ahead") and not is_crossed(drive):
            gains[drive.reading.form] = abs(float(made.ahead.gains[0]))
    radius = case.vehicle.wheel_radius_m if case.is_known else None
    unit = find_pose_unit(gains["body"] or gains["steering"], gains["sides"], radius)
    if unit == "m":
        return motion
    values = {"source": str(source), "unit": unit}
    case.correct("pose", "unit of positions", values, f'unit = "{unit}"', {"unit": unit})
    case.extraction.configuration = case.complete()
    scaled = measure_motion(case.extraction.poses())
    if scaled is None:
        return motion
    scaled = scaled.turn(flip=motion.flip, offset_deg=motion.offset_deg)
    for one in readings:
        one.explain(scaled)
    return scaled


def resolve_steering(case: Case, drive: Candidate, motion: Motion) -> None:
    """Read a steering angle in the unit in which the body turns by it; which one it is is told later."""
    reading = drive.reading
    section = case.find_section(drive.source, is_measured=drive.is_measured)
    is_free = drive.source.form is DriveForm.STEERING and section.steering_unit is None
    if not is_free or drive.source.signals[1].unit or not isinstance(reading.second, Bent):
        return
    tried = {"rad": reading, "deg": replace(reading, second=reading.second.rescale(np.pi / 180.0))}
    nats, lengths = {}, dict[str, float | None]()
    for unit, one in tried.items():
        made = one.explain(motion) if unit != "rad" else one.explained
        nats[unit] = 0.0 if made is None else float((made.turned.blocks - made.none[1]).sum())
        turns = made is not None and made.sign("turned") and made.sign("ahead")
        lengths[unit] = (
            abs(float(made.ahead.gains[0] / made.turned.gains[0])) if made is not None and turns else None
        )
    known = case.vehicle.wheelbase_m if case.is_known else None
    drive.steering = find_steering_unit(nats, lengths, known, str(drive.source))
    if drive.steering.likeliest[1] == "deg":
        reading.second, reading.explained = tried["deg"].second, tried["deg"].explained


def find_units(case: Case, command: Candidate | None, wheels: Candidate | None) -> None:
    """Correct the units of the command and of the wheels, or tell two that are as likely."""
    for role, one in (("command", command), ("wheels", wheels)):
        if one is not None and one.reading.form == "steering":
            _report_units(case, role, one, one.steering)
    is_car = all(one is not None and one.source.form is DriveForm.STEERING for one in (command, wheels))
    if is_car and command is not None and wheels is not None and _is_usable(command) and _is_usable(wheels):
        _find_speed_units(case, command, wheels)
    elif command is not None and command.reading.form != "sides" and _is_usable(command):
        explained = command.reading.explained
        if explained is None:
            return
        # A car turns by its wheelbase, and not by a unit.
        turns = command.reading.form == "body" and command.sign("turned")
        gains = [
            abs(float(one.gains[0])) if is_seen else None
            for is_seen, one in ((command.sign("ahead"), explained.ahead), (turns, explained.turned))
        ]
        beside = None if wheels is None or not wheels.is_sure else wheels.reading.explained
        if wheels is not None and beside is not None and wheels.reading.form == "body":
            # What wheels do of a command is its unit on any ground.
            fits = (("ahead", beside.ahead), ("turned", beside.turned))
            gains = [
                gain / abs(float(one.gains[0])) if gain and wheels.sign(axis) else gain  # type: ignore[arg-type]
                for gain, (axis, one) in zip(gains, fits, strict=True)
            ]
        columns = case.extraction.columns.get(command.source.signals[0].topic)
        if columns is not None and plain_type(columns.type_name) == JOYSTICK:
            case.is_scaled = False
            return
        units = find_body_units(gains, explained.shares, str(command.source))
        _report_units(case, "command", command, units, gains)
    if wheels is not None and wheels.reading.form == "sides" and not is_crossed(wheels):
        _find_wheel_unit(case, command, wheels)
    if command is not None and command.reading.form == "sides" and _is_usable(command):
        _find_side_unit(case, command, wheels)


_ALIKE = 1.5
"""Speeds of wheels over those commanded up to which both are in one unit: others are nine times apart."""


def _find_side_unit(case: Case, command: Candidate, wheels: Candidate | None) -> None:
    """Unit of commanded wheel speeds: that of the wheels that follow them, else by the motion."""
    driven, unit = case.driven, case.changes.get("wheels", {}).get("unit")
    if wheels is not None and wheels.reading.form == "sides" and driven is not None:
        if unit is not None and abs(np.log(abs(float(driven.ahead.gains[0])))) < np.log(_ALIKE):
            values = {"source": str(command.source), "unit": unit}
            line = f'unit = "{unit}"'
            case.correct("command", "unit as measured", values, line, {"unit": unit}, usual="rad/s")
    elif wheels is None and command.reading.explained is not None and command.sign("ahead"):
        explained = command.reading.explained
        radius = case.vehicle.wheel_radius_m if case.is_known else None
        gain = float(explained.ahead.gains[0])
        correct_wheel_unit(case, command, gain, explained.shares[0], radius, "command")


def _find_speed_units(case: Case, command: Candidate, wheels: Candidate) -> None:
    """Correct or tell the units of a car's speeds: commanded, measured, and by the poses."""
    gains: list[float | None] = []
    shares, options = [], []
    for role, one in (("command", command), ("wheels", wheels)):
        made = one.reading.explained
        seen = made is not None and one.sign("ahead")
        gains.append(abs(float(made.ahead.gains[0])) if made is not None and seen else None)
        shares.append(0.0 if made is None else made.shares[0])
        is_given = getattr(case.configuration, role).unit is not None or one.source.signals[0].unit
        options.append(USUAL[:1] if is_given else (*SPEEDS,))
    names = (str(command.source), str(wheels.source))
    units = find_car_units(gains, shares, names, (options[0], options[1]))
    for index, (role, one) in enumerate((("command", command), ("wheels", wheels))):
        rival = None if units.rival is None else (units.rival[index], "")
        _report_units(case, role, one, Units((units.likeliest[index], ""), rival), (gains[index],))


_FASTEST = 1.3
"""Most that a body moves of what is commanded: wheels slip, and their radii are off by a quarter. More is a
scale, as of commands from -1 to 1."""


def _report_units(
    case: Case, role: str, drive: Candidate, units: Units, gains: Sequence[float | None] = (None, None)
) -> None:
    """Correct units of a drive, or tell two readings that are as likely."""
    section = getattr(case.configuration, role)
    turn_key, turn = (
        ("steering_unit", "steering angle") if drive.steering is units else ("yaw_unit", "yaw rate")
    )
    for index, (key, what) in enumerate((("unit", "speed"), (turn_key, turn))):
        unit = units.likeliest[index]
        of: dict[str, object] = {"what": what, "source": str(drive.source), "unit": unit}
        if getattr(section, key) is not None or not unit:
            continue
        is_too_fast = key == "unit" and drive.reading.form == "body" and (gains[0] or 0.0) > _FASTEST
        if unit in USUAL and is_too_fast and not (case.is_known and case.driven):
            case.is_scaled = False
        if unit not in USUAL:
            speed, gain = units.likeliest[0], gains[0]
            is_sure = speed in USUAL or gain is None or is_unit_exact(gain, speed)
            case.is_scaled = case.is_scaled and is_sure
            values = {**of, "is_sure": bool(is_sure)}
            case.correct(role, "unit of a drive", values, f'{key} = "{unit}"', {key: unit}, usual="m/s")
        elif units.rival is not None and units.rival[index] != unit:
            other, gain = units.rival[index], gains[index]
            values = {**of, "other": other, "key": key}
            if gain is not None:
                values["value"] = float(gain)
            case.findings.append(Finding("unit_undecided", "warning", role, values))


def _find_wheel_unit(case: Case, command: Candidate | None, wheels: Candidate) -> None:
    """Unit of wheel speeds by the controller of a known vehicle, else by the motion."""
    explained, share = wheels.reading.explained, 1.0
    radius, driven = case.vehicle.wheel_radius_m if case.is_known else None, case.driven
    if driven is not None and radius is not None and command is not None and driven.sign("ahead") > 0:
        # Wheels follow a command closely on any ground.
        of_command = radius if command.reading.form == "sides" else case.command_factors()[0]
        gain = of_command / float(driven.ahead.gains[0])
    elif explained is not None and wheels.is_sure and wheels.sign("ahead"):
        gain, share = float(explained.ahead.gains[0]), explained.shares[0]
    else:
        return
    correct_wheel_unit(case, wheels, gain, share, radius)


def correct_wheel_unit(
    case: Case,
    wheels: Candidate,
    gain: float,
    share: float,
    radius: float | None = None,
    role: str = "wheels",
) -> None:
    """Correct the unit of wheel speeds, unless the type or the user gives it; see `find_wheel_unit`."""
    if wheels.source.signals[0].unit or getattr(case.configuration, role).unit is not None:
        return
    unit = find_wheel_unit(gain, share, str(wheels.source), radius)
    values: dict[str, object] = {"source": str(wheels.source), "unit": unit}
    if radius is None and (not unit or unit in RIMS):
        values["taken_m"] = TAKEN_M
    if not unit:
        scale = float(f"{gain / TAKEN_M:.4g}")
        case.correct(role, "unit of wheels", values, f"scale = {scale:g}", {"scale": scale})
    elif unit != "rad/s":
        case.correct(role, "unit of wheels", values, f'unit = "{unit}"', {"unit": unit}, usual="rad/s")


def _is_usable(drive: Candidate) -> bool:
    return drive.is_sure and not is_crossed(drive)
