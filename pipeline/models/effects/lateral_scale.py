"""Lateral scale: rollers lose a constant share of the sideways motion.

    s0 = k * s0

s0 is the speed to the left. k is a plain number: 1 for ideal rollers, less where they turn against friction
and slip along their axes; 0.88 is a "lateral multiplier" of 1.14 of competition robots. Drive sideways both
ways.

Source: Diegel, Badve, Bright, Potgieter and Tlale, ACRA 2002 (losses of mecanum wheels driving sideways).
"""

from dataclasses import replace

from pipeline.models.effect import SIDEWAYS, Effect, Excitation, KinematicEffect, Least, Parameter, Plausible
from pipeline.models.effects.wheel_radius import WheelRadius
from pipeline.run.signals import Rolling, RunContext


class LateralScale(KinematicEffect):
    """Lateral scale: rollers lose a constant share of the sideways motion."""

    id = "lateral_scale"
    rank = 25
    kinds = SIDEWAYS
    parameters = (
        Parameter(
            "k",
            "1",
            (0.0, 2.0),
            1.0,
            "sideways speed over that of ideal rollers",
            0.8,
            least=Least(0.01, Least.DATA_SHEET),
            plausible=Plausible(
                0.3, 1.2, "wider than the lateral multipliers of 1 to 2 of competition robots"
            ),
        ),
    )
    motion = "Lateral scale: the robot travels {share} sideways than ideal"
    needs = (Excitation.SIDEWAYS,)
    confused_with = ("roller_slip", "wheel_radius")
    python = "s0 = {k} * s0"

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        return replace(rolling, s0=self.values["k"] * rolling.s0)

    def depends_on(self, other: Effect) -> bool:
        """Sideways motion determines only the product with a wheel radius."""
        return isinstance(other, WheelRadius)
