"""A model fitted to little driving, with what is known of its numbers before."""

from collections.abc import Mapping
from copy import copy

import numpy as np

from pipeline.identification.fit import Fitted, PartFit, fit_model
from pipeline.identification.intervals import SHORTEST_TIME_S, count_repeats
from pipeline.identification.parts import BodyPart, Part
from pipeline.identification.prior import Prior
from pipeline.identification.problem import Problem
from pipeline.models.model import Model


def tie_to_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Problem:
    """The problem with a prior on the model's numbers.

    How much less residuals know than they say is read from the fit without the prior: a prior that the runs
    contradict leaves more of them, and would weigh itself up by it.

    Args:
        problem: the runs.
        model: its effects start from their values.
        numbers: mean and standard deviation by label ``effect.name``.

    Returns:
        The runs made ready once, shared with `problem`, with the prior in every part.
    """
    alone = fit_model(problem, model)
    excess = [measure_excess(part, fit) for part, fit in zip(problem.parts, alone.fits, strict=True)]
    return _tie(problem, [Prior(numbers, one) for one in excess])


def fit_with_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Fitted:
    """Fit a model with a prior on its numbers; see `tie_to_prior`."""
    return fit_model(tie_to_prior(problem, model, numbers), model, exact=True)


def measure_excess(part: Part, fit: PartFit) -> float:
    """By how much the summed cost of residuals says more than they know.

    Residuals repeat each other: by the time in which they do over the distance of two. That time is taken
    from the residuals, and no shorter than that of the shortest blocks of `intervals.join_blocks`, since a
    few seconds cannot show it. And they are larger than the spreads that they are weighed by where the model
    leaves more than noise: by their mean square in these units.
    """
    live = fit.residual[part.live] if part.live.any() else fit.residual
    scale = fit.weights.scale[part.live] if part.live.any() else fit.weights.scale
    squares = np.mean((live / scale)[:, list(part.channels)] ** 2)
    distance = float(np.median(np.diff(part.times.mean(axis=1))))
    repeats = max(count_repeats(part, fit), SHORTEST_TIME_S / max(distance, 1e-3))
    count = live.shape[0] * len(part.channels) / repeats
    freedom = max(count - len(fit.free), 1.0)
    return float(repeats * max(float(squares) * count / freedom, 1.0))


def _tie(problem: Problem, priors: list[Prior]) -> Problem:
    parts = tuple(copy(part) for part in problem.parts)
    for part, prior in zip(parts, priors, strict=True):
        part.prior = prior
    body = parts[0]
    whole = body if problem.whole is problem.parts[0] and isinstance(body, BodyPart) else problem.whole
    return problem.with_parts(whole, parts)
