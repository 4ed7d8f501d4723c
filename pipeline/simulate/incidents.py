"""Incidents of a simulated drive: signals that drop, repeat or stop, and a body that is stuck or pushed."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.core import Flags, Floats
from pipeline.simulate.facts import Vehicle
from pipeline.simulate.path import BodyMotion
from pipeline.simulate.scenario import Incident, IncidentKind
from pipeline.simulate.sensors import Poses
from pipeline.simulate.signals import Commands, Drive


def _mark(incidents: Sequence[Incident], kinds: Sequence[IncidentKind], times: Floats) -> Flags:
    marked = np.zeros(times.size, dtype=bool)
    for incident in incidents:
        if incident.kind in kinds:
            marked |= incident.contains(times)
    return marked


def send_commands(commands: Commands, incidents: Sequence[Incident]) -> Commands:
    """The commands that the drive hears."""
    return _drop(
        _silence(commands, _mark(incidents, ("pushed",), commands.time_s)),
        _mark(incidents, ("commands_silent",), commands.time_s),
    )


def record_commands(commands: Commands, incidents: Sequence[Incident]) -> Commands:
    """Of the commands that the drive heard, those that the command topic holds."""
    return _silence(commands, _mark(incidents, ("manual_driving",), commands.time_s))


def _silence(commands: Commands, zero: Flags) -> Commands:
    sideways = None if commands.sideways_mps is None else commands.sideways_mps * ~zero
    speed, turn = commands.speed_mps * ~zero, commands.turn * ~zero
    return replace(commands, speed_mps=speed, turn=turn, sideways_mps=sideways)


def _drop(commands: Commands, gone: Flags) -> Commands:
    sideways = None if commands.sideways_mps is None else commands.sideways_mps[~gone]
    time, speed, turn = commands.time_s[~gone], commands.speed_mps[~gone], commands.turn[~gone]
    return replace(commands, time_s=time, speed_mps=speed, turn=turn, sideways_mps=sideways)


def _find_middles(cell_count: int, step_s: float) -> Floats:
    return np.asarray((np.arange(cell_count) + 0.5) * step_s, dtype=np.float64)


def brake_wheels(drive: Drive, incidents: Sequence[Incident]) -> Drive:
    """The drive under emergency stops."""
    times = _find_middles(drive.left.size, drive.step_s)
    share = np.ones(times.size)
    for incident in incidents:
        if incident.kind in {"emergency_stop", "sliding"}:
            ends = [
                incident.start_s,
                incident.start_s + _STOPS_IN_S,
                incident.end_s,
                incident.end_s + _STARTS_IN_S,
            ]
            share *= np.interp(times, ends, [1.0, 0.0, 0.0, 1.0])
    corners = drive.corners
    if corners is not None:
        corners = {corner: wheel * share for corner, wheel in corners.items()}
    return replace(drive, left=drive.left * share, right=drive.right * share, corners=corners)


def disturb_body(
    motion: BodyMotion, incidents: Sequence[Incident], vehicle: Vehicle, step_s: float
) -> BodyMotion:
    """The body's motion where it is stuck or pushed."""
    times = _find_middles(motion.v0.size, step_s)
    velocity = motion.velocity * ~_mark(incidents, ("stuck",), times)[:, None]
    for incident in incidents:
        inside = incident.contains(times)
        if not inside.any():
            continue
        passed = (times[inside] - incident.start_s) / (incident.end_s - incident.start_s)
        if incident.kind == "digging_in":
            velocity[inside] *= np.maximum(1.0 - 2.0 * passed, 0.0)[:, None]
        elif incident.kind == "spinning":
            velocity[inside] *= _SPIN_SHARE
        elif incident.kind == "sliding":
            velocity[inside] = velocity[max(int(np.argmax(inside)) - 1, 0)] * (1.0 - passed)[:, None]
    pushed = _mark(incidents, ("pushed",), times)
    velocity[pushed, 0] += _PUSH_SHARE * min(vehicle.max_speed_mps, 1.0)
    return replace(motion, velocity=velocity)


def freeze_poses(poses: Poses, incidents: Sequence[Incident]) -> Poses:
    """The poses of a localization that repeats the last one."""
    rows = np.arange(poses.stamp_s.size)
    for incident in incidents:
        if incident.kind == "localization_frozen":
            inside = incident.contains(poses.sampled_s)
            rows[inside] = max(int(np.searchsorted(poses.sampled_s, incident.start_s)) - 1, 0)
    return replace(poses, position=poses.position[rows], quaternion=poses.quaternion[rows])


_STOPS_IN_S = 0.15


_STARTS_IN_S = 0.2


_PUSH_SHARE = 0.5
"""Of the vehicle's largest speed, at which it is pushed."""


_SPIN_SHARE = 0.25
"""Of the wheels' motion, that spinning ones bring."""
