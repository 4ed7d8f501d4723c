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
    name_wheel_units,
)
from pipeline.recording.findings import Finding
from pipeline.recording.motion import measure_motion
from pipeline.recording.readings import Bent, Reading
from pipeline.sources import DriveForm, PoseContent, plain_type

JOYSTICK = "sensor_msgs/Joy"
"""Type of axes, whose numbers from -1 to 1 have no unit."""
_NEAR = 0.03
"""Spread of the logarithm of a gyro's scale."""


def ask_gyro(case: Case) -> Case:
    """The gyro fitted to the motion; one in degrees per second is corrected."""
    if not case.has_pose:
        # It measures the ground, of which wheels know nothing.
        return case
    gyro = case.read_gyro().fitted(case.motion)
    case, made = replace(case, gyro=gyro), gyro.explained
    if not made.sign("turned") or case.configuration.imu.unit not in {None, *USUAL}:
        return case
    if abs(np.log(abs(float(made.turned.gains[0])) / RATES["deg/s"])) > 4.0 * _NEAR:
        return case
    line, about, halves = 'unit = "deg/s"', {"gyro": gyro.name}, gyro.fit_halves("turned")
    if not case.correct("imu", "gyro in degrees", about, line, {"unit": "deg/s"}, halves=halves):
        return case
    # Headings of positions alone are made of the gyro.
    case = replace(case, extraction=case.extraction.configure(imu=case.complete().imu))
    again = measure_motion(case.extraction.poses())
    return replace(case, gyro=case.read_gyro()).fit(again if again.is_known else case.motion)


def ask_metres(case: Case) -> Case:
    """The unit of the positions."""
    source, motion = case.sources.pose, case.motion
    is_open = case.configuration.pose.unit in {None, "m"}
    if source is None or source.content is not PoseContent.POSE or not is_open:
        return case
    drives = {
        drive.reading.form: drive.reading
        for drive in (case.command, case.wheels)
        if drive.sign("ahead") and not is_crossed(drive)
    }
    gains = {form: abs(float(one.explained.ahead.gains[0])) for form, one in drives.items()}
    radius = case.vehicle.wheel_radius_m if case.is_known else None
    unit = find_pose_unit(gains.get("body") or gains.get("steering"), gains.get("sides"), radius)
    if unit == "m":
        return case
    values, line = {"source": str(source), "unit": unit}, f'unit = "{unit}"'
    halves = next(iter(drives.values())).fit_halves("ahead")
    if not case.correct("pose", "unit of positions", values, line, {"unit": unit}, halves=halves):
        return case
    case = replace(case, extraction=case.extraction.configure(pose=case.complete().pose))
    scaled = measure_motion(case.extraction.poses())
    return case.fit(scaled.turn(flip=motion.flip, offset_deg=motion.offset_deg)) if scaled.is_known else case


def resolve_steering(case: Case, drive: Candidate) -> Candidate:
    """Read a steering angle in the unit in which the body turns by it; which one it is is told later."""
    reading = drive.reading
    section = case.find_section(drive.source, is_measured=drive.is_measured)
    is_free = drive.source.form is DriveForm.STEERING and section.steering_unit in {None, *USUAL}
    if not is_free or drive.source.signals[1].unit or not isinstance(reading.second, Bent):
        return drive
    degrees = replace(reading, second=reading.second.rescale(np.pi / 180.0)).fitted(case.motion)
    tried = {"rad": reading, "deg": degrees}
    nats, lengths = {}, dict[str, float | None]()
    for unit, one in tried.items():
        made = one.explained
        nats[unit] = float((made.turned.blocks - made.none[1]).sum())
        # A speed that is the same throughout is taken as it is commanded.
        gain = made.ahead.gains[0] if made.sign("ahead") else 1.0
        lengths[unit] = abs(float(gain / made.turned.gains[0])) if made.sign("turned") else None
    known = case.vehicle.wheelbase_m if case.is_known else None
    steering = find_steering_unit(nats, lengths, known, str(drive.source))
    return replace(drive, steering=steering, reading=tried[steering.likeliest[1]])


def ask_units(case: Case) -> Case:
    """Units of the command and of the wheels, corrected, or two told that are as likely."""
    if not case.has_pose:
        _find_driven_unit(case)
        return case
    command, wheels = case.command, case.wheels
    is_scaled = [
        _report_units(case, role, one, one.steering)
        for role, one in (("command", command), ("wheels", wheels))
        if one.reading.form == "steering"
    ]
    is_car = all(one.source.form is DriveForm.STEERING for one in (command, wheels))
    if is_car and _is_usable(command) and _is_usable(wheels):
        is_scaled += _find_speed_units(case)
    elif command.reading.form != "sides" and _is_usable(command):
        columns = case.extraction.columns.get(command.source.signals[0].topic)
        if columns is not None and plain_type(columns.type_name) == JOYSTICK:
            return replace(case, is_scaled=False)
        is_scaled.append(_find_body_units(case))
    if wheels.reading.form == "sides" and not is_crossed(wheels):
        _find_wheel_unit(case)
    if command.reading.form == "sides" and _is_usable(command):
        _find_side_unit(case)
    return replace(case, is_scaled=all(is_scaled))


def _find_driven_unit(case: Case) -> None:
    """Unit of wheels that stand in for a pose, by the radius that the command and each would mean."""
    command, wheels = case.command, case.wheels
    explained = command.reading.explained
    is_open = wheels.reading.form == "sides" and not case.is_known and command.reading.form != "sides"
    if is_open and command.sign("ahead"):
        gain = 1.0 / abs(float(explained.ahead.gains[0]))
        _correct_wheel_unit(case, wheels, command.reading, gain, explained.shares[0])


def _find_body_units(case: Case) -> bool:
    """Units of a command of the body, or of a car; whether it has any."""
    command, wheels = case.command, case.wheels
    explained = command.reading.explained
    # A car turns by its wheelbase, and not by a unit.
    turns = command.reading.form == "body" and command.sign("turned")
    gains = [
        abs(float(one.gains[0])) if is_seen else None
        for is_seen, one in ((command.sign("ahead"), explained.ahead), (turns, explained.turned))
    ]
    beside = wheels.reading.explained
    if wheels.is_sure and wheels.reading.form == "body":
        # What wheels do of a command is its unit on any ground.
        fits = (("ahead", beside.ahead), ("turned", beside.turned))
        gains = [
            gain / abs(float(one.gains[0])) if gain and wheels.sign(axis) else gain  # type: ignore[arg-type]
            for gain, (axis, one) in zip(gains, fits, strict=True)
        ]
    units = find_body_units(gains, explained.shares, str(command.source))
    return _report_units(case, "command", command, units, gains)


_ALIKE = 1.5
"""Speeds of wheels over those commanded up to which both are in one unit: others are nine times apart."""


def _find_side_unit(case: Case) -> None:
    """Unit of commanded wheel speeds: that of the wheels that follow them, else by the motion."""
    command, wheels = case.command, case.wheels
    driven, unit = case.driven, case.changes.get("wheels", {}).get("unit")
    if wheels.reading.form == "sides" and driven.is_known:
        if unit is not None and abs(np.log(abs(float(driven.ahead.gains[0])))) < np.log(_ALIKE):
            values = {"source": str(command.source), "unit": unit}
            line = f'unit = "{unit}"'
            case.correct("command", "unit as measured", values, line, {"unit": unit}, usual="rad/s")
    elif not wheels.is_there and command.sign("ahead"):
        explained = command.reading.explained
        radius = case.vehicle.wheel_radius_m if case.is_known else None
        gain = float(explained.ahead.gains[0])
        turn = float(explained.turned.gains[0]) if command.sign("turned") else None
        share = explained.shares[0]
        _correct_wheel_unit(case, command, command.reading, gain, share, radius, turn, "command")


def _find_speed_units(case: Case) -> list[bool]:
    """Correct or tell the units of a car's speeds, commanded and measured; whether each has any."""
    command, wheels = case.command, case.wheels
    gains: list[float | None] = []
    shares, options = [], []
    for role, one in (("command", command), ("wheels", wheels)):
        made = one.reading.explained
        gains.append(abs(float(made.ahead.gains[0])) if one.sign("ahead") else None)
        shares.append(made.shares[0])
        is_given = getattr(case.configuration, role).unit is not None or one.source.signals[0].unit
        options.append(USUAL[:1] if is_given else (*SPEEDS,))
    names = (str(command.source), str(wheels.source))
    units = find_car_units(gains, shares, names, (options[0], options[1]))
    is_scaled = []
    for index, (role, one) in enumerate((("command", command), ("wheels", wheels))):
        rival = None if units.rival is None else (units.rival[index], "")
        own = Units((units.likeliest[index], ""), rival)
        is_scaled.append(_report_units(case, role, one, own, (gains[index],)))
    return is_scaled


_FASTEST = 1.3
"""Most that a body moves of what is commanded: wheels slip, and their radii are off by a quarter. More is a
scale, as of commands from -1 to 1."""


def _report_units(
    case: Case, role: str, drive: Candidate, units: Units, gains: Sequence[float | None] = (None, None)
) -> bool:
    """Correct units of a drive, or tell two readings that are as likely; whether it has any unit."""
    section, is_scaled = getattr(case.configuration, role), True
    turn_key, turn = (
        ("steering_unit", "steering angle") if drive.steering is units else ("yaw_unit", "yaw rate")
    )
    for index, (key, what) in enumerate((("unit", "speed"), (turn_key, turn))):
        unit = units.likeliest[index]
        of: dict[str, object] = {"what": what, "source": str(drive.source), "unit": unit}
        given = getattr(section, key)
        # What the user says settles it; that a log is in another unit than the usual one is told.
        if not unit or (given is not None and (given not in USUAL or unit in USUAL)):
            continue
        is_too_fast = key == "unit" and drive.reading.form == "body" and (gains[0] or 0.0) > _FASTEST
        if unit in USUAL and is_too_fast and not (case.is_known and case.driven.is_known):
            is_scaled = False
        if unit not in USUAL:
            speed, gain = units.likeliest[0], gains[0]
            is_sure = speed in USUAL or gain is None or is_unit_exact(gain, speed)
            values = {**of, "is_sure": bool(is_sure)}
            line = f'{key} = "{unit}"'
            # An angle is read in the unit by which the body turns.
            axis = "" if key == "steering_unit" else ("ahead", "turned")[index]
            halves = drive.reading.fit_halves(axis) if axis else ()
            is_made = case.correct(
                role, "unit of a drive", values, line, {key: unit}, usual="m/s", halves=halves
            )
            is_scaled = is_scaled and (is_sure or not is_made)
        elif units.rival is not None and units.rival[index] != unit:
            other, gain = units.rival[index], gains[index]
            values = {**of, "other": other, "key": key}
            if gain is not None:
                values["value"] = float(gain)
            case.findings.append(Finding("unit_undecided", "warning", role, values))
    return is_scaled


def _find_wheel_unit(case: Case) -> None:
    """Unit of wheel speeds by the controller of a known vehicle, else by the motion."""
    command, wheels = case.command, case.wheels
    explained, share, turn = wheels.reading.explained, 1.0, None
    by = wheels.reading
    radius, driven = case.vehicle.wheel_radius_m if case.is_known else None, case.driven
    if radius is not None and driven.sign("ahead") > 0:
        # Wheels follow a command closely on any ground.
        of_command = radius if command.reading.form == "sides" else case.command_factors()[0]
        by, gain = replace(command.reading, explained=driven), of_command / float(driven.ahead.gains[0])
    elif wheels.sign("ahead"):
        gain, share = float(explained.ahead.gains[0]), explained.shares[0]
        turn = float(explained.turned.gains[0]) if wheels.sign("turned") else None
    else:
        return
    _correct_wheel_unit(case, wheels, by, gain, share, radius, turn)


def _correct_wheel_unit(
    case: Case,
    wheels: Candidate,
    by: Reading,
    gain: float,
    share: float,
    radius: float | None = None,
    turn: float | None = None,
    role: str = "wheels",
) -> None:
    """Correct the unit of wheel speeds, unless the type or the user gives it; see `find_wheel_unit`."""
    given = getattr(case.configuration, role).unit
    # Of an unknown vehicle a stated unit may mean any radius.
    is_settled = given is not None and (given != "rad/s" or radius is None)
    if wheels.source.signals[0].unit or is_settled:
        return
    unit = find_wheel_unit(gain, share, str(wheels.source), radius, turn)
    values: dict[str, object] = {"source": str(wheels.source), "unit": unit}
    if radius is None and unit not in {*RIMS, *name_wheel_units(str(wheels.source))}:
        values |= {"rolled_m": abs(gain), "times": TAKEN_M / abs(gain), "usual_m": TAKEN_M}
    if radius is None and (not unit or unit in RIMS):
        values["taken_m"] = TAKEN_M
    halves = by.fit_halves("ahead")
    if not unit:
        scale = float(f"{gain / TAKEN_M:.4g}")
        case.correct(role, "unit of wheels", values, f"scale = {scale:g}", {"scale": scale}, halves=halves)
    elif unit != "rad/s":
        line = f'unit = "{unit}"'
        case.correct(role, "unit of wheels", values, line, {"unit": unit}, usual="rad/s", halves=halves)


def _is_usable(drive: Candidate) -> bool:
    return drive.is_sure and not is_crossed(drive)
