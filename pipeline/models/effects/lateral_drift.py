"""Lateral drift: the vehicle moves sideways at a constant rate while its wheels turn.

    v_y += c * turning

turning is one while the wheels turn. c [m/s]. Drive forward and backward to tell it from a misaligned sensor.

Source: constant term of the slip model of Seegmiller and Kelly, RSS 2014.
"""

from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter
from pipeline.run.signals import Rolling, RunContext, Velocity, find_turning


class LateralDrift(LinearEffect):
    """Lateral drift: the vehicle moves sideways at a constant rate while its wheels turn."""

    id = "lateral_drift"
    parameters = (Parameter("c", "m/s", (-0.5, 0.5), 0.0, "speed to the left", 0.05),)
    motion = "Lateral drift: {size:.2g} m/s to the {way} while the wheels turn"
    clause = "drifts {size:.2g} m/s to the {way} while its wheels turn"
    needs = (Excitation.BOTH_SIGNS,)
    confused_with = ("yaw_misalignment", "side_slope_creep")
    python = "v_y = v_y + {c} * turning"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"c": (0.0, find_turning(rolling.wheels, context), 0.0)}
