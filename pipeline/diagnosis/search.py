"""The search for the missing effects: extend, drop, exchange, each step by the one test of acceptance."""

from __future__ import annotations

import math

from pipeline.diagnosis.selection import CandidateModel, Selection

_MOST_EFFECTS = 8
_BETTER = 0.005
"""Share of the loss by which a model with no more numbers must be better to take another's place."""
_RIVALS = 0.5
"""Rivals of an effect promise at least this share of what it promises itself."""


def search_effects(
    selection: Selection, current: CandidateModel
) -> tuple[CandidateModel, tuple[CandidateModel, ...]]:
    """Add effects, one or two at a time, while that is significant; drop and exchange what no longer is.

    Args:
        selection: where models are judged.
        current: the model to start from, fitted.

    Returns:
        The model that no step improves, and extensions of it that are not significant.
    """
    seen, excluded = {current.ids}, set[str]()
    while not selection.budget.is_spent():
        evidence = selection.take_evidence(current, excluded)
        selection.noise = evidence.noise
        extensions = []
        if len(current.ids) - len(selection.kept) < _MOST_EFFECTS:
            beyond: list[CandidateModel] = []
            extensions = selection.fit_hypotheses(current, evidence, beyond=beyond)
            extensions = selection.admit(current, extensions, beyond)
        chosen = choose(selection, current, extensions)
        if chosen is current:
            chosen = exchange(selection, current, excluded)
        if chosen is current:
            return current, tuple(extensions)
        adapted = selection.adapt(chosen)
        new = set(adapted.ids) - set(current.ids)
        refused = {name for name in new if not selection.may_stay(adapted.state.find(name), adapted.state)}  # type: ignore[arg-type]
        if refused:
            # What may not be named under the weights of its own residuals is no step.
            excluded |= refused
            current = selection.adapt(current)
            continue
        pruned = prune(selection, adapted)
        if pruned.ids in seen:
            # What a step adds and the next one drops again is tried no more.
            if pruned.ids != current.ids or not new - excluded:
                return pruned, tuple(extensions)
            excluded |= new
        seen.add(pruned.ids)
        current = pruned
    return current, ()


def choose(selection: Selection, current: CandidateModel, models: list[CandidateModel]) -> CandidateModel:
    """The best of some models, each with more numbers significantly better than the best with fewer.

    Args:
        selection: where they are judged.
        current: the model to better.
        models: rivals, those with fewer numbers first.
    """
    best = current
    for tested in models:
        if tested.numbers > best.numbers:
            if selection.judge(best, tested).is_significant:
                best = tested
        elif selection.loss(tested) < (1.0 - _BETTER) * selection.loss(best):
            best = tested
    return best


def exchange(selection: Selection, current: CandidateModel, excluded: set[str]) -> CandidateModel:
    """The model with one effect exchanged for one or two others that do better in its place."""
    for effect in current.state.effects:
        if effect.id in selection.kept or selection.budget.is_spent():
            continue
        best = choose(selection, current, list_rivals(selection, current, effect.id, excluded))
        if best is not current:
            return best
    return current


def list_rivals(
    selection: Selection, current: CandidateModel, name: str, excluded: set[str] | None = None
) -> list[CandidateModel]:
    """Models with one or two other effects in the place of one, those that promise nearly as much, fitted."""
    key = (current.ids, name)
    if key not in selection.rivals:
        without = selection.drop(current, [name])
        # Limits hardly show beside a lag: what would do in an effect's place is seen where it is not.
        evidence = selection.take_evidence(without, excluded or set(), selection.noise)
        own = [one for one in evidence.rank_singles(0.0) if one.starts[0].effect.id == name]
        least = _RIVALS * own[0].chi_square if own else math.inf
        rivals = evidence.leave_out(name)
        selection.rivals[key] = selection.fit_hypotheses(without, rivals, least)
    return selection.rivals[key]


def prune(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Drop effects whose evidence is no longer significant; the least significant first."""
    while True:
        free = [[name] for name in current.ids if name not in selection.kept]
        models = selection.drop_each(current, free)
        judged = [(selection.judge(without, current), without) for without in models]
        weak = [(one.share, without) for one, without in judged if not one.is_significant]
        if not weak:
            return current
        current = selection.adapt(min(weak, key=lambda one: one[0])[1])
