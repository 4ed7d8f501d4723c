"""Which effects are missing: on every way that the recording opens into the vehicle.

With measured wheels there are two: from command to wheels, which is the drivetrain alone, and from wheels to
body, which is the ground alone. Without them the command must answer for both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pipeline.diagnosis.arena import open_arena
from pipeline.diagnosis.search import search_effects
from pipeline.identification.comparison import Input
from pipeline.identification.state import State
from pipeline.models.effect import Place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.diagnosis.arena import Arena, Contender
    from pipeline.diagnosis.budget import Budget
    from pipeline.diagnosis.ground import Ground
    from pipeline.models.effect import Effect

_LEAST_SHARE = 0.01

Way = Literal["command", "measured", "wheels"]


@dataclass(frozen=True)
class Search:
    """What the search on one way came to.

    Attributes:
        way: `command` to body, `measured` wheels to body, or command to `wheels`.
        arena: where the models were judged.
        start: the model to start from, fitted.
        final: the model that no move improves, fitted.
    """

    way: Way
    arena: Arena
    start: Contender
    final: Contender

    @property
    def new(self) -> tuple[str, ...]:
        """Ids of the effects that were found."""
        return tuple(name for name in self.final.ids if name not in self.arena.kept)


def search_body(ground: Ground, source: Input, known: Sequence[Effect], budget: Budget) -> Search:
    """Search from an input to the body."""
    usable = [e for e in known if source is Input.COMMAND or e.place > Place.DRIVE]
    start = State((), ground.timing).add(*usable)
    candidates = ground.list_candidates(source)
    problem = ground.problem.behind_wheels if source is Input.MEASURED else ground.problem
    arena, first = open_arena(problem.whole, start, candidates, ground.evidence, budget)
    return Search(source.value, arena, first, search_effects(arena, first))


def search_wheels(ground: Ground, known: Sequence[Effect], body: Search, budget: Budget) -> Search:
    """Search from command to wheels, the encoders' own delay taken from the way to the body."""
    usable = [e for e in known if e.place <= Place.DRIVE]
    start = State((), body.final.state.timing).add(*usable)
    part, candidates = ground.problem.parts[1], ground.list_drivetrain()
    arena, first = open_arena(part, start, candidates, ground.evidence, budget)
    arena.least_share = _LEAST_SHARE
    return Search("wheels", arena, first, search_effects(arena, first))
