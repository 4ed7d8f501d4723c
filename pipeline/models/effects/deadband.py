"""Deadband: wheels stand still for commands that are too small.

    Omega = 0 where r * abs(u) < d, else u

d [m/s] at the rim, 0.04 to 0.3. Drive slowly, and turn slowly while driving.

Source: static friction of a geared drive; Siciliano and Khatib, Springer Handbook of Robotics, chapter 24.
"""

import numpy as np

from pipeline.models.effect import WHEELED, CommandEffect, Excitation, Parameter, Search
from pipeline.models.parameter import Conditions, Largest, Quantity
from pipeline.run.signals import Commands, RunContext

# Share of the largest speed: a command passes a smaller deadband in one step.
_LEAST_SHARE = 0.02


class Deadband(CommandEffect):
    """Deadband: wheels stand still for commands that are too small."""

    id = "deadband"
    rank = 30
    kinds = WHEELED
    parameters = (
        Parameter(
            "d",
            "m/s",
            (0.0, 2.0),
            0.0,
            "smallest rim speed that moves a wheel",
            0.15,
            search=Search.GRID,
            starts=(0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45),
            step=0.02,
            quantities=(Quantity.DEADBAND,),
        ),
    )
    motion = "Deadband: rim speeds below {d:.2g} m/s do not move a wheel"
    clause = "ignores wheel speeds below {d:.2g} m/s"
    needs = (Excitation.SMALL,)
    confused_with = ("turn_droop",)
    python = """
        wheels = split(left, right, sideways)
        left, right, sideways = join([0.0 if R * abs(wheel) < {d} else wheel for wheel in wheels])"""

    def change_commands(self, commands: Commands, context: RunContext) -> Commands:
        """See the formula above."""
        least = self.values["d"] / context.vehicle.wheel_radius_m
        if self.is_neutral:
            return commands
        return commands.change_each_wheel(lambda speed: np.where(np.abs(speed) < least, 0.0, speed))

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is too small relative to the largest commanded speed."""
        return not self.values["d"] > _LEAST_SHARE * conditions.largest.speed

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        (d,) = self.parameters
        return {"d": d.typical * min(largest.speed, 1.0)}
