"""Lengths of the vehicle by its controller and by the motion."""

from dataclasses import replace

import numpy as np

from pipeline.recording.case import Case, is_crossed
from pipeline.recording.evidence import RIMS
from pipeline.recording.geometry import (
    Geometry,
    Length,
    explain_followed,
    find_track_of_sides,
    list_errors,
    measure_car,
    measure_controller,
    measure_geometry,
    take_clear,
    take_shown,
)
from pipeline.sources import DriveForm


def ask_lengths(case: Case) -> Case:
    """Lengths that are not known yet; of a base that moves sideways by itself none matters."""
    if case.is_known or case.kind == "omni":
        return case
    made = _measure_lengths(case) if case.has_pose else _measure_driven(case)
    return replace(case, geometry=made)


def _measure_driven(case: Case) -> Geometry:
    """Lengths by which the controller turns commands into motion of the wheels, whatever their signs."""
    command, form = case.command, case.wheels.reading.form
    explained = command.reading.explained
    if not command.is_sure or form == "body" or command.reading.form == "sides":
        return Geometry()
    if form == "sides" and command.reading.form == "body" and not is_crossed(command):
        explained = explain_followed(command.reading, explained)
    fits = {"ahead": explained.ahead, "turned": explained.turned}
    gains = {name: abs(float(one.gains[0])) for name, one in fits.items()}
    errors = dict(zip(fits, list_errors(explained), strict=True))
    if is_crossed(command):
        # With one side reversed, the mean of the sides is half their difference, and the other way round.
        gains = {"ahead": 0.5 * gains["turned"], "turned": 2.0 * gains["ahead"]}
        errors = {"ahead": errors["turned"], "turned": errors["ahead"]}
    elif not command.sign("ahead"):
        return Geometry()
    radius, width = take_clear(case.wheel_factor() / gains["ahead"], errors["ahead"]), None
    if command.reading.form == "body" and radius is not None:
        share = float(np.hypot(errors["ahead"], errors["turned"]))
        width = take_shown(gains["turned"] / gains["ahead"], share, explained)
    if form == "steering":
        return Geometry(rolled=radius, wheelbase=width)
    return Geometry(radius=radius, track=width)


def _measure_lengths(case: Case) -> Geometry:
    """Lengths by the motion of the poses, and by what the wheels do of the command."""
    command, wheels = case.command, case.wheels
    car = next((one for one in (wheels, command) if one.reading.form == "steering"), None)
    if car is not None and car.sign("turned"):
        is_turned = car is wheels and car.source.form is DriveForm.JOINTS
        return measure_car(car.reading.explained, is_measured=is_turned)
    made = Geometry()
    sides = wheels if wheels.reading.form == "sides" else command
    if sides is wheels and command.reading.form == "body" and case.is_scaled and case.driven.is_known:
        driven = explain_followed(command.reading, case.driven)
        radius, track = measure_controller(driven)
        speed, rate = case.command_factors()
        apart = None if radius is None else find_track_of_sides(command.reading, driven)
        if track is not None and apart is not None:
            track = replace(track, value=apart)
        is_open = case.in_bursts or apart is not None
        radius = None if is_open else _scale(radius, speed * case.wheel_factor())
        made = Geometry(radius=radius, track=_scale(track, speed / rate))
    if sides.reading.form == "sides" and sides.is_sure and not is_crossed(sides):
        factor = case.wheel_factor("wheels" if sides is wheels else "command")
        rolled, effective = measure_geometry(sides.reading.explained, factor, made.radius)
        made = replace(made, rolled=rolled, effective=effective)
    is_command = sides is command and command.reading.form == "sides"
    changes = case.changes.get("command" if is_command else "wheels", {})
    return replace(made, is_taken="scale" in changes or changes.get("unit") in RIMS)


def _scale(length: Length | None, factor: float) -> Length | None:
    return None if length is None else Length(length.value * factor, length.error * factor)
