"""The search for missing effects: what a log can tell at all, and each step by the one test of acceptance."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.estimation.acceptance import LEAST_GAIN, LEAST_T, STABLE_T, find_innovations, scale_evidence
from pipeline.estimation.comparison import Input
from pipeline.estimation.evidence import Noise
from pipeline.estimation.proposals import Candidate
from pipeline.estimation.selection import (
    PRICE,
    USEFUL,
    Budget,
    CandidateModel,
    Context,
    Selection,
    open_selection,
)
from pipeline.estimation.state import State
from pipeline.models.effect import Effect, Excitation, Place, Search
from pipeline.models.parameter import Quantity

DETECTED = LEAST_T + 1.3
"""Standard errors of a size that is named in nine of ten logs."""
DETECTED_SHARE = 90
"""Of a hundred logs with an effect of that size, those in which it is named."""

MANOEUVRES: Mapping[Excitation, str] = {
    Excitation.DRIVING: "drive for a few minutes",
    Excitation.TURNING: "turn both ways, on the spot and while driving",
    Excitation.SPEED_SPREAD: "drive at several speeds, forward and backward",
    Excitation.BOTH_SIGNS: "drive forward and backward, straight and in curves of both signs",
    Excitation.CHANGES: "change speed and turning in steps, every few seconds",
    Excitation.SLOPE: "drive on a slope in several directions (by hand: `slip plan` is for level ground)",
    Excitation.LARGE: "ask for the largest speeds and turns",
    Excitation.SMALL: "ask for very small speeds, and for very small turns while driving",
    Excitation.LONG: "drive for ten minutes, the same manoeuvres at the start and at the end",
    Excitation.STEERING: "steer to both sides at several speeds",
    Excitation.SIDEWAYS: "drive sideways both ways, at several speeds",
}


@dataclass(frozen=True)
class Unobservable:
    """An effect of which this log could not tell.

    Attributes:
        id: of the effect.
        reason: the run does not excite it, or it looks like what was named.
        manoeuvre: what would show it.
    """

    id: str
    reason: Literal["no excitation", "collinear with what was named"]
    manoeuvre: str


@dataclass(frozen=True)
class Detectable:
    """What an effect that was not named would have had to be to be seen in this log.

    Attributes:
        id: of the effect.
        parameter, unit: its number.
        size: distance of the number from where the effect does nothing.
    """

    id: str
    parameter: str
    unit: str
    size: float


def find_unobservable(
    selection: Selection, final: CandidateModel
) -> tuple[list[Unobservable], list[Detectable]]:
    """Candidates of which a usual size would not be named in this log.

    Neither can be told what shows but once: an event of its own would look the same.

    Returns:
        What could not be told, and how large the other effects that are linear in one number would have had
        to be.
    """
    noise = selection.noise or selection.take_evidence(final).noise
    rows, factor = noise.tiles.rows, selection.weights.factors(final.fit.residual)
    own = noise.whiten(final.fit.jacobian[rows])
    loss = selection.weights.cost(final.fit.residual).sum()
    innovations, spread = find_innovations(noise, final.fit.residual)
    unobservable, seen = [], []
    for candidate in selection.candidates:
        if final.state.find(candidate.id) is not None:
            continue
        shift = _shift(selection, final, candidate)
        column = noise.whiten(shift[rows, :, None])[:, :, 0]
        separate = _project_out(own, column)
        independent = float((separate**2).sum()) / max(float((column**2).sum()), 1e-300)
        column, separate = (scale_evidence(innovations, spread, one) for one in (column, separate))
        alone, beside = (math.sqrt(float((one**2).sum())) for one in (column, separate))
        if beside >= LEAST_T and _is_spread(noise, separate):
            share = float(((shift * factor) ** 2).sum() / loss) * independent
            seen += _find_detectable(candidate().make_usual(selection.largest), beside, share)
            continue
        is_shown = alone >= LEAST_T and _is_spread(noise, column)
        reason: Literal["no excitation", "collinear with what was named"] = (
            "collinear with what was named" if is_shown else "no excitation"
        )
        unobservable.append(Unobservable(candidate.id, reason, suggest_manoeuvre(candidate())))
    return unobservable, seen


def _project_out(own: Floats, column: Floats) -> Floats:
    """What of a column, shape (k, c), the model's own columns, shape (k, c, p), cannot imitate."""
    if not own.shape[2]:
        return column
    flat = own.reshape(-1, own.shape[2])
    solution = np.linalg.lstsq(flat, column.reshape(-1), rcond=1e-8)[0]
    residual: Floats = (column.reshape(-1) - flat @ solution).reshape(column.shape)
    return residual


def _is_spread(noise: Noise, column: Floats) -> bool:
    """Whether a column of innovations shows without the ten seconds in which it shows most."""
    power = np.bincount(noise.tiles.unit, (column**2).sum(axis=1))
    return math.sqrt(float(power.sum() - power.max())) >= STABLE_T


def _find_detectable(usual: Effect, standard_errors: float, share: float) -> list[Detectable]:
    """The size of an effect of one number that would be seen; its motion grows with it.

    Args:
        usual: the effect at a usual size.
        standard_errors: that it is then.
        share: of the model's loss that it then takes away: what takes less than a name must is not named.
    """
    (parameter, *others) = usual.parameters
    distance = abs(usual.values[parameter.name] - parameter.neutral)
    if others or parameter.search is not Search.DIRECT or not math.isfinite(distance):
        return []
    size = distance * max(DETECTED / standard_errors, math.sqrt(LEAST_GAIN / share))
    if parameter.least is not None:
        size = max(size, parameter.least.size)
    return [Detectable(usual.id, parameter.name, parameter.unit, size)]


def suggest_manoeuvre(*effects: Effect) -> str:
    """What to drive so that effects show themselves."""
    needs: list[Excitation] = []
    for effect in effects:
        needs += [need for need in effect.needs if need not in needs]
    return "; ".join(MANOEUVRES[need] for need in needs[:3])


def _shift(selection: Selection, final: CandidateModel, candidate: Candidate) -> Floats:
    changed = selection.part.find_residuals(final.state.add(candidate().make_usual(selection.largest)))
    return final.fit.residual - changed


_MOST_EFFECTS = 8
"""Most effects that a search adds on one path: a longer list describes and explains nothing."""
_BESIDE = (0.7, 1.4)
"""Shares of a number from which its fit is started anew: twice apart, as the starts of effects are."""
_COMMON = 3
"""Number of effects tried in the place of two."""
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
    seen, excluded, refusals = {current.ids}, set[str](), Counter[str]()
    restarted = set[tuple[str, ...]]()
    while not selection.budget.is_spent():
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
        if chosen is current and current.ids not in restarted:
            restarted.add(current.ids)
            chosen = restart(selection, current)
        if chosen is current:
            return current, tuple(extensions)
        adapted = selection.reweight(chosen)
        new = set(adapted.ids) - set(current.ids)
        unsound = {name for name in new if not selection.may_stay(adapted.state.find(name), adapted.state)}  # type: ignore[arg-type]
        if unsound:
            # What may not be named under the weights of its own residuals is no step.
            excluded |= unsound
            refusals.update(unsound)
            current = selection.reweight(current)
            continue
        pruned = prune(selection, adapted)
        if pruned.ids in seen and chosen.ids != current.ids:
            # What a step adds and the next one drops again is tried no more.
            if pruned.ids != current.ids or not new - excluded:
                return pruned, tuple(extensions)
            excluded |= new
        seen.add(pruned.ids)
        # What was refused beside one model may be sound beside another: it is tried once more.
        excluded = {name for name in excluded if refusals[name] != 1}
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
    for model in models:
        if model.numbers > best.numbers:
            if selection.judge(best, model).is_significant:
                best = model
        elif selection.is_better(model, best):
            best = model
    return best


def exchange(selection: Selection, current: CandidateModel, excluded: set[str]) -> CandidateModel:
    """The model with one effect exchanged for one or two others that do better in its place."""
    for effect in current.state.effects:
        if effect.id in selection.given or selection.budget.is_spent():
            continue
        best = choose(selection, current, list_rivals(selection, current, effect.id, excluded))
        if best is not current:
            return best
    simple = [
        effect.id
        for effect in current.state.effects
        if effect.id not in selection.given and len(effect.values) == 1
    ]
    for pair in combinations(simple, 2):
        if selection.budget.is_spent():
            break
        best = choose(selection, current, list_common(selection, current, pair, excluded))
        if best is not current:
            return best
    return current


def list_common(
    selection: Selection, current: CandidateModel, names: tuple[str, str], excluded: set[str]
) -> list[CandidateModel]:
    """Models with one other effect in the place of two that have one number each, fitted.

    Wheels that are slowed alike beyond a limit look like a gain and a limit of the speed: neither alone gives
    way to the one cause of both.
    """
    key = (current.ids, *names)
    if key not in selection.rivals:
        without = selection.drop(current, names)
        evidence = selection.take_evidence(without, excluded, selection.noise)
        singles = evidence.leave_out(names[0]).leave_out(names[1]).rank_singles(PRICE)
        useful = min(USEFUL * selection.loss(current), (1.0 - LEAST_GAIN) * selection.loss(without))
        states = [one.starts[0].add_to(without.state) for one in singles[:_COMMON]]
        fitted = selection.enter_each(states, useful)
        selection.rivals[key] = [one for one in fitted if selection.is_sound(one)]
    return selection.rivals[key]


def restart(selection: Selection, current: CandidateModel) -> CandidateModel:
    """The model fitted from numbers beside its own and from those that effects are started at, while better.

    A delay trades against lags and limits: a descent from where the delay had been before these were known
    ends in one of several hollows, and so does that of a speed loop which was begun as a plain lag.
    """
    while not selection.budget.is_spent():
        states = [
            current.state.set(number, share * current.state.get(number))
            for number in current.fit.free
            if number.search is Search.STARTS and number.effect not in selection.given
            for share in _BESIDE
        ]
        states += [
            current.state.add(effect.change(**start))
            for effect in current.state.effects
            if effect.id not in selection.given
            for start in effect.starts
        ]
        fitted = selection.enter_each(states, selection.loss(current))
        restarted = [one for one in fitted if selection.is_sound(one)]
        best = min(restarted, key=selection.loss, default=current)
        if not selection.is_better(best, current):
            return current
        current = best
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
        # What takes less off the loss than a name must is no rival either.
        useful = min(USEFUL * selection.loss(current), (1.0 - LEAST_GAIN) * selection.loss(without))
        selection.rivals[key] = selection.fit_hypotheses(without, rivals, least, useful)
    return selection.rivals[key]


def prune(selection: Selection, current: CandidateModel) -> CandidateModel:
    """Drop effects whose evidence is no longer significant; the least significant first."""
    while True:
        free = [[name] for name in current.ids if name not in selection.given]
        models = selection.drop_each(current, free)
        judged = [(selection.judge(without, current), without) for without in models]
        weak = [(one.share, without) for one, without in judged if not one.is_significant]
        if not weak:
            return current
        current = selection.reweight(min(weak, key=lambda one: one[0])[1])


# Which effects are missing: on every way that the recording opens into the vehicle.
#
# With measured wheels there are two: from command to wheels, which is the drivetrain alone, and from wheels
# to body, which is the ground alone. Without them the command must answer for both.

InputPath = Literal["command", "measured", "wheels"]


@dataclass(frozen=True)
class SearchResult:
    """What the search on one way came to.

    Attributes:
        path: `command` to body, `measured` wheels to body, or command to `wheels`.
        selection: where the models were judged.
        start: the model to start from, fitted.
        final: the model that no move improves, fitted.
        not_significant: what was tried beside it and is not better beyond doubt.
    """

    path: InputPath
    selection: Selection
    start: CandidateModel
    final: CandidateModel
    not_significant: tuple[CandidateModel, ...] = ()

    @property
    def new(self) -> tuple[str, ...]:
        """Ids of the effects that were found."""
        return tuple(name for name in self.final.ids if name not in self.selection.given)


def search_body(context: Context, source: Input, known: Sequence[Effect], budget: Budget) -> SearchResult:
    """Search from an input to the body."""
    usable = [e for e in known if source is Input.COMMAND or e.place > Place.DRIVE]
    start = context.problem.start_state(usable)
    candidates = context.list_candidates(source)
    problem = context.problem.behind_wheels if source is Input.MEASURED else context.problem
    selection, first = open_selection(problem.whole, start, candidates, context.conditions, budget)
    return SearchResult(source.value, selection, first, *search_effects(selection, first))


def search_wheels(
    context: Context, known: Sequence[Effect], body: SearchResult, budget: Budget
) -> SearchResult:
    """Search from command to wheels, the encoders' own delay taken from the way to the body.

    A dead time is added first where it is significant alone: lags and limits that were chosen without it take
    its place, and nothing in the search replaces all of them at once.
    """
    usable = [e for e in known if e.place <= Place.DRIVE]
    start = State((), body.final.state.timing).add(*usable)
    part, candidates = context.problem.parts[1], context.list_drivetrain()
    selection, first = open_selection(part, start, candidates, context.conditions, budget)
    late = [one().make_usual(context.largest) for one in candidates if _is_dead_time(one())]
    delayed = selection.enter_each([first.state.add(effect) for effect in late if effect.id not in first.ids])
    begin = choose(selection, first, [model for model in delayed if selection.is_sound(model)])
    return SearchResult("wheels", selection, first, *search_effects(selection, begin))


def _is_dead_time(effect: Effect) -> bool:
    return any(Quantity.COMMAND_DELAY in parameter.quantities for parameter in effect.parameters)
