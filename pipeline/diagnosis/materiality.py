"""Whether an effect matters: how far it moves what a planner predicts over two seconds.

A name is worth its line where leaving the effect out would be felt. Long and quiet recordings show with
certainty what moves a prediction by millimetres: it is listed apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pipeline.identification.judgement import Judgement
    from pipeline.models.effect import Effect

LEAST_WAY_SHARE = 0.01
"""Of the way driven over 2 s: a cell of 5 cm after 5 m. What the sample logs hide moves 3 % or more of it."""
LEAST_TURN_RAD = 0.005
"""Of the heading over 2 s: half a cell of 5 cm beside the path after 5 m."""
_OFTEN = 0.95


def describe_threshold() -> str:
    """The least that matters, in words."""
    return f"{LEAST_WAY_SHARE:.0%} of the way or {LEAST_TURN_RAD * 1e3:g} mrad"


@dataclass(frozen=True)
class Moves:
    """How far an effect moves predictions over 2 s, in all but one of twenty of them.

    Attributes:
        position_m: distance [m].
        heading_rad: turn [rad].
        way_share: the distance as a share of the way that is driven in as many predictions.
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
    it does nothing. Of twenty predictions the one in which it does most is left out, not the usual one taken:
    a limit or a deadband matters where it acts.
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
        float(np.quantile(np.concatenate(column), _OFTEN)) for column in zip(*shifts, strict=True)
    )
    return Moves(distance, turn, distance / way if way > 0.0 else 0.0)
