"""Whether an effect matters: how far it moves what a planner predicts over two seconds.

A name is worth its line where leaving the effect out would be felt. Long and quiet recordings show with
certainty what moves a prediction by millimetres: it is listed apart.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.identification.judgement import Judgement
from pipeline.models.effect import Effect

LEAST_WAY_SHARE = 0.005
"""Of the way driven over 2 s: half a cell of 5 cm after 5 m. The sample logs hide 2.6 % or more."""
LEAST_TURN_RAD = 0.0025
"""Of the heading over 2 s: a quarter of such a cell beside the path after 5 m."""


def describe_threshold() -> str:
    """The least that matters, in words."""
    return f"{LEAST_WAY_SHARE:.1%} of the way or {LEAST_TURN_RAD * 1e3:g} mrad (rms)"


@dataclass(frozen=True)
class Moves:
    """How far an effect moves predictions over 2 s: root mean squares, as errors over 2 s are.

    Attributes:
        position_m: distance [m].
        heading_rad: turn [rad].
        way_share: the distance as a share of the way that is predicted.
    """

    position_m: float
    heading_rad: float
    way_share: float

    @property
    def is_material(self) -> bool:
        """Whether a planner feels it."""
        return self.way_share >= LEAST_WAY_SHARE or self.heading_rad >= LEAST_TURN_RAD


def measure_moves(judgement: Judgement, effect: Effect) -> Moves | None:
    """What an effect of a fitted model does to its predictions; None where it is no part of the model.

    Everything else stays as it is: what another effect would take over in its place is no reason to say that
    it does nothing. A limit that acts seldom, but then far, counts by its square.
    """
    state = judgement.fitted.state
    if effect.id not in state.ids:
        return None
    shifts = [
        comparison.find_horizon_shifts(
            state.effects_of(run),
            [other for other in state.effects_of(run) if other.id != effect.id],
            state.timing[run],
        )
        for run, comparison in enumerate(judgement.problem.comparisons)
    ]
    distance, turn, way = (
        float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in zip(*shifts, strict=True)
    )
    return Moves(distance, turn, distance / way if way > 0.0 else 0.0)
