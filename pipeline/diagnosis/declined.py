"""Effects for which there was too little evidence, where numbers of named ones depend on them."""

import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipeline.diagnosis.diagnosis import Named, Value, say_numbers
from pipeline.diagnosis.naming import Search
from pipeline.diagnosis.values import holds_nothing, list_first_run
from pipeline.estimation.acceptance import LEAST_GAIN
from pipeline.identification import estimate_intervals, fit_model
from pipeline.identification.judgement import Judgement
from pipeline.models import Effect

# With less evidence an effect says nothing of the others.
_NEARLY = 0.5


@dataclass(frozen=True)
class Declined:
    """An effect that takes away as much of the held-out loss as is asked of a name, not beyond doubt.

    Attributes:
        effect: with its numbers beside the model that the search ended with.
        gain: share of the held-out loss that it takes away.
        evidence: for it, as a share of what is asked of a name.
    """

    effect: Effect
    gain: float
    evidence: float


@dataclass(frozen=True)
class Unless:
    """An effect that may act, too, and with which a named one has other numbers.

    Attributes:
        id: its id.
        parameters: its numbers.
        gain, evidence: see `Declined`.
        instead: numbers of the named effect beside it, whose intervals lie apart from those without it.
    """

    id: str
    parameters: Mapping[str, Value]
    gain: float
    evidence: float
    instead: Mapping[str, Value]

    @property
    def sentence(self) -> str:
        """What the named effect is beside it, and why it has no name itself."""
        beside = f"if {self.id} acts, too ({say_numbers(self.parameters)}): {say_numbers(self.instead)}"
        evidence = math.floor(100.0 * self.evidence) / 100.0
        return f"{beside}; not named: the evidence is {evidence:.2f} of what is asked"


def list_declined(search: Search) -> Iterator[Declined]:
    """Effects that the search tried last, beside the model that it ended with, see `Declined`."""
    final, selection = search.final, search.selection
    for larger in search.declined:
        added = [effect for effect in larger.state.effects if effect.id not in final.ids]
        if len(added) != 1 or len(larger.ids) != len(final.ids) + 1 or added[0].id in selection.part.clocks:
            continue
        if not selection.may_stay(added[0], larger.state):
            continue
        improvement = selection.judge(final, larger)
        if improvement.gain >= LEAST_GAIN and _NEARLY <= improvement.share < 1.0:
            yield Declined(added[0], improvement.gain, improvement.share)


def find_unless(
    judgement: Judgement, named: Sequence[Named], declined: Iterable[Declined], taken: Container[str]
) -> Iterator[tuple[str, Unless]]:
    """Named effects whose numbers are others beside what was declined, all fitted together.

    Args:
        judgement: of the model that the named effects are told from.
        named: with their numbers; those of each run's own are left out.
        declined: what may act, too.
        taken: ids of effects that are told of otherwise.
    """
    for one in declined:
        name = one.effect.id
        if name in taken:
            continue
        model = judgement.fitted.model + one.effect
        fitted = fit_model(judgement.problem, model, start=judgement.fitted, exact=True)
        beside = list_first_run(fitted.state, estimate_intervals(judgement.problem, fitted))
        if holds_nothing(name, [beside[name]]):
            continue
        for effect in named:
            if effect.by_run or effect.id not in beside:
                continue
            instead = {
                key: other
                for key, value in effect.parameters.items()
                if (other := beside[effect.id][key]).high < value.low or other.low > value.high
            }
            if instead:
                yield effect.id, Unless(name, beside[name], one.gain, one.evidence, instead)
