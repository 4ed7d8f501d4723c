"""Wheel radius: all wheels are larger or smaller than nominal, or slip in proportion to their speed.

    v0 = k * v0,  w0 = k * w0

k is a plain number, off one by 2 to 25 %. Drive at several speeds, straight and turning.

Source: Borenstein and Feng, IEEE T-RA 1996 (UMBmark), the common scale error.
"""

from pipeline.models.effect import Excitation, KinematicEffect, Least, Parameter, Plausible, Spread
from pipeline.models.parameter import Level, Quantity, Reading
from pipeline.run.signals import Rolling, RunContext


class WheelRadius(KinematicEffect):
    """Wheel radius: all wheels are larger or smaller than nominal, or slip in proportion to their speed."""

    id = "wheel_radius"
    scale_role = "radius"
    rank = 30
    parameters = (
        Parameter(
            "k",
            "1",
            (0.0, 5.0),
            1.0,
            "true over nominal radius",
            0.92,
            least=Least(0.004, Least.DATA_SHEET),
            plausible=Plausible(0.4, 1.3, "radii are off by 2 to 25 %, wheels slip by half on loose ground"),
            # On slippery floors wheels spin nearly on the spot; they never fall far behind the vehicle.
            physical=(0.0, 1.3),
            quantities=(Quantity.RADIUS,),
            between_runs=Spread(0.019),
        ),
    )
    motion = "Effective wheel radius: the robot travels {share} than ideal"
    needs = (Excitation.SPEED_SPREAD,)
    confused_with = ("speed_slip", "effective_track")
    python = "v0, s0, w0 = {k} * v0, {k} * s0, {k} * w0"
    readings = (
        Reading(Level.VEHICLE, "wheel_radius", "a wrong wheel radius"),
        Reading(Level.TERRAIN, "longitudinal_slip", "longitudinal slip"),
        Reading(Level.RUN, "wheel_radius", "a change of tyre pressure or load"),
    )

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        return rolling.scale(self.values["k"], self.values["k"])
