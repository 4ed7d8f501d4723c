"""Yaw misalignment: the reported heading is off by a constant angle, or the vehicle crabs on a bent axle.

    reported yaw = yaw + psi:  v_x = cos(psi)*v_x + sin(psi)*v_y,  v_y = cos(psi)*v_y - sin(psi)*v_x

psi [rad], 1 to 5 degrees; nearly v_y = -psi v_x. Drive straight forward and backward; check the mounting of
the sensor.

Source: rotation of the reported frame; a crabbing vehicle moves alike.
"""

import math
from dataclasses import replace

from pipeline.models.effect import Excitation, Least, Parameter, Plausible, ReportEffect
from pipeline.models.parameter import Level, Reading
from pipeline.run.signals import RunContext, Velocity


class YawMisalignment(ReportEffect):
    """Yaw misalignment: the reported heading is off by a constant angle."""

    id = "yaw_misalignment"
    rank = 20
    parameters = (
        Parameter(
            "psi",
            "rad",
            (-0.8, 0.8),
            0.0,
            "reported minus true heading",
            0.05,
            least=Least(0.003, Least.MOUNTING),
            plausible=Plausible(-0.35, 0.35, "wider than the 1 to 5 degrees that were seen"),
        ),
    )
    motion = "Yaw misalignment: the heading is {angle} too far {way}"
    needs = (Excitation.BOTH_SIGNS,)
    confused_with = ("lateral_drift",)
    readings = (
        Reading(Level.VEHICLE, "yaw_misalignment", "a misaligned sensor or a bent axle"),
        Reading(Level.TERRAIN, "crabbing", "crabbing on this terrain"),
        Reading(Level.RUN, "yaw_misalignment", "a remounted sensor"),
    )

    def report(self, velocity: Velocity, context: RunContext) -> Velocity:
        """See the formula above."""
        sine, cosine = math.sin(self.values["psi"]), math.cos(self.values["psi"])
        return replace(
            velocity, x=cosine * velocity.x + sine * velocity.y, y=cosine * velocity.y - sine * velocity.x
        )
