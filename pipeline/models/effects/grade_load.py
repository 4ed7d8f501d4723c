"""Grade load: on a slope the wheels turn slower than commanded uphill and faster downhill.

    Omega = u + k/r * sin(pitch), each wheel that is commanded to turn

pitch > 0 is nose down. k [m/s]: 0.6 takes 0.1 m/s of any speed on a slope of 10 degrees. It is the load
torque over the gain of the speed controller, so that a controller with an integral part shows it for moments
only. Without encoders nothing distinguishes it from `slope_creep`. Drive a slope in several directions.

Source: a speed controller's error under a steady load; Astrom and Murray, Feedback Systems, chapter 10.
"""

import math
from dataclasses import replace

import numpy as np

from pipeline.models.effect import DriveEffect, Excitation, Parameter, Plausible
from pipeline.models.parameter import Conditions
from pipeline.run.signals import LEAST_RIM_SPEED, Floats, RunContext, Wheels

_LEAST_SLOPE_RAD = math.radians(1.5)
"""Least half range of pitch: on level ground a vehicle and its localization pitch by as much."""


class GradeLoad(DriveEffect):
    """Grade load: on a slope the wheels turn slower than commanded uphill and faster downhill."""

    id = "grade_load"
    rank = 15
    kinds = ("differential", "ackermann")
    parameters = (
        Parameter(
            "k",
            "m/s",
            (-5.0, 5.0),
            0.0,
            "speed lost at a slope of 90 degrees (k sin(slope))",
            0.6,
            plausible=Plausible(-0.1, 4.0, "a tenth of the largest speed lost on 10 degrees, up to 5 m/s"),
            one_sign=True,
        ),
    )
    motion = "Grade load: the wheels turn {size:.2g} m/s {way} uphill on a slope of 10 degrees"
    clause = "turns its wheels {size:.2g} m/s {way} uphill on a slope of 10 degrees"
    ways = ("slower", "faster")
    size_in = math.sin(math.radians(10.0))
    needs = (Excitation.SLOPE,)
    confused_with = ("slope_slip", "drive_gain")
    equivalent_to = ("slope_creep",)
    equivalent_when = "if there are no encoders"
    python = """
        load = {k} / R * math.sin(pitch)
        left += load * (abs(left) * R > 0.01)
        right += load * (abs(right) * R > 0.01)"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        radius = context.vehicle.wheel_radius_m
        load = self.values["k"] / radius * context.downhill[0]

        def carry(wheel: Floats) -> Floats:
            loaded: Floats = wheel + load * (radius * np.abs(wheel) > LEAST_RIM_SPEED)
            return loaded

        return replace(wheels, left=carry(wheels.left), right=carry(wheels.right))

    def is_equivalent(self, conditions: Conditions) -> bool:
        """Without encoders wheels that turn slower uphill are wheels that slip."""
        return not conditions.encoders

    def can_show(self, conditions: Conditions) -> bool:
        """Not on level ground, nor where pitch was not recorded."""
        return conditions.slope_rad >= _LEAST_SLOPE_RAD
