"""Explanations that are as good as the one chosen, as far as this log goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.diagnosis.excitation import make_usual, suggest_manoeuvre

if TYPE_CHECKING:
    from pipeline.diagnosis.arena import Arena, Contender
    from pipeline.motion.effect import Effect

_LOOKED_AT = 6
_AS_GOOD = 0.01
_ALIKE = 0.7
# Both effects were found worth a name: between two of that kind less evidence decides than for a new one.
_DECIDED_T = 1.6
# What separates them must stand out of the noise too: a nearly exact encoder splits hairs that mean nothing.
_DECIDED_Z = 1.0
_NEVER = 0.02
# Effects that hold the key as a special case explain whatever it explains.
_HOLDS: dict[str, frozenset[str]] = {
    "drive_lag": frozenset({"turn_lag"}),
    "effective_track": frozenset({"turn_droop", "terrain_change"}),
    "wheel_radius": frozenset({"terrain_change"}),
    "time_drift": frozenset({"terrain_change"}),
}
# Driven straight only, or turned on the spot only, one lag cannot be told from two.
_SPLIT = {"drive_lag": "turn_lag", "turn_lag": "drive_lag"}
# What a limit explains a droop of some rise may explain as well, where only one turn beyond it was asked for.
_RISING = {"body_turn_limit": ("turn_droop", "gain")}


@dataclass(frozen=True)
class Undecided:
    """Effects of which one acts, this log cannot tell which.

    Attributes:
        candidates: ids, the chosen one first.
        separate_by: what to drive to tell them apart.
    """

    candidates: tuple[str, ...]
    separate_by: str


def find_undecided(arena: Arena, final: Contender) -> list[Undecided]:
    """For every effect that was named, the others that would do in its place."""
    found = []
    for effect in final.state.effects:
        if effect.id in arena.kept:
            continue
        without = arena.drop(final, [effect.id])
        rivals = [
            rival
            for rival in arena.suggest(without, _LOOKED_AT, without=[effect.id])
            if _is_as_good(arena, final, rival) and _does_the_same(arena, without, final, rival)
        ]
        names = [name for rival in rivals for name in rival.ids if name not in final.ids]
        alike = [_find_rising(arena, without, final, effect), _find_split(arena, effect)]
        names += [name for name in alike if name is not None and name not in names]
        simple = [name for name in names if name in alike or not _is_larger(arena, name, effect)]
        if simple:
            rest = [c() for c in arena.candidates if c.id in names]
            found.append(Undecided((effect.id, *names), suggest_manoeuvre(effect, *rest)))
    return found


def _find_rising(arena: Arena, without: Contender, final: Contender, effect: Effect) -> str | None:
    """The effect that bends where the named one stops, if at a usual bend it does as well."""
    name, bend = _RISING.get(effect.id, ("", ""))
    candidate = next((c for c in arena.candidates if c.id == name), None)
    if candidate is None:
        return None
    rival = arena.enter(without.state.add(make_usual(candidate, arena.largest).fix(bend)))
    alike = _is_as_good(arena, final, rival) and _does_the_same(arena, without, final, rival)
    return name if alike and arena.is_sound(rival) else None


def _find_split(arena: Arena, effect: Effect) -> str | None:
    """The effect that treats driving and turning apart, where only one of them was asked for."""
    name = _SPLIT.get(effect.id)
    known = name in {candidate.id for candidate in arena.candidates}
    return name if known and _moves_one_way(arena) else None


def _moves_one_way(arena: Arena) -> bool:
    """Driven straight only, or turned on the spot only."""
    speed, turn = arena.largest.speed, arena.largest.turn
    return min(speed, turn) < _NEVER * max(speed, turn)


def _is_as_good(arena: Arena, final: Contender, rival: Contender) -> bool:
    if arena.metric.loss(rival.held) < (1.0 + _AS_GOOD) * arena.metric.loss(final.held):
        return True
    verdict = arena.judge(rival, final)
    return verdict.gain < _AS_GOOD or verdict.t < _DECIDED_T or verdict.z < _DECIDED_Z


def _does_the_same(arena: Arena, without: Contender, final: Contender, rival: Contender) -> bool:
    """Whether two effects push the prediction alike: two small ones that do not are no alternatives."""
    base = without.fitted.residual
    one = (base - final.fitted.residual) / arena.metric.scale
    other = (base - rival.fitted.residual) / arena.metric.scale
    size = float(np.sqrt(np.sum(one**2) * np.sum(other**2)))
    return size > 0.0 and float(np.sum(one * other)) > _ALIKE * size


def _is_larger(arena: Arena, name: str, effect: Effect) -> bool:
    """Whether an effect fits as well only by more numbers, or by holding the other as a special case."""
    if name in _HOLDS.get(effect.id, frozenset()):
        return True
    rival = next(c for c in arena.candidates if c.id == name)
    numbers = sum(bool(np.isfinite(value)) for value in effect.values.values())
    return len([p for p in rival.parameters if p.name != "at_x"]) > numbers
