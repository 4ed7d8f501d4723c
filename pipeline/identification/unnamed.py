"""Numbers of effects that a model lacks: what adding each would make of it, to first order.

That an effect is not named in a run is no number, and setting runs side by side needs one: the estimate that
one step of the joint fit gives the effect, with the error that not knowing the others' numbers leaves it.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.identification.fit import Fitted, PartFit, solve_step
from pipeline.identification.intervals import Estimate, estimate_part, join_blocks
from pipeline.identification.parts import Part
from pipeline.models.effect import Effect


def estimate_unnamed(fitted: Fitted, candidates: Iterable[Effect]) -> tuple[Estimate, ...]:
    """Estimates of effects beside a fitted model, each added to it alone.

    Left out are effects that the model has, that do not act on its input, whose numbers derivatives do not
    find, and numbers that the runs do not move with or leave anywhere within their bounds.

    Args:
        fitted: a converged fit.
        candidates: effects at neutral values.
    """
    found: list[Estimate] = []
    labels = [join_blocks(part, fit) for part, fit in zip(fitted.problem.parts, fitted.fits, strict=True)]
    for effect in candidates:
        if effect.id in fitted.model or not all(math.isfinite(p.neutral) for p in effect.parameters):
            continue
        for part, fit, label in zip(fitted.problem.parts, fitted.fits, labels, strict=True):
            if part.owns(effect):
                found += _estimate_added(part, fit, label, effect)
                break
    return tuple(found)


def _estimate_added(part: Part, fit: PartFit, label: Ints, effect: Effect) -> list[Estimate]:
    added = fit.state.add(effect)
    new = tuple(n for n in part.list_free(added) if n.effect == effect.id)
    if not all(number.is_smooth for number in new):
        return []
    columns = part.differentiate(added, fit.residual, new)
    grown = PartFit(
        added,
        (*fit.free, *new),
        fit.residual,
        np.concatenate((fit.jacobian, columns), axis=2),
        fit.weights,
        fit.loss,
    )
    step, _ = solve_step(grown.jacobian, grown.residual, grown.weights)
    made = {item.free: item for item in estimate_part(part, grown, step, label).items}
    if not all(made[number].observable for number in new):
        return []
    return [replace(made[number], at_bound=False) for number in new if math.isfinite(made[number].low)]
