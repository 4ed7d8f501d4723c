"""Physics of HiddenEffect that the catalogue of the simulator does not have.

Four of them have a name in the published list, with a size that is drawn; the others have none, and are
answered by a formula in words. Each is what a vehicle adds to its body velocity (v_x, v_y, v_w).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np  # noqa: TC002 - it runs as a script, too

sys.path.insert(0, str(Path(__file__).parents[1] / "hidden"))

from odd_physics import ODD, Push

from pipeline.simulate import Drive, Ground, State, Vehicle

_PLANE = Ground()
_STANDING_MPS = 0.1
_UNLISTED = ("grass_patch", "magnetic_floor", "turn_climb", "fast_left", "locked_axle", "crests")
NAMED = ("steady_wind", "slip_in_reverse", "one_sided_turn_loss", "wheel_out_of_round")


@dataclass(frozen=True)
class Outside:
    """One cause.

    Attributes:
        name: in the published list; empty for a cause that has none.
        about: what it does.
        channels: of the body velocity on which it acts: x, y, yaw.
        push: what it adds to the body velocity.
        parameters: of a named one.
        machinery: the same of the drivetrain.
        ground: on which it shows.
        tolerated: names that say the same in other words.
    """

    name: str
    about: str
    channels: tuple[str, ...]
    push: Push | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    machinery: Callable[[Drive], Drive] | None = None
    ground: Ground = _PLANE
    tolerated: tuple[str, ...] = ()


def draw_named(vehicle: Vehicle, draw: np.random.Generator) -> Outside:
    """One that the published list names, of a size that is drawn."""
    name = str(draw.choice(NAMED))
    size = float(draw.uniform(0.7, 1.2))
    if name == "steady_wind":
        wind = {
            "c": 0.1 * size * min(vehicle.max_speed_mps, 2.0),
            "a": float(draw.uniform(-math.pi, math.pi)),
        }
        return Outside(name, "", ("x", "y"), partial(_blow, **wind), wind)
    if name == "slip_in_reverse":
        return Outside(name, "", ("x",), partial(_slip_in_reverse, k=0.25 * size), {"k": 0.25 * size})
    if name == "one_sided_turn_loss":
        return Outside(name, "", ("yaw",), partial(_lose_right_turns, k=0.3 * size), {"k": 0.3 * size})
    uneven = {"a": 0.1 * size}
    return Outside(name, "", ("x", "yaw"), partial(_wobble, vehicle=vehicle, **uneven), uneven)


def draw_unlisted(vehicle: Vehicle, draw: np.random.Generator) -> Outside:
    """One that no list has."""
    name = str(draw.choice((*_UNLISTED, "hunting", "shifting_load")))
    if name == "hunting":
        push = partial(_hunt, size=0.12 * vehicle.max_turn_radps, hertz=float(draw.uniform(0.4, 0.8)))
        return Outside(
            "", "the yaw rate swings while the vehicle moves, at a rate of its own", ("yaw",), push
        )
    if name == "shifting_load":
        about = "a load slides ahead under braking and back under acceleration: the centre of rotation jumps"
        return Outside("", about, ("y",), make_shifting_load(0.15 * float(draw.uniform(0.8, 1.2))))
    odd = ODD[name]
    return Outside(
        "",
        odd.about,
        tuple({"w": "yaw"}.get(channel, channel) for channel in odd.channels),
        odd.make(vehicle) if odd.make else None,
        machinery=partial(odd.drive, vehicle) if odd.drive else None,
        ground=odd.ground,
        tolerated=odd.alike,
    )


def _blow(state: State, *, c: float, a: float) -> tuple[float, float, float]:
    moving = min(abs(state.v0) / _STANDING_MPS, 1.0)
    return c * math.cos(a - state.yaw) * moving, c * math.sin(a - state.yaw) * moving, 0.0


def _slip_in_reverse(state: State, *, k: float) -> tuple[float, float, float]:
    return min(state.v0, 0.0) * -k, 0.0, 0.0


def _lose_right_turns(state: State, *, k: float) -> tuple[float, float, float]:
    return 0.0, 0.0, min(state.w0, 0.0) * -k


def _wobble(state: State, *, vehicle: Vehicle, a: float) -> tuple[float, float, float]:
    more = a * math.sin(state.left_angle) * vehicle.wheel_radius_m * state.left_speed
    return 0.5 * more, 0.0, -more / vehicle.track_width_m


def _hunt(state: State, *, size: float, hertz: float) -> tuple[float, float, float]:
    moving = min(abs(state.v0) / _STANDING_MPS, 1.0)
    return 0.0, 0.0, size * moving * math.sin(math.tau * hertz * state.t)


def make_shifting_load(reach_m: float) -> Push:
    """A load that stands at +-reach ahead of base_link, by the last hard change of speed."""
    place, before = -reach_m, 0.0

    def push(state: State) -> tuple[float, float, float]:
        nonlocal place, before
        if state.t < state.dt:
            place, before = -reach_m, 0.0
        change = (abs(state.v0) - before) / state.dt
        before = abs(state.v0)
        if abs(change) > 0.3:
            place = -math.copysign(reach_m, change)
        return 0.0, -place * state.w0, 0.0

    return push
