"""Yaw drift: the vehicle turns at a constant rate while its wheels turn.

    v_w += c * turning

turning is one while the wheels turn. c [rad/s]. Drive straight forward and backward to tell it from uneven
wheels.

Source: constant term of the slip model of Seegmiller and Kelly, RSS 2014.
"""

from collections.abc import Mapping

from pipeline.models.effect import Column, Excitation, LinearEffect, Parameter
from pipeline.run.signals import Rolling, RunContext, Velocity, find_turning


class YawDrift(LinearEffect):
    """Yaw drift: the vehicle turns at a constant rate while its wheels turn."""

    id = "yaw_drift"
    parameters = (Parameter("c", "rad/s", (-0.5, 0.5), 0.0, "yaw rate to the left", 0.06),)
    motion = "Yaw drift: {size:.2g} rad/s to the {way} while the wheels turn"
    clause = "turns {size:.2g} rad/s to the {way} while its wheels turn"
    needs = (Excitation.BOTH_SIGNS,)
    confused_with = ("wheel_asymmetry", "steering_offset")
    python = "v_w = v_w + {c} * turning"

    def columns(self, rolling: Rolling, velocity: Velocity, context: RunContext) -> Mapping[str, Column]:
        """See the formula above."""
        return {"c": (0.0, 0.0, find_turning(rolling.wheels, context))}
