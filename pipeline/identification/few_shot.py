"""A model fitted to little driving, with what is known of its numbers before."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

from pipeline.identification.fit import fit_model
from pipeline.identification.intervals import count_repeats
from pipeline.identification.prior import Prior

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pipeline.identification.fit import Fitted
    from pipeline.identification.problem import Problem
    from pipeline.models.model import Model

_ROUNDS = 2


def tie_to_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Problem:
    """The problem with a prior on the model's numbers.

    How often residuals repeat each other is read from those of the fit itself, which is repeated with it.

    Args:
        problem: the runs.
        model: its effects start from their values.
        numbers: mean and standard deviation by label ``effect.name``.

    Returns:
        The runs made ready once, shared with `problem`, with the prior in every part.
    """
    tied = _tie(problem, [Prior(numbers)] * len(problem.parts))
    for _ in range(_ROUNDS):
        fitted = fit_model(tied, model)
        repeats = [count_repeats(part, fit) for part, fit in zip(tied.parts, fitted.fits, strict=True)]
        tied = _tie(problem, [Prior(numbers, count) for count in repeats])
    return tied


def fit_with_prior(problem: Problem, model: Model, numbers: Mapping[str, tuple[float, float]]) -> Fitted:
    """Fit a model with a prior on its numbers; see `tie_to_prior`."""
    return fit_model(tie_to_prior(problem, model, numbers), model, exact=True)


def _tie(problem: Problem, priors: list[Prior]) -> Problem:
    tied = copy(problem)
    for name in ("behind_wheels", "folds", "training"):
        tied.__dict__.pop(name, None)
    parts = [copy(part) for part in problem.parts]
    for part, prior in zip(parts, priors, strict=True):
        part.prior = prior
    tied.parts = tuple(parts)
    if problem.whole is problem.parts[0]:
        tied.whole = parts[0]
    return tied
