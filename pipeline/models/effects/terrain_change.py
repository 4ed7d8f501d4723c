"""Terrain change: from a time or position on, speed and yaw rate change by constant factors.

    v0 = k_v * v0,  w0 = k_w * w0    where t >= at_s, or where x > at_x when at_x is given

k_v, k_w are plain numbers, off one by 8 to 30 %; at_s [s] since the recording's start;
at_x [m] along the map's x axis, which is not searched: the axes of a map are unrelated to the ground.
Both grounds need ten command steps with turning.

Source: piecewise-constant slip; the deployments of Samson et al. 2024.
"""

import math

import numpy as np

from pipeline.models.effect import (
    NAN,
    Excitation,
    KinematicEffect,
    Least,
    Parameter,
    Plausible,
    Search,
)
from pipeline.models.parameter import Conditions
from pipeline.run import Rolling, RunContext

_LEAST = Least(0.03, Least.GROUND)
_PLAUSIBLE = Plausible(0.4, 1.7, "wider than the 8 to 30 % that were seen")


class TerrainChange(KinematicEffect):
    """Terrain change: from a time or position on, speed and yaw rate change by constant factors."""

    id = "terrain_change"
    rank = 60
    parameters = (
        Parameter(
            "k_v", "1", (0.05, 3.0), 1.0, "speed factor after it", 0.85, least=_LEAST, plausible=_PLAUSIBLE
        ),
        Parameter(
            "k_w", "1", (0.05, 3.0), 1.0, "yaw rate factor after it", 0.75, least=_LEAST, plausible=_PLAUSIBLE
        ),
        Parameter(
            "at_s",
            "s",
            (0.0, 1e6),
            NAN,
            "time of the change",
            150.0,
            search=Search.GRID,
            starts=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
            relative_to="duration",
            step=1.0,
        ),
        Parameter(
            "at_x",
            "m",
            (-1e6, 1e6),
            NAN,
            "place of the change, along the map's x axis",
            0.0,
            instead_of="at_s",
        ),
    )
    needs = (Excitation.LONG, Excitation.TURNING)
    # A change point reduces any residual a little.

    def roll(self, rolling: Rolling, context: RunContext) -> Rolling:
        """See the formula above."""
        at_x, at_s = self.values["at_x"], self.values["at_s"]
        if math.isfinite(at_x):
            beyond = context.position[:, 0] > at_x
        else:
            middle = context.start_s + 0.5 * context.duration_s
            beyond = context.times >= (middle if math.isnan(at_s) else at_s)
        return rolling.scale(
            np.where(beyond, self.values["k_v"], 1.0), np.where(beyond, self.values["k_w"], 1.0)
        )

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the time of the change is outside of the driving."""
        # Close to the ends of the driving it is the same as a wheel radius and a track.
        at = self.values["at_s"]
        return math.isfinite(at) and not conditions.largest.is_within(at)
