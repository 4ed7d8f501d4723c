"""Which effects are missing: on every way that the recording opens into the vehicle.

With measured wheels there are two: from command to wheels, which is the drivetrain alone, and from wheels to
body, which is the ground alone. Without them the command must answer for both.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pipeline.diagnosis.budget import Budget
from pipeline.diagnosis.context import Context
from pipeline.diagnosis.search import search_effects
from pipeline.diagnosis.selection import CandidateModel, Selection, open_selection
from pipeline.identification.comparison import Input
from pipeline.identification.state import State
from pipeline.models.effect import Effect, Place

Way = Literal["command", "measured", "wheels"]


@dataclass(frozen=True)
class Search:
    """What the search on one way came to.

    Attributes:
        way: `command` to body, `measured` wheels to body, or command to `wheels`.
        selection: where the models were judged.
        start: the model to start from, fitted.
        final: the model that no move improves, fitted.
        declined: what was tried beside it and is not better beyond doubt.
    """

    way: Way
    selection: Selection
    start: CandidateModel
    final: CandidateModel
    declined: tuple[CandidateModel, ...] = ()

    @property
    def new(self) -> tuple[str, ...]:
        """Ids of the effects that were found."""
        return tuple(name for name in self.final.ids if name not in self.selection.kept)


def search_body(context: Context, source: Input, known: Sequence[Effect], budget: Budget) -> Search:
    """Search from an input to the body."""
    usable = [e for e in known if source is Input.COMMAND or e.place > Place.DRIVE]
    start = context.problem.start_state(usable)
    candidates = context.list_candidates(source)
    problem = context.problem.behind_wheels if source is Input.MEASURED else context.problem
    selection, first = open_selection(problem.whole, start, candidates, context.conditions, budget)
    return Search(source.value, selection, first, *search_effects(selection, first))


def search_wheels(context: Context, known: Sequence[Effect], body: Search, budget: Budget) -> Search:
    """Search from command to wheels, the encoders' own delay taken from the way to the body."""
    usable = [e for e in known if e.place <= Place.DRIVE]
    start = State((), body.final.state.timing).add(*usable)
    part, candidates = context.problem.parts[1], context.list_drivetrain()
    selection, first = open_selection(part, start, candidates, context.conditions, budget)
    return Search("wheels", selection, first, *search_effects(selection, first))
