"""The search for the missing effects: forward-backward, every number fitted anew after each step."""

import math

from pipeline.diagnosis.selection import CandidateModel, Selection
from pipeline.diagnosis.verdict import LEAST_GAIN

_TRIED = 4
_MUCH = 0.67
_MOST_EFFECTS = 8
_BETTER = 0.005


def search_effects(
    selection: Selection, current: CandidateModel
) -> tuple[CandidateModel, tuple[CandidateModel, ...]]:
    """Add effects while one is accepted, dropping what has become superfluous; no set is come to twice.

    What may not be named under the weights of its own residuals is no step: the search goes on without it.

    Args:
        selection: where models are judged.
        current: the model to start from, fitted.

    Returns:
        The model that no step improves, and others that were tried beside it and are not better beyond doubt.
    """
    seen, barred, larger = set[tuple[str, ...]](), set[str](), current
    while current.ids not in seen and len(current.ids) < _MOST_EFFECTS and not selection.budget.is_spent():
        seen.add(current.ids)
        added, declined = _add(selection, current, barred)
        if added is None:
            return current, declined
        larger = selection.adapt(added)
        new = [effect for effect in larger.state.effects if effect.id not in current.ids]
        refused = {effect.id for effect in new if not selection.may_stay(effect, larger.state)}
        if refused:
            barred |= refused
            larger = current = selection.adapt(current)
            seen.discard(current.ids)
            continue
        current = prune(selection, larger)
    return current, (larger,)


def _add(
    selection: Selection, current: CandidateModel, barred: set[str]
) -> tuple[CandidateModel | None, tuple[CandidateModel, ...]]:
    """The best effect more, one of the less promising where it, too, promises much; else what was tried."""
    declined: list[CandidateModel] = []
    for known, most in ((0, math.inf), (_TRIED, _MUCH * current.score)):
        for tested in selection.suggest(current, known + _TRIED, without=barred, most=most, known=known):
            # What has put simpler effects in the place of others, and needs no more numbers, is an exchange.
            exchanged = tested.numbers <= current.numbers
            if exchanged and tested.score < (1.0 - _BETTER) * current.score:
                return tested, ()
            if tested.score < current.score and selection.prefers(current, tested, price_of(tested, current)):
                return tested, ()
            declined.append(tested)
    return None, tuple(declined)


def price_of(tested: CandidateModel, other: CandidateModel) -> float:
    """Gain that is asked of a model's additional effects: a change point fits anything a little."""
    new = (effect for effect in tested.state.effects if effect.id not in other.ids)
    return max([LEAST_GAIN, *(effect.price for effect in new)])


def prune(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Drop effects that are not missed, nor together with those dropped before; the least missed first."""
    begun = current
    while True:
        smaller = []
        free = [[name] for name in current.ids if name not in selection.kept]
        for without in selection.drop_each(current, free):
            larger = (current, begun)
            if not any(selection.prefers(without, more, price_of(more, without)) for more in larger):
                smaller.append(without)
        if not smaller:
            return current
        current = min(smaller, key=lambda tested: tested.score)
