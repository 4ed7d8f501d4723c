"""The search for the missing effects: add, drop, swap; every number is fitted anew after each move."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from pipeline.diagnosis.judge import LEAST_GAIN

if TYPE_CHECKING:
    from pipeline.diagnosis.arena import Arena, Contender

_TRIED = 4
_SWAPPED = 2
_MOST_EFFECTS = 8
_ROUNDS = 6
_BETTER = 0.005
_TIE = 0.03
# Recordings with much structure offer ever another exchange by a hair.
_MOST_WORK = 16
_MOST_SPLIT = 3


def search_effects(arena: Arena, start: Contender) -> Contender:
    """Name what is missing.

    Args:
        arena: where models are judged.
        start: the model to start from, fitted.

    Returns:
        The model that no move improves.
    """
    current = grow(arena, start)
    for _ in range(_ROUNDS):
        if arena.is_done(_MOST_WORK):
            return current
        moved = _swap(arena, current) or _join(arena, current) or _split(arena, current)
        if moved is None:
            return current
        current = grow(arena, prune(arena, arena.adapt(moved)))
    return current


def grow(arena: Arena, current: Contender) -> Contender:
    """Add effects while one is accepted, dropping what has become superfluous."""
    while len(current.ids) < _MOST_EFFECTS and not arena.budget.is_spent():
        added = _add(arena, current)
        if added is None:
            return current
        current = prune(arena, arena.adapt(added))
    return current


def _add(arena: Arena, current: Contender) -> Contender | None:
    for contender in arena.suggest(current, _TRIED):
        least = price_of(contender, current)
        if contender.score < current.score and arena.prefers(current, contender, least):
            return contender
    return None


def price_of(contender: Contender, other: Contender) -> float:
    """Gain that is asked of a model's additional effects: a change point fits anything a little."""
    new = (effect for effect in contender.state.effects if effect.id not in other.ids)
    return max([LEAST_GAIN, *(effect.price for effect in new)])


def prune(arena: Arena, current: Contender) -> Contender:
    """Drop effects whose absence is not missed, the least missed first."""
    while True:
        smaller = []
        for name in current.ids:
            if name in arena.kept:
                continue
            without = arena.drop(current, [name])
            needed = price_of(current, without)
            if not arena.prefers(without, current, needed):
                smaller.append(without)
        if not smaller:
            return current
        current = min(smaller, key=lambda contender: contender.score)


def _free(arena: Arena, current: Contender) -> list[str]:
    return [name for name in current.ids if name not in arena.kept]


def _swap(arena: Arena, current: Contender) -> Contender | None:
    """One effect for another: better, or as good with fewer in the end."""
    best: Contender | None = None
    for name in _free(arena, current):
        if arena.is_done(_MOST_WORK):
            return best
        without = arena.drop(current, [name])
        for rival in arena.suggest(without, _SWAPPED, without=[name]):
            if rival.score < (1.0 - _BETTER) * current.score:
                if best is None or rival.score < best.score:
                    best = rival
            elif rival.score < (1.0 + _TIE) * current.score:
                pruned = prune(arena, rival)
                fewer = len(current.ids) - len(pruned.ids)
                if fewer > 0 and pruned.score < (1.0 + LEAST_GAIN * fewer) * current.score:
                    return pruned
    return best


def _join(arena: Arena, current: Contender) -> Contender | None:
    """One effect in the place of two, or of all that are slow: lags together imitate a delay."""
    free = _free(arena, current)
    slow = tuple(effect.id for effect in current.state.effects if effect.is_slow and effect.id in free)
    groups = [*combinations(free, 2), *([slow] if len(slow) > 2 else [])]  # noqa: PLR2004 - pairs are there
    for group in groups:
        if arena.is_done(_MOST_WORK):
            return None
        without = arena.drop(current, group)
        for rival in arena.suggest(without, _SWAPPED, without=group):
            if rival.score < (1.0 + LEAST_GAIN) * current.score:
                return rival
    return None


def _split(arena: Arena, current: Contender) -> Contender | None:
    """Two effects in the place of one, where the model leaves room for them."""
    if not arena.has_room(current) or len(current.ids) > _MOST_SPLIT or arena.is_done(_MOST_WORK):
        return None
    for name in _free(arena, current):
        without = arena.drop(current, [name])
        for half in arena.suggest(without, 2, without=[name]):
            for rival in arena.suggest(half, 2, without=[name]):
                if rival.score < current.score and arena.prefers(current, rival):
                    return rival
    return None
