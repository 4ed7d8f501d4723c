"""Effects that the evidence was too little for, where numbers of named ones depend on them."""

import math
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from pipeline.diagnosis.diagnosis import Named, Value, say_numbers
from pipeline.diagnosis.naming import Search
from pipeline.diagnosis.search import price_of
from pipeline.diagnosis.values import list_first_run


@dataclass(frozen=True)
class Unless:
    """An effect that may act, too, and with which a named one has other numbers.

    Attributes:
        id: its id.
        parameters: its numbers in the first run.
        gain: share of the held-out loss that it takes away.
        evidence: for it, as a share of what is asked of a name.
        instead: numbers of the named effect beside it, where these leave their intervals.
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
        return f"{beside}; not named: {math.floor(100.0 * self.evidence)}% of the evidence that is asked"


def list_unless(search: Search) -> Iterator[tuple[str, Unless]]:
    """Effects of the final model with others that may act beside them, and change their numbers.

    A number is changed where it leaves its interval.

    Asked are those that the search declined for want of evidence alone: they take away as much of the
    held-out loss as is asked of a name.
    """
    final, selection = search.final, search.selection
    told = list_first_run(selection.part, final.fit)
    for declined in (one for one in search.declined if one.ids != final.ids):
        new, *others = {*declined.ids} ^ {*final.ids}
        verdict = selection.judge(final, declined)
        if others or new in told or verdict.gain < price_of(declined, final):
            continue
        beside = list_first_run(selection.part, declined.fit)
        for name, numbers in told.items():
            instead = {
                key: beside[name][key]
                for key, value in numbers.items()
                if beside[name][key].value < value.low or beside[name][key].value > value.high
            }
            if instead:
                yield name, Unless(new, beside[new], verdict.gain, verdict.evidence, instead)


def note_unless(
    named: Iterable[Named], found: Iterable[tuple[str, Unless]], taken: Container[str]
) -> tuple[Named, ...]:
    """Named effects with what `list_unless` found of them, but for effects that are told of otherwise."""
    free = [(name, one) for name, one in found if one.id not in taken]
    noted = []
    for effect in named:
        unless = tuple(one for name, one in free if name == effect.id)
        alike = dict.fromkeys((*effect.confused_with, *(one.id for one in unless)))
        noted.append(replace(effect, unless=unless, confused_with=tuple(alike)))
    return tuple(noted)
