"""The search for missing effects: steps that pass the acceptance test."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

from pipeline.core.compute import Budget
from pipeline.estimation.acceptance import LEAST_GAIN, is_large_enough
from pipeline.estimation.comparison import Input
from pipeline.estimation.parts import make_weights
from pipeline.estimation.selection import USEFUL, CandidateModel, Context, Rivals, Selection, open_selection
from pipeline.estimation.state import State
from pipeline.models.effect import Effect, Place, Search
from pipeline.models.parameter import Conditions, Quantity

_MOST_EFFECTS = 8
"""Maximum number of effects that a search adds on one path: a longer list explains nothing."""
_BESIDE = (0.7, 1.4)
"""Factors of a parameter for restarting its fit: a factor of two apart, as the starts of effects are."""
_CLEAR = 2.5
"""Evidence and gain of an effect over those required, by a rough fit without it, above which it is kept: for
421 effects on recordings and drawn logs, complete fits leave 0.41 of that evidence at least."""
_WHOLE = 0.9
"""Largest loss with an effect and its companions, over that with its special cases in its place or with one
of them alone, for a search to begin with them: for the drive of nine recordings of a Warthog it is 0.19 to
0.88, on 56 of 60 drawn logs without a controller above 0.98."""
_RIVALS = 0.5
"""Minimum predicted gain of an effect's rivals, as a share of its own predicted gain."""


def search_effects(
    selection: Selection, current: CandidateModel
) -> tuple[CandidateModel, tuple[CandidateModel, ...]]:
    """Add effects, one or two at a time, while that is significant; drop and exchange those that are not.

    Args:
        selection: the part of the path on which models are judged.
        current: the model to start from, fitted.

    Returns:
        The model that no step improves, and extensions of it that are not significant.
    """
    seen, excluded, refusals = {current.ids}, set[str](), Counter[str]()
    restarted = set[tuple[str, ...]]()
    while not selection.budget.is_spent():
        chosen, extensions = _find_step(selection, current, excluded, restarted)
        if chosen is current:
            return current, extensions
        adapted = selection.reweight(chosen)
        if any(one.starts for one in adapted.state.effects if one.id not in current.ids):
            adapted = _restart_once(selection, adapted, restarted)
        new = set(adapted.ids) - set(current.ids)
        unsound = {name for name in new if not selection.may_stay(adapted.state.find(name), adapted.state)}  # type: ignore[arg-type]
        if unsound:
            # A step is invalid if its effects may not be named with the weights of its own residuals.
            excluded |= unsound
            refusals.update(unsound)
            current = selection.reweight(current)
            continue
        pruned = prune(selection, adapted)
        if pruned.ids in seen and chosen.ids != current.ids:
            # An effect that a step adds and the next one drops is not tried again.
            if pruned.ids != current.ids or not new - excluded:
                again = _restart_once(selection, pruned, restarted)
                if again is pruned:
                    return pruned, extensions
                pruned = again
            excluded |= new
        seen.add(pruned.ids)
        # An effect refused with one model may be sound with another: it is tried once more.
        excluded = {name for name in excluded if refusals[name] != 1}
        current = pruned
    return current, ()


def _find_step(
    selection: Selection, current: CandidateModel, excluded: set[str], restarted: set[tuple[str, ...]]
) -> tuple[CandidateModel, tuple[CandidateModel, ...]]:
    """A better model, the model itself where no step improves it, and its extensions."""
    evidence = selection.take_evidence(current, excluded)
    selection.noise = evidence.noise
    extensions = []
    if len(current.ids) - len(selection.given) < _MOST_EFFECTS:
        beyond: list[CandidateModel] = []
        extensions = selection.fit_hypotheses(current, evidence, beyond=beyond)
        extensions = selection.admit(current, extensions, beyond)
    chosen = choose(selection, current, extensions)
    if chosen is current:
        chosen = exchange(selection, current, excluded)
    if chosen is current:
        chosen = _restart_once(selection, current, restarted)
    if chosen is current:
        chosen = simplify(selection, current, excluded)
    return chosen, tuple(extensions)


def _restart_once(
    selection: Selection, current: CandidateModel, restarted: set[tuple[str, ...]]
) -> CandidateModel:
    """`restart`, once for each set of effects."""
    if current.ids in restarted:
        return current
    restarted.add(current.ids)
    return restart(selection, current)


def choose(selection: Selection, current: CandidateModel, models: list[CandidateModel]) -> CandidateModel:
    """The best model; one with more parameters must be significantly better than the best before.

    Args:
        selection: the part of the path on which they are judged.
        current: the model to improve.
        models: rivals, those with fewer parameters first.
    """
    best = current
    for model in models:
        if model.numbers > best.numbers:
            if selection.judge(best, model).is_significant:
                best = model
        elif selection.is_better(model, best):
            best = model
    return best


def exchange(selection: Selection, current: CandidateModel, excluded: set[str]) -> CandidateModel:
    """The better model with one effect, or two of one parameter each, replaced by one or two others, if any.

    Wheels that are all slowed alike above a limit look like a gain and a speed limit: exchanging only one of
    the two does not lead to their common cause.
    """
    free = [effect for effect in current.state.effects if effect.id not in selection.given]
    simple = [effect for effect in free if len(effect.values) == 1]
    # Of effects that are linear in their parameter, an extension finds the common cause.
    curved = {one.id for one in simple if any(p.search is not Search.DIRECT for p in one.parameters)}
    pairs = [pair for pair in combinations(simple, 2) if not curved.isdisjoint(one.id for one in pair)]
    for names in (*((effect.id,) for effect in free), *((one.id, two.id) for one, two in pairs)):
        if selection.budget.is_spent():
            break
        rivals = list_rivals(selection, current, names)
        allowed = [one for one in rivals if not excluded & (set(one.ids) - set(current.ids))]
        best = choose(selection, current, allowed)
        if best is not current:
            return best
    return current


def restart(selection: Selection, current: CandidateModel) -> CandidateModel:
    """The model refitted from values near its own and from the starts of effects, while that is better.

    A delay is correlated with lags and limits: a fit from the delay before these were added may end in a
    local minimum, and so may that of a speed loop that was started as a first-order lag, or beside effects
    that imitate it: it is started alone, too.
    """
    while not selection.budget.is_spent():
        beside = [
            current.state.set(number, share * current.state.get(number))
            for number in current.fit.free
            if number.search is Search.STARTS and number.effect not in selection.given
            for share in _BESIDE
        ]
        free = [effect for effect in current.state.effects if effect.id not in selection.given]
        starts = [
            current.state.drop(others).add(effect.change(**start))
            for effect in free
            for start in effect.list_starts(selection.largest)
            for others in dict.fromkeys(((), tuple(one.id for one in free if one is not effect)))
        ]
        before = selection.loss(current)
        fitted = selection.approach_each(current, beside, before) + selection.enter_each(starts)
        restarted = [one for one in fitted if selection.is_sound(one)]
        best = min(restarted, key=selection.loss, default=current)
        if not selection.is_better(best, current):
            return current
        current = best
    return current


def list_rivals(
    selection: Selection, current: CandidateModel, names: tuple[str, ...]
) -> list[CandidateModel]:
    """Fitted models in which some effects are replaced by one or two others of similar predicted gain."""
    key = (current.ids, names)
    known = selection.rivals.get(key)
    if known is None:
        models = _fit_rivals(selection, current, names)
    elif known.weights is selection.weights:
        return known.models
    else:
        models = _refit_rivals(selection, current, known.models)
    selection.rivals[key] = Rivals(selection.weights, models)
    return models


def _fit_rivals(
    selection: Selection, current: CandidateModel, names: tuple[str, ...]
) -> list[CandidateModel]:
    without = selection.drop(current, names)
    # Beside a lag, limits have little evidence.
    evidence = selection.take_evidence(without, (), selection.noise)
    own = [one.chi_square for one in evidence.rank_singles(0.0) if one.starts[0].effect.id in names]
    least = _RIVALS * max(own, default=math.inf)
    for name in names:
        evidence = evidence.leave_out(name)
    # A rival must also reduce the loss by the minimum for naming.
    useful = min(USEFUL * selection.loss(current), (1.0 - LEAST_GAIN) * selection.loss(without))
    models = selection.fit_hypotheses(without, evidence, least, useful)
    # Contact friction may collapse to the track that it replaces. Rough fits are many: no derivatives.
    models = [one for one in models if set(names).isdisjoint(one.ids)]
    return [replace(one, fit=one.fit.without_derivatives) if one.is_rough else one for one in models]


def _refit_rivals(
    selection: Selection, current: CandidateModel, models: Sequence[CandidateModel]
) -> list[CandidateModel]:
    """Rivals that come near the model, fitted with the present weights; the others as they are."""
    is_near = [selection.loss(model) < USEFUL * selection.loss(current) for model in models]
    near = [model.fit for model, flag in zip(models, is_near, strict=True) if flag]
    rest = [model for model, flag in zip(models, is_near, strict=True) if not flag]
    return selection.sort([*selection.enter_each(near), *rest])


def prune(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Drop effects whose evidence is no longer significant; the least significant first.

    Companions of an effect are expected and stay while they matter: a controller has ramps and limits.
    """
    while True:
        doubtful = _list_doubtful(selection, current)
        models = selection.drop_each(current, [[name] for name in doubtful])
        judged = [(selection.judge(without, current), without) for without in models]
        expected = {name for effect in current.state.effects for name in effect.companions}
        weak = [
            (one.share, without)
            for name, (one, without) in zip(doubtful, judged, strict=True)
            if (one.gain < LEAST_GAIN if name in expected else not one.is_significant)
        ]
        if not weak:
            return current
        current = selection.reweight(min(weak, key=lambda one: one[0])[1])


def _list_doubtful(selection: Selection, current: CandidateModel) -> list[str]:
    """Effects that may not be significant: rough fits of the model without each of the others settle them."""
    names = [name for name in current.ids if name not in selection.given]
    rough = selection.approach_each(current, [current.state.drop([name]) for name in names], 0.0)
    judged = zip(names, (selection.judge(without, current) for without in rough), strict=True)
    return [name for name, one in judged if one.reached < _CLEAR]


def simplify(selection: Selection, current: CandidateModel, excluded: set[str]) -> CandidateModel:
    """The model with one effect replaced by one, two or all of its special cases, if the data allow it."""
    most = (1.0 + LEAST_GAIN) * selection.sum_losses(current)
    usual = {one.id: one().make_usual(selection.largest) for one in selection.candidates}
    for effect in current.state.effects:
        cases = [usual[name] for name in effect.contains if name in usual and name not in current.ids]
        if not cases or effect.id in selection.given or excluded & {case.id for case in cases}:
            continue
        for some in dict.fromkeys([*combinations(cases, 1), *combinations(cases, 2), tuple(cases)]):
            simpler = selection.enter(current.state.drop([effect.id]).add(*some))
            if selection.sum_losses(simpler) < most:
                simpler = _make_sound(selection, simpler)
            if simpler.numbers >= current.numbers:
                continue
            if selection.sum_losses(simpler) < most:
                if not selection.judge(simpler, current).is_significant:
                    return simpler
            elif _lacks_sampling(selection, simpler, most):
                excluded.add(effect.id)
                return simpler
    return current


def _lacks_sampling(selection: Selection, simpler: CandidateModel, most: float) -> bool:
    """Whether a model has less than a sum of losses beside a delay or lag that sampling alone can cause.

    It is too small to be named; a limit beside a lag follows it, too.
    """
    for kind in selection.candidates:
        (parameter, *others), least = kind.parameters, selection.conditions.least_delay_s
        if others or not (parameter.least and parameter.least.sampled and least) or kind.id in simpler.ids:
            continue
        model = selection.enter(simpler.state.add(kind().change(**{parameter.name: least})))
        fitted = next(effect for effect in model.state.effects if effect.id == kind.id)
        if not is_large_enough(fitted, selection.conditions) and selection.sum_losses(model) < most:
            return True
    return False


# With measured wheels there are two paths: from command to wheels, the drivetrain alone, and from wheels to
# body, the ground alone. Without them, the path from the command to the body includes both.

InputPath = Literal["command", "measured", "wheels"]


@dataclass(frozen=True)
class SearchResult:
    """Result of the search on one path.

    Attributes:
        path: `command` to body, `measured` wheels to body, or command to `wheels`.
        selection: the part of the path on which the models were judged.
        start: the model to start from, fitted.
        final: the model that no step improves, fitted.
        not_significant: extensions of it that are not significantly better.
    """

    path: InputPath
    selection: Selection
    start: CandidateModel
    final: CandidateModel
    not_significant: tuple[CandidateModel, ...] = ()

    @property
    def new(self) -> tuple[str, ...]:
        """Ids of the identified effects."""
        return tuple(name for name in self.final.ids if name not in self.selection.given)


def search_body(context: Context, source: Input, known: Sequence[Effect], budget: Budget) -> SearchResult:
    """Search from an input to the body; from measured wheels it begins with contact friction."""
    usable = [e for e in known if source is Input.COMMAND or e.place > Place.DRIVE]
    start = context.problem.start_state(usable)
    candidates = context.list_candidates(source)
    problem = context.problem.behind_wheels if source is Input.MEASURED else context.problem
    selection, first = open_selection(problem.whole, start, candidates, context.conditions, budget)
    search = _search_both if source is Input.MEASURED else search_effects
    return SearchResult(source.value, selection, first, *search(selection, first))


def search_wheels(
    context: Context, known: Sequence[Effect], body: SearchResult, budget: Budget
) -> SearchResult:
    """Search from command to wheels, with the encoder delay of the path to the body.

    It begins with a whole drive, all effects of a controller that can be told from each other, if its
    controller proves significant. Otherwise a dead time is added first if it is significant alone: lags and
    limits chosen without it would imitate it, and no step of the search replaces all of them at once.
    """
    usable = [e for e in known if e.place <= Place.DRIVE]
    start = State((), body.final.state.timing).add(*usable)
    part, candidates = context.problem.parts[1], context.list_drivetrain()
    selection, first = open_selection(part, start, candidates, context.conditions, budget)
    late = [
        one().make_usual(context.largest)
        for one in candidates
        if any(Quantity.COMMAND_DELAY in parameter.quantities for parameter in one.parameters)
    ]
    delayed = selection.enter_each([first.state.add(effect) for effect in late if effect.id not in first.ids])
    begin = choose(selection, first, [model for model in delayed if selection.is_sound(model)])
    return SearchResult("wheels", selection, first, *_search_both(selection, begin))


def _search_both(
    selection: Selection, first: CandidateModel
) -> tuple[CandidateModel, tuple[CandidateModel, ...]]:
    """Search from a whole effect, and if it is hardly better without it: no step exchanges it for several."""
    begin, is_clear = _begin_whole(selection, first)
    final, near = search_effects(selection, begin)
    whole = {effect.id for effect in final.state.effects if effect.companions} - {*first.ids}
    if is_clear or not whole or selection.budget.is_spent():
        return final, near
    simple = tuple(one for one in selection.candidates if one.id not in whole)
    without = replace(selection, candidates=simple, rivals={}, _dropped={})
    other, _ = search_effects(without, without.reweight(first))
    best = choose(selection, final, [selection.enter(other.fit)])
    return (final, near) if best is final else search_effects(selection, selection.reweight(best))


def _begin_whole(selection: Selection, first: CandidateModel) -> tuple[CandidateModel, bool]:
    """The model with an effect and its companions, less what is not significant, and whether it is clear.

    A speed loop without ramps ends in a local minimum, as friction in contact that began with a track does.
    """
    usual = {one.id: _make_possible(one(), selection.conditions) for one in selection.candidates}
    for one in (one for one in usual.values() if one.companions and one.id not in first.ids):
        loaded = first.state.add(*(usual[name] for name in one.companions if name in usual))
        cases = [usual[name] for name in one.contains if name in usual]
        starts = [loaded.add(one.change(**values)) for values in one.list_starts(selection.largest)]
        alone = (first.state.add(case) for case in cases)
        tried, *others = selection.enter_each([starts[0], loaded.add(*cases), *alone])
        simpler = min(others, key=selection.loss)
        if selection.budget.is_spent() or selection.loss(tried) > _WHOLE * selection.loss(simpler):
            continue
        is_clear = selection.loss(tried) < _WHOLE**2 * selection.loss(simpler)
        weights, best = selection.weights, _make_sound(selection, tried)
        for state in starts:
            selection.take_weights(make_weights(selection.part.find_residuals(state), selection.part))
            model = _make_sound(selection, selection.reweight(selection.enter(state)))
            best = model if selection.compare_losses(model, best) < 1.0 else best
        selection.noise = selection.take_evidence(best).noise
        pruned = prune(selection, selection.reweight(best))
        if not set(pruned.ids) <= set(first.ids):
            return pruned, is_clear
        selection.take_weights(weights)
    return first, True


def _make_possible(effect: Effect, conditions: Conditions) -> Effect:
    """An effect of typical values; a limit is at least what the wheels exceed."""
    usual = effect.make_usual(conditions.largest)
    least = {p.name: conditions.exceeded.get(p.relative_to, -math.inf) for p in effect.parameters}
    return usual.change(**{name: max(value, least[name]) for name, value in usual.values.items()})


def _make_sound(selection: Selection, model: CandidateModel) -> CandidateModel:
    """The model with the simpler forms of effects that may not be named, or without them, fitted anew."""
    while reduced := selection.reduce(model.state):
        model = selection.enter(reduced)
    return model
