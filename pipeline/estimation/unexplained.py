"""Structure that no effect of the catalogue takes: how much, in which channel, as which formula."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from pipeline.core.arrays import Flags, Floats, student_quantile
from pipeline.estimation.acceptance import DECIDED_T, LEAST_TURN_RAD, LEAST_WAY_SHARE, compare_rivals
from pipeline.estimation.comparison import Comparison
from pipeline.estimation.diagnosis import Json, Unexplained
from pipeline.estimation.error_regions import CHANNELS, ERROR_WORDS, format_dependence
from pipeline.estimation.evidence import Evidence
from pipeline.estimation.floor import Makeup, split_residuals, take_own_past
from pipeline.estimation.folds import errors_as_json, find_near
from pipeline.estimation.ladder import judge_whole, lowers_errors
from pipeline.estimation.parts import Part, count_seconds
from pipeline.estimation.search import choose, prune
from pipeline.estimation.selection import CandidateModel, Selection
from pipeline.estimation.terms import (
    bin_features,
    boost,
    is_term,
    join_formula,
    list_terms,
)
from pipeline.models import format_effect
from pipeline.models.formula import FormulaEffect
from pipeline.run import MotionError
from pipeline.run.signals import RunContext
from pipeline.run.windows import HORIZON_S, WINDOW_S

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.estimation import Explored
    from pipeline.estimation.ladder import Judgement

_MOST_TERMS = 3
"""Most terms of a formula: what needs more is no law."""
_EXPLAINABLE = 0.1
"""Share of a channel that trees must predict of unseen stretches to be reported."""
_LAGS_S = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)
"""Moments before now [s] whose inputs trees may use."""
# What drives remember of their commands: changes within a moment, hard ones, reversals; and how long.
_MOMENT_S = 0.5
_HARD = 0.25
"""Share of the largest change from which on a change of command is hard."""
_LONGEST_S = 10.0
"""Longest time since an event that is distinguished [s]."""
LEAST_OF_DRIVE = 0.03
"""Of the motion that was asked for: stamps and steps of encoders come to 0.013 on logs that lack nothing."""
_FOLDS = 4
"""Folds of stretches that trees have not seen."""
_STRETCH_S = 20.0
"""Length of these stretches [s]."""


@dataclass(frozen=True)
class Explainable:
    """What gradient boosting still predicts of a model's residuals on stretches it has not seen.

    Attributes:
        shares: share of the variance of x, y, w that it explains, shape (3,).
        predicted: what it predicts, shape (n, 3).
    """

    shares: Floats
    predicted: Floats


_RESERVE = 8640
"""Shapes for which a formula pays beyond the terms that are tried: for these alone it displaces effects of
the catalogue that are right (a lateral skid, drawn sets, seed 44)."""


def search_formula(selection: Selection, final: CandidateModel) -> CandidateModel:
    """Try formulas where the catalogue has nothing, or where it only imitates one.

    Args:
        selection: where the catalogue's effects were judged.
        final: the best model of them.

    Returns:
        The model with up to three terms, and without effects that only stood for them.
    """
    sideways = selection.part.find_ideal().shape[2] > len(("x", "w"))
    terms = list_terms(sideways=sideways)
    # A formula is the best one of all shapes that were looked at; effects stand for known physics.
    shapes = dict.fromkeys((term.id for term in terms), len(terms) + _RESERVE)
    wide = replace(selection, candidates=terms, shapes=shapes, rivals={})
    current = final
    for _ in range(_MOST_TERMS):
        if wide.budget.is_spent():
            return current
        evidence = wide.take_evidence(current)
        wide.noise = evidence.noise
        moved = _add(wide, current, evidence) or _replace(wide, current, evidence)
        if moved is None:
            return current
        pruned = prune(wide, wide.enter(moved.state))
        if len(collect_terms(pruned)) <= len(collect_terms(current)):
            return current
        current = pruned
    return current


def _add(selection: Selection, current: CandidateModel, evidence: Evidence) -> CandidateModel | None:
    """The model with a term more, where that is significant."""
    best = choose(selection, current, selection.fit_hypotheses(current, evidence))
    return None if best is current else best


def _replace(selection: Selection, current: CandidateModel, evidence: Evidence) -> CandidateModel | None:
    """A term in the place of one effect that only imitates it."""
    for name in [name for name in current.ids if name not in selection.given and not is_term(name)]:
        beside = evidence.without(name)
        # It must do more than the effect itself.
        if max((one.chi_square for one in beside.rank_singles(0.0)), default=0.0) < beside.itself:
            continue
        without = selection.drop(current, [name])
        for rival in selection.fit_hypotheses(without, beside, beside.itself):
            if _is_simpler(selection, current, rival):
                return rival
    return None


def _is_simpler(selection: Selection, current: CandidateModel, rival: CandidateModel) -> bool:
    """Whether one term does what several effects do, or what one does, and significantly better.

    As a term is the best of many, it is compared with an effect on data that neither was fitted to.
    """
    added, dropped = set(rival.ids) - set(current.ids), set(current.ids) - set(rival.ids)
    if len(added) != 1 or selection.loss(rival) >= selection.loss(current):
        return False
    noise = selection.noise or selection.take_evidence(current).noise
    return len(dropped) > 1 or compare_rivals(noise, current.held, rival.held) >= DECIDED_T


def collect_terms(model: CandidateModel) -> list[FormulaEffect]:
    """The terms of a model."""
    return [cast("FormulaEffect", e) for e in model.state.effects if is_term(e.id)]


def boost_residuals(selection: Selection, final: CandidateModel, features: Floats) -> Explainable:
    """Predict a model's residuals from all that was recorded, stretch by stretch unseen.

    Where somebody steers by the pose, what is recorded answers random motion, which lasts for a moment: so
    what counts as structure must also say something of the residuals that their own past does not (the
    prediction error; Ljung, System Identification, section 13.4).

    Args:
        selection: where the model was judged.
        final: the model.
        features: what was recorded, at every window, shape (n, f).
    """
    part = selection.part
    rest = np.clip(selection.weights.weigh(final.held), -6.0, 6.0)
    predicted = _boost(part, rest, features, part.channels)
    shares = _measure_shares(part, rest, predicted)
    seen = [channel for channel in part.channels if shares[channel] > _EXPLAINABLE]
    if seen:
        fresh = take_own_past(part.comparisons, rest)
        significant = _is_significant(part, fresh, _boost(part, fresh, features, seen))
        shares = np.where(significant, shares, np.minimum(shares, 0.0))
    return Explainable(shares, predicted)


def _is_significant(part: Part, rest: Floats, predicted: Floats) -> Flags:
    """Whether predictions are better than none by Student's t over stretches, in each channel, shape (3,)."""
    stretch = part.number_stretches(_STRETCH_S)
    gains = np.where(part.live[:, None], rest**2 - (rest - predicted) ** 2, 0.0)
    driven = np.bincount(stretch, part.live) > 0
    sums = np.array([np.bincount(stretch, gain)[driven] for gain in gains.T])
    count = sums.shape[1]
    if count < 2:  # noqa: PLR2004 - one stretch says nothing of another
        return np.zeros(sums.shape[0], dtype=bool)
    error = sums.std(axis=1, ddof=1) / np.sqrt(count)
    significant: Flags = sums.mean(axis=1) > student_quantile(0.95, count - 1) * error
    return significant


def _measure_shares(part: Part, rest: Floats, predicted: Floats) -> Floats:
    """See `Explainable`."""
    before = (rest[part.live] ** 2).mean(axis=0)
    after = ((rest - predicted)[part.live] ** 2).mean(axis=0)
    shares: Floats = np.where(before > 0.0, 1.0 - after / np.maximum(before, 1e-12), 0.0)
    return shares


def measure_asked(selection: Selection) -> Floats:
    """Motion that was asked for, rms of x, y, w; sideways it is measured by the way forward."""
    ideal = selection.part.find_ideal()[:, 0, :]
    forward, turning, *sideways = np.sqrt((ideal**2).mean(axis=0)).tolist()
    asked: Floats = np.maximum(np.array([forward, max([forward, *sideways]), turning]), 1e-9)
    return asked


def _boost(part: Part, rest: Floats, features: Floats, channels: Sequence[int]) -> Floats:
    """What trees that have not seen a stretch predict of residuals there, shape (n, 3)."""
    bins, stretch = bin_features(features), part.number_stretches(_STRETCH_S)
    predicted = np.zeros(rest.shape)
    for fold in range(_FOLDS):
        test = stretch % _FOLDS == fold
        train = ~test & ~find_near(part, part, test)
        if not test.any() or train.sum() < 50:  # noqa: PLR2004 - too few to learn from
            continue
        for channel in channels:
            predicted[test, channel] = boost(bins[train], rest[train, channel], bins[test])
    return predicted


def is_explainable(explainable: Explainable) -> bool:
    """Whether enough of any channel is predictable to be called structure."""
    return bool((explainable.shares > _EXPLAINABLE).any())


def list_window_signals(comparisons: Sequence[Comparison]) -> tuple[Floats, tuple[str, ...]]:
    """Everything recorded, at the middle of every window.

    Returns:
        Features of shape (n, f), and their names with units: ``roll [rad]``; without one where there is none.
    """
    parts = [_list_signals(comparison) for comparison in comparisons]
    return np.concatenate([part[0] for part in parts]), parts[0][1]


def _list_signals(comparison: Comparison) -> tuple[Floats, tuple[str, ...]]:
    from pipeline.models.model import Timing  # noqa: PLC0415 - only here

    context, grid = comparison.context, comparison.grid
    velocity = comparison.predict_velocity((), Timing())
    at = comparison.windows.times.mean(axis=1)
    vehicle = context.vehicle
    columns: dict[str, Floats] = {}
    for late in _LAGS_S:
        columns[f"v_x {late:g} s ago [m/s]"] = np.interp(at - late, context.times, velocity.x)
        columns[f"v_w {late:g} s ago [rad/s]"] = np.interp(at - late, context.times, velocity.w)
        if vehicle.kinematics.has_inputs("sideways"):
            columns[f"v_y {late:g} s ago [m/s]"] = np.interp(at - late, context.times, velocity.y)
    x, y, yaw = (np.interp(at, context.times, column) for column in context.from_start.T)
    for times, name in ((1.0, "yaw"), (2.0, "2 yaw")):
        columns[f"sin {name} since the start"] = np.sin(times * yaw)
        columns[f"cos {name} since the start"] = np.cos(times * yaw)
    for index, name in enumerate(("roll", "pitch")):
        now, before = (
            np.interp(at - late, context.times, context.attitude[:, index]) for late in (0.0, _MOMENT_S)
        )
        columns |= {f"{name} [rad]": now, f"change of {name} in {_MOMENT_S:g} s [rad]": now - before}
    columns |= {"x ahead of the start [m]": x, "y left of the start [m]": y}
    half = 0.5 * context.track_m * velocity.w if vehicle.kind == "differential" else 0.0 * velocity.w
    for name, rim in (("left", velocity.x - half), ("right", velocity.x + half)):
        angle = np.cumsum(rim) * grid.step_s / vehicle.wheel_radius_m
        for word, wave in (("sin", np.sin(angle)), ("cos", np.cos(angle))):
            columns[f"{word} {name} wheel [m/s]"] = _average(rim * wave, at, comparison)
        columns[f"time since the {name} wheel reversed [s]"] = _age(at, context, _find_reversals(rim))
    for name, unit, signal in (("v_x", "m/s", velocity.x), ("v_w", "rad/s", velocity.w)):
        before = np.interp(context.times - _MOMENT_S, context.times, signal)
        gained = np.abs(signal) - np.abs(before)
        columns[f"change of |{name}| in {_MOMENT_S:g} s [{unit}]"] = np.interp(at, context.times, gained)
        hard = np.abs(signal - before) > _HARD * np.abs(signal).max()
        columns[f"time since {name} changed hard [s]"] = _age(at, context, hard)
    columns["way driven [m]"] = np.interp(at, context.times, np.cumsum(np.abs(velocity.x)) * grid.step_s)
    columns["time [s]"] = at
    return np.column_stack(list(columns.values())), tuple(columns)


def _find_reversals(rim: Floats) -> Flags:
    """Where a wheel goes the other way than it last went."""
    direction = np.sign(rim)
    last = np.maximum.accumulate(np.where(direction != 0.0, np.arange(direction.size), 0))
    reversed_: Flags = direction * direction[np.append(0, last[:-1])] < 0.0
    return reversed_


def _age(at: Floats, context: RunContext, events: Flags) -> Floats:
    """Seconds since the last event, at most `_LONGEST_S`."""
    happened = context.times[events]
    number = np.searchsorted(happened, at, side="right")
    age: Floats = np.minimum(at - np.append(-np.inf, happened)[number], _LONGEST_S)
    return age


def _average(signal: Floats, at: Floats, comparison: Comparison) -> Floats:
    grid = comparison.grid
    total = np.asarray(grid.sum_up(signal), dtype=np.float64)
    edges = np.arange(total.size)
    ends = [np.interp(grid.locate_edges(at + half), edges, total) for half in (-0.25, 0.25)]
    return (ends[1] - ends[0]) / 0.5


def find_places(comparisons: Sequence[Comparison]) -> Floats:
    """Where the vehicle was at the middle of every window of runs: x, y in the map [m], shape (n, 2)."""
    middles = [(comparison.windows.times.mean(axis=1), comparison.run.track) for comparison in comparisons]
    places = [np.array([np.interp(at, t.times, column) for column in t.position.T]).T for at, t in middles]
    return np.concatenate(places)


_BINS = 8
"""Bins of a dependence that is put in words."""
_PART = 0.3
"""Share of the largest channel from which on another is reported, too."""
# What lasts is structure where it is much of the residual, and of the motion that was asked for.
_LEAST_SHARE = 0.5
_LEAST_OF_MOTION = 0.05
"""Share of the motion below which structure is not reported."""
_LEAST_REPEAT = 0.28
"""Correlation of a residual with itself a window later from which on it lasts."""
_FEWEST_WINDOWS = 200
"""Windows that trees need."""
_SURE = 2.0
"""Standard errors by which a repeat must be above the least."""
_WORDS = {
    "wheels": "the wheels deviate from the model for seconds at a time",
    "body": "the motion deviates from the model for seconds at a time",
}
_BEYOND = ", and no term that was tried predicts it"


def describe(paths: Sequence[Explored], judgement: Judgement | None, lead: str = "") -> Unexplained | None:
    """Structure that no effect takes; None where there is none.

    Args:
        paths: that were explored.
        judgement: of the effects; None where they could not be judged.
        lead: what the residual of the final model points to, see `conclude`; empty where to nothing.

    Returns a formula where one was found, as a suggestion: no model holds it. Else the larger, against the
    motion that was asked for, of what can be predicted from what was recorded and of motion that lasts though
    nothing that was recorded tells of it.
    """
    body = paths[0]
    selection, final = body.search.selection, body.search.final
    causes: list[tuple[float, Unexplained]] = []
    if terms := collect_terms(final):
        without = selection.drop(final, [term.id for term in terms])
        share = 1.0 - selection.weights.loss(final.held) / selection.weights.loss(without.held)
        signal = without.fit.residual - final.fit.residual
        described = _name_signal(body, signal, share)
        if judgement is not None and (suggested := _suggest(judgement, join_formula(terms))):
            return replace(described, formula=suggested[0], reached=suggested[1])
        # Without a formula it is one cause of several, and the share that of one channel.
        channel = CHANNELS.index(described.channel)
        before, after = (float((one.held[:, channel] ** 2).mean()) for one in (without, final))
        causes += _weigh(body, signal, replace(described, share=1.0 - after / before))
    for path in paths:
        known, lasting = _find_explainable(path), _find_lasting(path, lead)
        causes += known
        # What can be predicted is not said to be motion that nothing predicts.
        if lasting is not None and all(one.channel != lasting[1].channel for _, one in known):
            causes.append(lasting)
    return max(causes, key=lambda item: item[0])[1] if causes else None


def _suggest(judgement: Judgement, formula: FormulaEffect) -> tuple[str, Mapping[str, Json]] | None:
    """A formula as text of a model file, and the errors of the model with it; None where it is no help."""
    model = judgement.fitted.model + formula
    with suppress(MotionError):
        step = judge_whole(judgement.problem, model)
        if lowers_errors(judgement.whole.errors, step.errors):
            reached = cast("Mapping[str, Json]", errors_as_json(step.errors))
            return format_effect(step.fitted.model.effect(formula.id)), reached
    return None


def is_felt(channel: str, size: float, part: float) -> bool:
    """Whether a planner feels a push of this rms over two seconds: least sizes are those of effects.

    Args:
        channel: x, y or w.
        size: [m/s] or [rad/s].
        part: of the motion that was asked for in that channel.
    """
    return size * HORIZON_S >= LEAST_TURN_RAD if channel == "w" else part >= LEAST_WAY_SHARE


def _find_explainable(path: Explored) -> list[tuple[float, Unexplained]]:
    """What can be predicted from what was recorded, with its size against the motion asked for, if any."""
    explainable = path.explainable
    if explainable is None or not is_explainable(explainable):
        return []
    selection = path.search.selection
    signal = explainable.predicted * np.where(explainable.shares > 0.0, selection.weights.scale, 0.0)
    cause = _name_signal(path, signal, 0.0)
    channel = CHANNELS.index(cause.channel)
    return _weigh(path, signal, replace(cause, share=float(explainable.shares[channel])))


def _weigh(path: Explored, signal: Floats, cause: Unexplained) -> list[tuple[float, Unexplained]]:
    """A cause with the size of its push against the motion asked for; empty where nobody feels it."""
    channel = CHANNELS.index(cause.channel)
    size = float(np.sqrt((signal[:, channel] ** 2).mean()))
    part = size / float(measure_asked(path.search.selection)[channel])
    # Encoders have next to no noise: what their stamps and steps make of nothing can be predicted, too.
    least = LEAST_OF_DRIVE if path.search.path == "wheels" else 0.0
    return [(part, cause)] if part >= least and is_felt(cause.channel, size, part) else []


def _name_signal(body: Explored, signal: Floats, share: float) -> Unexplained:
    """What a push of x, y, w at every window depends on most."""
    sizes = np.sqrt(((signal / body.search.selection.weights.scale) ** 2).mean(axis=0))
    channel = int(np.argmax(sizes))
    name, table = _depend(body, signal[:, channel])
    every = tuple(CHANNELS[i] for i in np.argsort(-sizes) if sizes[i] > _PART * sizes[channel])
    unit = _unit(channel)
    whose = " of the wheels" if body.search.path == "wheels" else ""
    where = format_dependence(ERROR_WORDS[CHANNELS[channel]] + whose, unit, name, table)
    partial: Mapping[str, Json] = {
        "of": name.partition(" [")[0],
        "unit": unit,
        "table": [{"at": round(at, 6), "mean_error": round(mean, 6)} for at, mean in table],
    }
    return Unexplained(share, CHANNELS[channel], every, where, None, partial, body.search.path)


def _find_lasting(path: Explored, lead: str) -> tuple[float, Unexplained] | None:
    """Motion that lasts longer than noise and random motion do, and its size against the motion asked for."""
    held = path.search.final.held
    if held.shape[0] < _FEWEST_WINDOWS:
        return None
    shares, repeats = _share_lasting(path)
    sizes = np.sqrt(shares * (held**2).mean(axis=0))
    parts = sizes / measure_asked(path.search.selection)
    # Standard error of a correlation, of windows of half a second that do not overlap (Bartlett 1946).
    error = 1.0 / math.sqrt(count_seconds(path.search.selection.part).sum() / WINDOW_S)
    sure = np.where((shares >= _LEAST_SHARE) & (repeats - _SURE * error >= _LEAST_REPEAT), parts, 0.0)
    channel = int(np.argmax(sure))
    if sure[channel] < _LEAST_OF_MOTION:
        return None
    # Where one channel has a cause that nobody knows, less evidence says that another has its share of it.
    lasts = (shares >= 0.5 * _LEAST_SHARE) & (repeats >= 0.5 * _LEAST_REPEAT) & (parts >= _LEAST_OF_MOTION)
    every = tuple(CHANNELS[i] for i in np.argsort(-parts) if lasts[i])
    significant = [
        f"{sizes[i]:.2g} {_unit(i)} in {ERROR_WORDS[CHANNELS[i]]}" for i in np.flatnonzero(lasts).tolist()
    ]
    words = _WORDS.get(path.search.path, _WORDS["body"])
    where = f"{words}{'' if lead else _BEYOND}: {', '.join(significant)}{lead and f'; {lead}'}"
    cause = Unexplained(float(shares[channel]), CHANNELS[channel], every, where, None, {}, path.search.path)
    return float(parts[channel]), cause


def _share_lasting(path: Explored) -> tuple[Floats, Floats]:
    """Of x, y, w: share of the residual's variance that lasts, and correlation over one to two seconds."""
    makeup = _split(path)
    seen = np.isin(np.arange(3), path.search.selection.part.channels)
    shares = np.array([part.lasting_share for part in makeup])
    # Random motion that is forgotten within half a second repeats itself by 0.1 over that time.
    repeats = np.array([part.correlation[1:4].mean() for part in makeup])
    return np.where(seen, shares, 0.0), np.where(seen, repeats, 0.0)


def _split(path: Explored) -> tuple[Makeup, Makeup, Makeup]:
    return split_residuals(path.search.selection.part.comparisons, path.search.final.held)


def _unit(channel: int) -> str:
    return "rad/s" if CHANNELS[channel] == "w" else "m/s"


def summarize_disturbance(body: Explored, text: str) -> dict[str, Json]:
    """What is left of x, y, w, divided by how long it lasts, with a sentence on it.

    ``rms`` [m/s, m/s, rad/s]; ``lasting``: the part of it that lasts for seconds; ``pose_noise`` [m, m, rad]:
    error of single poses that would make the rest of neighbouring windows as opposite as it is; and
    ``neighbours``: correlation of windows half a second apart, -0.5 for noise of poses.
    """
    held, makeup = body.search.final.held, _split(body)
    rms = np.sqrt((held**2).mean(axis=0))
    return {
        "rms": [round(float(value), 6) for value in rms],
        "lasting": [
            round(float(value) * math.sqrt(part.lasting_share), 6)
            for value, part in zip(rms, makeup, strict=True)
        ],
        "pose_noise": [round(part.pose_noise, 6) for part in makeup],
        "neighbours": [round(float(part.correlation[0]), 3) for part in makeup],
        "text": text,
    }


def _depend(body: Explored, signal: Floats) -> tuple[str, list[tuple[float, float]]]:
    """The recorded signal that a push depends on most, and its mean by value."""
    features, names = list_window_signals(body.search.selection.part.comparisons)
    best, name, table = -1.0, names[0], [(0.0, 0.0)]
    for column, label in zip(features.T, names, strict=True):
        edges = np.unique(np.quantile(column, np.linspace(0.0, 1.0, _BINS + 1)))
        if edges.size < 3:  # noqa: PLR2004 - it does not vary
            continue
        index = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, edges.size - 2)
        count = np.bincount(index, minlength=edges.size - 1)
        mean = np.bincount(index, signal, minlength=edges.size - 1) / np.maximum(count, 1)
        ratio = float(np.sum(count * (mean - signal.mean()) ** 2)) / max(float(np.sum(signal**2)), 1e-18)
        if ratio > best:
            middle = np.bincount(index, column, minlength=edges.size - 1) / np.maximum(count, 1)
            best, name = ratio, label
            table = [(float(a), float(b)) for a, b, c in zip(middle, mean, count, strict=True) if c]
    return name, table
