"""Models on runs that they were not fitted on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, hold_out
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.models import Model

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.estimation.run_residuals import Input
    from pipeline.run import MotionRun

CARRIES_OVER = 1.1
"""Largest ratio of a model's error on another run to that of a fit to that run for it to transfer."""


@dataclass(frozen=True)
class Transfer:
    """A model on a run that it was not fitted on.

    Attributes:
        run: name of the run; `terrain` its terrain.
        carried: errors with the model's values; only the delays of the recording and parameters of single
            runs are fitted.
        own: held-out errors of the same effects fitted to this run.
        ideal: errors of the ideal model.
        ratio: ratio of carried to own, geometric mean over the channels x, y, w.
        warning: reason not to trust the model here; empty if it transfers.
    """

    run: str
    terrain: str
    carried: HeldOut
    own: HeldOut
    ideal: HeldOut
    ratio: float
    warning: str


def carry_over(
    model: Model,
    runs: Sequence[MotionRun],
    source: Input,
    *,
    fitted_on: Sequence[str] = (),
    per_run: Sequence[str] = (),
) -> list[Transfer]:
    """Predict runs with a model that was fitted on others.

    Args:
        model: model with fitted values.
        runs: runs to predict.
        source: input of the model.
        fitted_on: terrains it was fitted on, for the warning.
        per_run: labels of parameters with one value per run, which are fitted to each run.
    """
    transfers = []
    for run in runs:
        data = EstimationData([run], model.vehicle, source)
        carried = hold_out(data, fit_as_it_is(data, model, per_run))
        own = hold_out(data, fit_model(data, model, exact=True))
        ideal = hold_out(data, fit_model(data, model.ideal, exact=True))
        ratios = np.array(carried.pooled.ratios(own.pooled)[:3])
        ratio = float(np.exp(np.mean(np.log(ratios))))
        transfers.append(
            Transfer(run.name, run.terrain, carried, own, ideal, ratio, _warn(run, ratio, fitted_on))
        )
    return transfers


def fit_as_it_is(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> Fitted:
    """A model with its values: only delays of the recording and parameters of single runs are fitted."""
    return fit_model(
        data,
        model.swap(
            *(
                effect.fix(*(n for n in effect.values if f"{effect.id}.{n}" not in per_run))
                for effect in model
            )
        ),
    )


def _warn(run: MotionRun, ratio: float, fitted_on: Sequence[str]) -> str:
    if ratio <= CARRIES_OVER:
        return ""
    where = f" on {run.terrain}" if run.terrain != "unknown" else ""
    came = f" (fitted on {', '.join(sorted(set(fitted_on)))})" if fitted_on else ""
    return (
        f"the model{came} does not transfer to {run.name}{where}: its errors are {ratio:.2f} times "
        "those of a fit to that run"
    )
