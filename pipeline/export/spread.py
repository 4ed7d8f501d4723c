"""What a robot does per command at several speeds: the multipliers that a controller would need at each.

The fitted model is driven by a constant command until its motion is steady.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.core import Flags, Floats
from pipeline.export import SPEED_LIMITS, STEADY_S, Facts
from pipeline.models import Effect, Place, predict_step
from pipeline.sources import Vehicle

_SPEEDS = 4
"""Number of speeds: quarters of the largest driven one show a factor that falls or rises with speed."""
_SAME = 0.01
"""Spread of a factor over the speeds that one value still fits: the tolerance of data sheets."""


def find_steady_motion(
    vehicle: Vehicle, effects: Sequence[Effect], speed: float, turn: float
) -> tuple[float, float]:
    """Speed [m/s] and yaw rate [rad/s] of a vehicle under a constant body command.

    Args:
        vehicle: geometry.
        effects: effects of the model; those of the localization are left out.
        speed: commanded speed [m/s].
        turn: commanded yaw rate [rad/s].
    """
    acting = [effect for effect in effects if effect.place is not Place.LOCALIZATION]
    moved = predict_step(vehicle, acting, speed, turn, STEADY_S)
    return float(moved.x[-1]), float(moved.w[-1])


class Response(NamedTuple):
    """Factors of a model: its steady motion over the command, at quarters of the largest driven speed.

    Attributes:
        speeds: commanded speeds [m/s], shape (n,).
        linear: speed over its command when driving straight, shape (n,).
        angular: yaw rate over its command at these speeds, shape (n,).
        turn: the commanded yaw rate [rad/s].
        is_clipped: whether a limit changes the motion at these speeds: it is no multiplier there, shape (n,).
    """

    speeds: Floats
    linear: Floats
    angular: Floats
    turn: float
    is_clipped: Flags

    @property
    def separation(self) -> Floats:
        """`wheel_separation_multiplier` at each speed, once the radii are corrected by `linear`.

        It is infinite where the vehicle does not turn.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio: Floats = self.linear / self.angular
        return ratio


def find_response(facts: Facts) -> Response:
    """Drive the model at several speeds, straight and in a turn at half of the largest driven yaw rate."""
    vehicle, effects = facts.vehicle, facts.file.model.effects
    top, turn = facts.find_driven()
    turn *= 0.5
    speeds = [float(f"{top * (n + 1) / _SPEEDS:.3g}") for n in range(_SPEEDS)]
    free = [
        one
        for one in effects
        if not SPEED_LIMITS.intersection(q for p in one.parameters for q in p.quantities)
    ]

    def drive(acting: Sequence[Effect]) -> tuple[Floats, Floats]:
        straight = [find_steady_motion(vehicle, acting, speed, 0.0)[0] for speed in speeds]
        curved = [find_steady_motion(vehicle, acting, speed, turn)[1] for speed in speeds]
        return np.array(straight) / speeds, np.array(curved) / turn

    linear, angular = drive(effects)
    unlimited = (linear, angular) if len(free) == len(effects) else drive(free)
    same = [
        np.isclose(own, other, rtol=_SAME, atol=0.0)
        for own, other in zip((linear, angular), unlimited, strict=True)
    ]
    return Response(np.array(speeds), linear, angular, turn, ~(same[0] & same[1]))


def describe_spread(facts: Facts) -> list[str]:
    """Multipliers per speed as lines of a comment, where one for all speeds does not fit; else empty."""
    response = find_response(facts)
    free = ~response.is_clipped
    own = facts.vehicle.controller_track_multiplier
    rows = {
        "wheel_separation_multiplier": own * response.separation,
        "wheel_radius_multiplier": response.linear,
    }
    lines = []
    for name, every in rows.items():
        values = every[free]
        if (
            values.size
            and np.isfinite(values).all()
            and float(np.ptp(values)) > _SAME * float(np.abs(values).mean())
        ):
            at = ", ".join(
                f"{value:.3f} at {speed:g} m/s"
                for value, speed in zip(values.tolist(), response.speeds[free].tolist(), strict=True)
            )
            lines.append(f"One {name} does not fit all speeds: {at}.")
    if lines:
        clipped = ", ".join(f"{speed:g} m/s" for speed in response.speeds[~free].tolist())
        lines += [f"Without {clipped}, where a limit clips the wheels in that turn."] if clipped else []
        at = f"at a yaw rate of {response.turn:.3g} rad/s"
        lines.append(
            f"These are of all effects together, {at}; each value below is of the effects beside it."
        )
    return lines
