"""Geometry out of the frames of wheels, where transforms place them and no robot description was recorded."""

import re
from typing import Final

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.logs import LogError, TransformBuffer

_NO_WHEEL: Final = re.compile(r"caster|castor|swivel|cam|lidar|imu")
_APART_M: Final = 0.02


def read_frames(buffer: TransformBuffer) -> tuple[str, dict[str, float]]:
    """Kind of the vehicle and what the places of its wheels say: keys of `Vehicle`, none where it is nothing.

    Track width and wheelbase are between the middles of frames that are called wheels; the radius is their
    height over base_footprint.

    Args:
        buffer: the transforms.
    """
    names = [name for name in buffer.frames() if not _NO_WHEEL.search(name.lower())]
    base = next((name for name in names if name.rsplit("/", 1)[-1] == "base_link"), "")
    ground = next((name for name in names if name.rsplit("/", 1)[-1] == "base_footprint"), "")
    base = base or ground
    steering = _place(buffer, base, [name for name in names if "steer" in name.lower()])
    wheels = _place(buffer, base, [name for name in names if "wheel" in name.lower()])
    wheels = [place for place in wheels if abs(place[1]) > _APART_M]
    sides = [[place for place in wheels if sign * place[1] > 0.0] for sign in (1.0, -1.0)]
    if not all(sides):
        return "differential", {}
    rear = min(place[0] for place in wheels)
    found: dict[str, float] = {}
    if steering:
        front = float(np.mean([place[0] for place in steering]))
        found = {"wheelbase_m": front - rear, "base_to_rear_axle_m": -rear} if front - rear > _APART_M else {}
    found["track_width_m"] = float(np.mean([p[1] for p in sides[0]]) - np.mean([p[1] for p in sides[1]]))
    heights = _place(buffer, ground, [name for name in names if "wheel" in name.lower()]) if ground else []
    radii = [place[2] for place in heights if place[2] > 0.0]
    if radii:
        found["wheel_radius_m"] = float(np.median(radii))
    return ("ackermann" if "wheelbase_m" in found else "differential"), found


def _place(buffer: TransformBuffer, base: str, frames: list[str]) -> list[Floats]:
    """Places of frames in a base [m]; those that no transform places are left out.

    A wheel that turns stays where it is.
    """
    found = []
    for frame in frames:
        try:
            position = buffer.lookup_series(base, frame).position
        except LogError:
            continue
        if position.shape[0]:
            found.append(np.median(position, axis=0))
    return found
