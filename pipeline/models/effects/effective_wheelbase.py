"""Effective wheelbase: a car turns less, or more, than its wheelbase and steering angle predict.

    w0 = w0 / k    (l_eff = k l)

k is a plain number, off one by a few percent where the sheet has the wrong length, a rear axle steers along
or tyres give way. Steer to both sides at several angles.

Source: kinematic bicycle; Gillespie, Fundamentals of Vehicle Dynamics, low-speed turning.
"""

from collections.abc import Iterable

from pipeline.core import format_share
from pipeline.models.effect import (
    ACKERMANN,
    Effect,
    Excitation,
    KinematicEffect,
    Least,
    Parameter,
    Plausible,
)
from pipeline.models.parameter import Level, Quantity, Reading
from pipeline.run.signals import Rolling, RunContext
from pipeline.sources import Vehicle


class EffectiveWheelbase(KinematicEffect):
    """Effective wheelbase: a car turns less, or more, than its wheelbase and steering angle predict."""

    id = "effective_wheelbase"
    rank = 30
    kinds = ACKERMANN
    parameters = (
        Parameter(
            "k",
            "1",
            (0.2, 5.0),
            1.0,
            "effective over nominal wheelbase",
            1.1,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(
                0.5, 2.0, "wider than a wheelbase that is given wrongly, and than tyres give way"
            ),
            quantities=(Quantity.WHEELBASE,),
        ),
    )
    needs = (Excitation.STEERING,)
    confused_with = ("steering_gain", "understeer")
    python = "w0 = w0 / {k}"
    readings = (
        Reading(Level.VEHICLE, "geometry", "a wrong wheelbase"),
        Reading(Level.TERRAIN, "effective_wheelbase", "deforming tyres"),
        Reading(Level.RUN, "effective_wheelbase", "a change of tyre pressure or load"),
    )

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        nominal, k = vehicle.wheelbase_m or 1.0, self.values["k"]
        return (
            f"Effective wheelbase {k * nominal:.3g} m (nominal {nominal:.3g}): "
            f"the robot turns at {format_share(1.0 / k)} of the ideal rate"
        )

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        return rolling.scale(1.0, 1.0 / self.values["k"])
