"""The search for the missing effects: add, drop, swap; every number is fitted anew after each move."""

import math
from itertools import combinations

from pipeline.diagnosis.selection import CandidateModel, Selection
from pipeline.diagnosis.verdict import LEAST_GAIN

_TRIED = 4
_MUCH = 0.67
_SWAPPED = 2
_MOST_EFFECTS = 8
_ROUNDS = 6
_BETTER = 0.005
_TIE = 0.03
# Recordings with much structure offer ever another exchange by a hair.
_MOST_WORK = 16


def search_effects(selection: Selection, start: CandidateModel) -> CandidateModel:
    """Name what is missing.

    Args:
        selection: where models are judged.
        start: the model to start from, fitted.

    Returns:
        The model that no move improves.
    """
    current = grow(selection, start)
    seen = {current.ids}
    moves = iter((_swap, _join, _split))
    for _ in range(_ROUNDS):
        moved = next((found for move in moves if (found := move(selection, current)) is not None), None)
        if moved is None:
            return current
        after = grow(selection, prune(selection, selection.adapt(moved)))
        if selection.rate(after) > (1.0 + _TIE) * selection.rate(current):
            # What made the exchange better is not borne out by evidence alone: it is taken back.
            current = selection.adapt(current)
            continue
        current = after
        if current.ids not in seen:
            # An exchange that ends where it began is not tried again; the others are.
            seen.add(current.ids)
            moves = iter((_swap, _join, _split))
    return current


def grow(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Add effects while one is accepted, dropping what has become superfluous; no set is come to twice."""
    seen = set[tuple[str, ...]]()
    while current.ids not in seen and len(current.ids) < _MOST_EFFECTS and not selection.budget.is_spent():
        seen.add(current.ids)
        added = _add(selection, current)
        if added is None:
            return current
        current = prune(selection, selection.adapt(added))
    return current


def _add(selection: Selection, current: CandidateModel) -> CandidateModel | None:
    """The best effect more; one of the less promising where it, too, promises much."""
    for count, most in ((_TRIED, math.inf), (2 * _TRIED, _MUCH * current.score)):
        for tested in selection.suggest(current, count, most=most):
            # What has put simpler effects in the place of others, and needs no more numbers, is an exchange.
            exchanged = tested.numbers <= current.numbers
            if exchanged and tested.score < (1.0 - _BETTER) * current.score:
                return tested
            if tested.score < current.score and selection.prefers(current, tested, price_of(tested, current)):
                return tested
    return None


def price_of(tested: CandidateModel, other: CandidateModel) -> float:
    """Gain that is asked of a model's additional effects: a change point fits anything a little."""
    new = (effect for effect in tested.state.effects if effect.id not in other.ids)
    return max([LEAST_GAIN, *(effect.price for effect in new)])


def prune(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Drop effects that are not missed, nor together with those dropped before; the least missed first."""
    begun = current
    while True:
        smaller = []
        for without in selection.drop_each(current, [[name] for name in _free(selection, current)]):
            larger = (current, begun)
            if not any(selection.prefers(without, more, price_of(more, without)) for more in larger):
                smaller.append(without)
        if not smaller:
            return current
        current = min(smaller, key=lambda tested: tested.score)


def _free(selection: Selection, current: CandidateModel) -> list[str]:
    return [name for name in current.ids if name not in selection.kept]


def _swap(selection: Selection, current: CandidateModel) -> CandidateModel | None:
    """One effect for another: better, or as good with fewer in the end."""
    best: CandidateModel | None = None
    for name in _free(selection, current):
        if selection.is_done(_MOST_WORK):
            return best
        without = selection.drop(current, [name])
        most = (1.0 + _TIE) * current.score
        for rival in selection.suggest(without, _SWAPPED, without=[name], most=most):
            if rival.score < (1.0 - _BETTER) * current.score:
                if best is None or rival.score < best.score:
                    best = rival
            elif rival.score < most:
                pruned = prune(selection, rival)
                fewer = len(current.ids) - len(pruned.ids)
                if fewer > 0 and pruned.score < (1.0 + LEAST_GAIN * fewer) * current.score:
                    return pruned
    return best


def _join(selection: Selection, current: CandidateModel) -> CandidateModel | None:
    """One effect in the place of two, or of all that are slow: lags together imitate a delay."""
    free = _free(selection, current)
    slow = tuple(effect.id for effect in current.state.effects if effect.is_slow and effect.id in free)
    groups = [*combinations(free, 2), *([slow] if len(slow) > 2 else [])]  # noqa: PLR2004 - pairs are there
    for group in groups:
        if selection.is_done(_MOST_WORK):
            return None
        without = selection.drop(current, group)
        most = (1.0 + LEAST_GAIN) * current.score
        for rival in selection.suggest(without, _SWAPPED, without=group, most=most):
            if rival.score < most:
                return rival
    return None


def _split(selection: Selection, current: CandidateModel) -> CandidateModel | None:
    """Two effects in the place of one, where the model leaves room for them."""
    if not selection.has_room(current):
        return None
    for name in _free(selection, current):
        if selection.budget.is_spent():
            return None
        without = selection.drop(current, [name])
        most = current.score
        for rival in selection.suggest(without, _SWAPPED, without=[name], pairs=True, most=most):
            if rival.score < current.score and selection.prefers(current, rival):
                return rival
    return None
