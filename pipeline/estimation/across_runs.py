"""Across runs and grounds: fits with a prior from other runs.

A joint fit of one model to many runs has noise of the same kind in all of them, and of each run's own size
(`noise.Noise`): a gentle run counts as much as a fast one, whose residuals are larger by a factor of ten.
Runs on other grounds than the requested one may count less (`path_residuals.weigh_runs`).

A ground parameter has one value per ground, shared by the runs on it; all other parameters belong to the
vehicle and have one value.
"""

from collections.abc import Mapping

from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.model_state import Prior
from pipeline.estimation.path_residuals import tie_prior


def tie_to_prior(data: EstimationData, numbers: Mapping[str, tuple[float, float]]) -> EstimationData:
    """The data with a prior on the parameters of a model.

    Args:
        data: the runs.
        numbers: mean and standard deviation by label ``effect.name``.

    Returns:
        The prepared runs, shared with `data`, with the prior in every path.
    """
    return data.with_paths(tuple(tie_prior(path, Prior(numbers)) for path in data.paths))
