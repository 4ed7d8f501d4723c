"""Acceptance tests for a larger model: evidence, stability, plausibility and effect size."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import format_share, suffix_unit
from pipeline.core.arrays import Floats, robust_spreads
from pipeline.estimation.ladder import Judgement, LadderStep, compare_losses, judge_whole, raises_errors
from pipeline.estimation.parts import CLIP, count_seconds
from pipeline.models.effect import Effect, Parameter
from pipeline.models.parameter import EXCEEDED_SHARE, OVERSHOOT, Conditions
from pipeline.run import MotionError

if TYPE_CHECKING:
    from pipeline.estimation.comparison import Input
    from pipeline.estimation.evidence import Noise
    from pipeline.estimation.parts import Part
    from pipeline.estimation.problem import Problem
    from pipeline.estimation.state import Weights
    from pipeline.models import Model

_AT_BOUND = 1e-3
"""Fraction of a parameter's range; a value closer than this to a bound is at the bound."""
# A limit's interval is not known during a search: in a 30 s run it may end at this multiple of the value.
_UNCERTAIN = 1.5
HALVES = 0.5
"""Fraction of the loss of all plausible models to which an effect outside its observed range must reduce it:
an effect that halves an error is reported, as a stand-in."""


def is_nameable(effect: Effect, conditions: Conditions, *, as_if: bool = False) -> bool:
    """Whether an effect is large enough to report, plausible and not a degenerate form of another effect.

    Args:
        effect: with its values.
        conditions: what the runs can show.
        as_if: allow values outside the observed range, as long as the recordings determine them.
    """
    itself = _has_its_sign(effect) and not effect.is_degenerate(conditions)
    if not itself or not is_large_enough(effect, conditions):
        return False
    highs = {name: _UNCERTAIN * value for name, value in effect.values.items()}
    if find_exceeded(effect, highs, conditions.exceeded) is not None:
        return False
    return find_implausible(effect) is None or (as_if and find_beyond(effect) is not None)


def is_large_enough(effect: Effect, conditions: Conditions) -> bool:
    """Whether an effect exceeds the errors of time stamps, sensor mounting and data sheets."""
    sizes = []
    for parameter in effect.parameters:
        if parameter.least is not None:
            least, size = parameter.least, abs(effect.values[parameter.name] - parameter.neutral)
            sizes.append(size >= max(least.size, least.sampled * conditions.least_delay_s))
    return not sizes or any(sizes)


def _has_its_sign(effect: Effect) -> bool:
    """Whether every parameter with only one physical sign has that sign."""
    return all(effect.values[p.name] > p.neutral for p in effect.parameters if p.one_sign)


def _is_at_bound(value: float, parameter: Parameter) -> bool:
    """Whether a value is at a bound of its parameter; the neutral value never counts as at a bound."""
    if value == parameter.neutral:
        return False
    low, high = parameter.bounds
    margin = _AT_BOUND * (high - low) if math.isfinite(high - low) else 0.0
    return value <= low + margin < parameter.neutral or value >= high - margin > parameter.neutral


def find_exceeded(effect: Effect, highs: Mapping[str, float], exceeded: Mapping[str, float]) -> str | None:
    """Sentence stating that measured wheels exceed a limit; None where they stay within it.

    Args:
        effect: with its values.
        highs: upper end of the interval by parameter, NaN where there is none.
        exceeded: what measured wheels exceed in `EXCEEDED_SHARE` of the time, see `Conditions`.
    """
    for parameter in effect.parameters:
        most = exceeded.get(parameter.relative_to)
        value, high = effect.values[parameter.name], highs.get(parameter.name, math.nan)
        if most is not None and most > OVERSHOOT * max(value, float(np.nan_to_num(high))):
            return (
                f"{effect.id}: {parameter.name} = {value:.3g} {parameter.unit} is not a limit: the measured "
                f"wheels exceed {most:.3g} {parameter.unit} in {format_share(EXCEEDED_SHARE)} of the time; "
                "the cause may be another effect"
            )
    return None


def find_beyond(effect: Effect) -> str | None:
    """Clause listing values outside the observed range; None where there are none or one is at its bound."""
    reasons = []
    for parameter in effect.parameters:
        value, shown = effect.values[parameter.name], parameter.plausible
        if not math.isfinite(value):
            continue
        if _is_at_bound(value, parameter):
            return None
        if shown is not None and not shown.low <= value <= shown.high:
            unit = suffix_unit(parameter.unit)
            reasons.append(
                f"{parameter.name} = {value:.3g}{unit} is outside the observed range "
                f"({shown.low:g} to {shown.high:g}{unit}, {shown.source})"
            )
    return "; ".join(reasons) or None


def find_implausible(effect: Effect) -> str | None:
    """Sentence stating the first value outside the observed range; None where all values are plausible."""
    for parameter in effect.parameters:
        value = effect.values[parameter.name]
        if not math.isfinite(value):
            continue
        shown = parameter.plausible
        low, high = parameter.bounds if shown is None else (shown.low, shown.high)
        if not low <= value <= high or _is_at_bound(value, parameter):
            unit = suffix_unit(parameter.unit)
            return (
                f"{effect.id}: {parameter.name} = {value:.3g}{unit} is outside the observed range "
                f"({low:g} to {high:g}{unit}); the cause may be another effect"
            )
    return None


LEAST_T = 5.0
"""Significance threshold [standard errors] for reporting an effect: the largest t of some 30 candidates on
logs without any effect stays below it (`make bench NAME=game/play`, category `empty`)."""
STABLE_T = 0.5 * LEAST_T
"""Evidence required without the ten seconds that contribute most: one event is not enough."""
LEAST_GAIN = 0.01
"""Fraction of the loss that an effect must remove: a smaller gain does not matter in a prediction."""
DECIDED_T = 2.0
"""Standard errors by which one of two rivals must be better for the choice to be significant."""
_CLUSTER = 4
"""Windows of half a second in a cluster of correlated scores: two seconds."""


@dataclass(frozen=True)
class Improvement:
    """How much better a larger model is.

    Attributes:
        t: evidence for its additional parameters, in standard errors.
        t_stable: the same without the ten-second stretch that contributes most.
        gain: share of the smaller model's loss that it removes.
    """

    t: float
    t_stable: float
    gain: float

    @property
    def share(self) -> float:
        """Evidence as a fraction of the required evidence."""
        return min(self.t / LEAST_T, self.t_stable / STABLE_T)

    @property
    def reached(self) -> float:
        """Evidence and gain, the smaller one as a fraction of what is required."""
        return min(self.share, self.gain / LEAST_GAIN)

    @property
    def is_significant(self) -> bool:
        """Whether the improvement is significant, stable over the run and large enough to matter."""
        return self.reached >= 1.0


NEARLY = 0.5
"""Share of the significance threshold below which an effect is neither told nor a condition on others."""


@dataclass(frozen=True)
class NotSignificant:
    """An effect that nearly has the required evidence and gain.

    Attributes:
        effect: with its values when added to the final model of the search.
        gain: share of the loss that it removes.
        evidence: share of the significance threshold, see `Improvement.reached`.
    """

    effect: Effect
    gain: float
    evidence: float


def compare(
    noise: Noise,
    weights: Weights,
    before: Floats,
    after: Floats,
    *,
    numbers: int = 1,
    shapes: int = 1,
    restarted: tuple[Floats, Floats] | None = None,
) -> Improvement:
    """Compare two models, the second of which has more parameters.

    Innovations under one noise model are compared. Their variance may differ between stretches, since a
    stationary vehicle is quieter than a turning one (White, Econometrica 48, 1980).

    Args:
        noise: of the residuals.
        weights: of the loss.
        before: residuals of the first model, shape (n, 3).
        after: of the second one.
        numbers: number of additional parameters of the second.
        shapes: number of candidates that the second was selected from; the evidence is reduced accordingly.
        restarted: residuals of both with states reset to measured ones at each prediction, which the gain
            counts as well.
    """
    by_stretch = measure_evidence(noise, before, after)
    total = float(by_stretch.sum())
    free = max(numbers - 1, 0) + 2.0 * math.log(shapes)
    stable = total - float(by_stretch.max(initial=0.0))
    pairs = ((before, after), *((restarted,) if restarted else ()))
    old, new = (sum(map(weights.loss, residuals)) for residuals in zip(*pairs, strict=True))
    gain = 1.0 - new / max(old, 1e-300)
    return Improvement(math.sqrt(max(total - free, 0.0)), math.sqrt(max(stable - free, 0.0)), gain)


def measure_evidence(noise: Noise, before: Floats, after: Floats) -> Floats:
    """Chi-square by which the second model is better, per ten-second stretch, shape (b,)."""
    new, spread = find_innovations(noise, after)
    old, new = noise.whiten_residual(before) / spread, new / spread
    rows = (_cost(old) - _cost(new)).sum(axis=1)
    unit = np.unique(noise.tiles.unit, return_inverse=True)[1]
    held = np.clip(new, -CLIP, CLIP)
    evidence: Floats = np.bincount(unit, rows) / _find_inflation(np.clip(old, -CLIP, CLIP) - held, held)
    return evidence


def find_innovations(noise: Noise, residual: Floats) -> tuple[Floats, Floats]:
    """Innovations of a model and their scale by channel, as `measure_evidence` uses them.

    Args:
        noise: of the residuals.
        residual: of the model, shape (n, 3).

    Returns:
        Innovations at the tiles, shape (k, c), and their scale, shape (c,).
    """
    innovations = noise.whiten_residual(residual)
    # Innovations of a model far from the truth exceed the noise and then set the scale.
    return innovations, np.maximum(robust_spreads(innovations), 1.0)


def scale_evidence(innovations: Floats, spread: Floats, column: Floats) -> Floats:
    """Innovations that an effect adds to a model, in the standard errors of `measure_evidence`.

    Args:
        innovations: of the model, shape (k, c).
        spread: their scale, see `find_innovations`.
        column: change by the effect at the tiles, whitened, shape (k, c).
    """
    moved = column / spread
    scaled: Floats = moved / math.sqrt(_find_inflation(moved, np.clip(innovations / spread, -CLIP, CLIP)))
    return scaled


def _find_inflation(moved: Floats, innovations: Floats) -> float:
    """Variance inflation of a change of innovations relative to independent innovations."""
    clusters = _add_clusters((moved * innovations).sum(axis=1))
    return max(float(clusters @ clusters) / max(float((moved**2).sum()), 1e-300), 1.0)


def grow_evidence(part: Part, noise: Noise, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Growth of the t of `compare` with driving time, at the ends of ten-second stretches.

    Returns:
        Seconds of windows until the end of each stretch, and t at that time; both of shape (b,).
    """
    units = np.unique(noise.tiles.unit)
    ends = np.searchsorted(part.unit, units, side="right") - 1
    seconds = np.cumsum(count_seconds(part))[ends]
    total = np.cumsum(measure_evidence(noise, before, after))
    return seconds, np.sqrt(np.maximum(total, 0.0))


def _cost(values: Floats) -> Floats:
    """Huber's loss of innovations."""
    size = np.abs(values)
    held = np.minimum(size, CLIP)
    return np.asarray(held * (2.0 * size - held), dtype=np.float64)


def compare_rivals(noise: Noise, one: Floats, other: Floats) -> float:
    """Standard errors by which the second of two non-nested models is better.

    Source: Vuong, Econometrica 57 (1989).

    Args:
        noise: of the residuals.
        one: residuals of the first model, shape (n, 3).
        other: of the second one.
    """
    old, new = noise.whiten_residual(one), noise.whiten_residual(other)
    rows = (_cost(old) - _cost(new)).sum(axis=1)
    spread = math.sqrt(float((_add_clusters(rows) ** 2).sum()))
    return float(rows.sum()) / spread if spread > 0.0 else 0.0


def _add_clusters(rows: Floats) -> Floats:
    """Sums over clusters of two seconds of windows."""
    whole = rows.size // _CLUSTER * _CLUSTER
    return np.append(rows[:whole].reshape(-1, _CLUSTER).sum(axis=1), rows[whole:])


# Whether an effect matters: how far it changes a planner's prediction over 2 s.
#
# An effect is reported if a prediction without it is noticeably worse. In long, quiet recordings effects of
# millimetres are significant, too: they are listed separately.

LEAST_WAY_SHARE = 0.005
"""Fraction of the distance driven in 2 s: half a 5 cm cell after 5 m. The sample logs hide 2.6 % or more."""
LEAST_TURN_RAD = 0.0025
"""Heading change over 2 s [rad]: a quarter of such a cell beside the path after 5 m."""


def format_threshold() -> str:
    """The detection threshold as text."""
    return f"{format_share(LEAST_WAY_SHARE)} of the distance or {LEAST_TURN_RAD * 1e3:g} mrad (rms)"


@dataclass(frozen=True)
class Moves:
    """RMS change of predictions over 2 s by an effect.

    Attributes:
        position_m: distance [m].
        heading_rad: turn [rad].
        path_share: the distance as a share of the predicted distance.
    """

    position_m: float
    heading_rad: float
    path_share: float

    @property
    def is_material(self) -> bool:
        """Whether the effect reaches the detection threshold."""
        return self.path_share >= LEAST_WAY_SHARE or self.heading_rad >= LEAST_TURN_RAD


def measure_moves(judgement: Judgement, effect: Effect) -> Moves | None:
    """Change of a fitted model's predictions by one of its effects; None where the model lacks the effect.

    The other effects keep their values, although one of them might compensate in a new fit. Rare large
    changes, as of a limit, count by their square.
    """
    state = judgement.fitted.state
    if effect.id not in state.ids:
        return None
    shifts = [
        comparison.find_horizon_shifts(
            state.effects_of(run),
            [other for other in state.effects_of(run) if other.id != effect.id],
            state.timing[run],
        )
        for run, comparison in enumerate(judgement.problem.comparisons)
    ]
    distance, turn, length = (
        float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in zip(*shifts, strict=True)
    )
    return Moves(distance, turn, distance / length if length > 0.0 else 0.0)


def find_idle(
    model: Model,
    problems: Mapping[Input, Problem],
    duties: Mapping[str, Collection[Input]],
    drive: Collection[str],
    written: Collection[str] = (),
) -> list[str]:
    """Effects that raise the 2 s errors, and those of the drivetrain that reduce no error.

    They are taken out one by one, the one that raises the errors most first: without it others may be needed,
    or help no longer.

    Args:
        model: with all effects.
        problems: the runs by input; what cannot be fitted from an input is not judged from it.
        duties: inputs from which an effect must serve predictions, by id; others stay.
        drive: ids of the effects of the drivetrain.
        written: ids of effects that may not raise the errors from the first input either, that of the model
            that is written.
    """
    idle, leading = list[str](), next(iter(problems))
    while rest := [name for name in duties if name not in idle]:
        part, raised = model.keep(name for name in model.ids if name not in idle), dict[str, float]()
        for source, problem in problems.items():
            with suppress(MotionError):
                whole = judge_whole(problem, part)
                for name in (one for one in rest if one in whole.effects):
                    must_serve = source in duties[name]
                    if not must_serve and not (source is leading and name in written):
                        continue
                    with suppress(MotionError):
                        without = whole.drop(name)
                        if (
                            _is_idle(whole, without, is_of_drive=name in drive)
                            if must_serve
                            else raises_errors(without.errors, whole.errors)
                        ):
                            size = math.prod(whole.errors.ratios(without.errors)[3:])
                            raised[name] = max(raised.get(name, 0.0), size)
        if not raised:
            break
        idle.append(max(raised, key=raised.__getitem__))
    return idle


def _is_idle(step: LadderStep, below: LadderStep, *, is_of_drive: bool) -> bool:
    """Whether an effect raises the 2 s errors, or one of the drivetrain lowers no error by `LEAST_GAIN`."""
    reached = step.errors.ratios(below.errors)[3:]
    if raises_errors(below.errors, step.errors) or math.sqrt(math.prod(reached)) > 1.0 + LEAST_GAIN:
        return True
    return is_of_drive and min(compare_losses(step.held_out, below.held_out), *reached) > 1.0 - LEAST_GAIN


def project_out(own: Floats, column: Floats) -> Floats:
    """Component of a column, shape (k, c), orthogonal to the model's own columns, shape (k, c, p)."""
    if not own.shape[2]:
        return column
    flat = own.reshape(-1, own.shape[2])
    solution = np.linalg.lstsq(flat, column.reshape(-1), rcond=1e-8)[0]
    residual: Floats = (column.reshape(-1) - flat @ solution).reshape(column.shape)
    return residual
