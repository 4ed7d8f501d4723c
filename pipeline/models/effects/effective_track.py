"""Effective track: a skid-steered vehicle turns less than its track width predicts.

    w0 = w0 / k    (b_eff = k b)

k is a plain number: 1 without skidding, about 1.9 on a Husky, 1.8 on a Warthog. On mecanum wheels it scales
the sum of track width and wheelbase, on omni wheels the diameter of their circle. Turn both ways.

Source: Mandow et al., IROS 2007; Baril et al., CRV 2020.
"""

import math
from collections.abc import Iterable

from pipeline.core import enumerate_texts, format_share
from pipeline.models.effect import (
    SIDES,
    Effect,
    Excitation,
    KinematicEffect,
    Least,
    Parameter,
    Plausible,
    Spread,
)
from pipeline.models.effects.wheel_radius import WheelRadius
from pipeline.models.parameter import Level, Quantity, Reading
from pipeline.run.signals import Rolling, RunContext
from pipeline.sources import Vehicle

_BESIDE = {
    "wheel_radius": "the effective wheel radius",
    "drive_gain": "the drive gain",
    "difference_gain": "the difference gain",
}
"""Effects of one factor that change how fast the robot turns as well."""


class EffectiveTrack(KinematicEffect):
    """Effective track: a skid-steered vehicle turns less than its track width predicts."""

    id = "effective_track"
    rank = 20
    kinds = SIDES
    parameters = (
        Parameter(
            "k",
            "1",
            (0.2, 10.0),
            1.0,
            "effective over nominal track",
            1.8,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(0.7, 4.0, "wider than the 1.8 and 1.9 of Warthog and Husky"),
            quantities=(Quantity.TRACK,),
            between_runs=Spread(0.023),
        ),
    )
    needs = (Excitation.TURNING,)
    confused_with = ("wheel_radius", "terrain_change")
    python = "w0 = w0 / {k}"
    readings = (
        Reading(Level.VEHICLE, "geometry", "a wrong track width"),
        Reading(Level.TERRAIN, "effective_track", "skidding"),
        Reading(Level.RUN, "effective_track", "a change of tyre pressure or load"),
    )

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        nominal, k = vehicle.track_width_m or 1.0, self.values["k"]
        others = {_BESIDE[one.id]: next(iter(one.values.values())) for one in beside if one.id in _BESIDE}
        names = enumerate_texts([name for name, value in others.items() if value != 1.0])
        reached = math.prod(others.values()) / k
        track = f"{k * nominal:.2f} m (nominal {nominal:.2f})"
        if "track_width_m" in vehicle.stand_ins:
            track = f"{k:.3g} times the controller's"
        return (
            f"Effective track {track}{names and f', with {names}'}: "
            f"the robot turns at {format_share(reached)} of the ideal rate"
        )

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        return rolling.scale(1.0, 1.0 / self.values["k"])

    def depends_on(self, other: Effect) -> bool:
        """The yaw rate determines only the ratio k_radius / k_track; the track assumes nominal wheels."""
        return isinstance(other, WheelRadius)
