"""What carries over: a model fitted on some runs, asked about others."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.identification.comparison import Input
from pipeline.identification.fit import fit_model
from pipeline.identification.problem import Problem
from pipeline.identification.scoring import HeldOut, hold_out
from pipeline.models.model import Model
from pipeline.runs.recording import MotionRun

CARRIES_OVER = 1.1


@dataclass(frozen=True)
class Transfer:
    """A model on a run that it was not fitted on.

    Attributes:
        run: name of the run; `terrain` its terrain.
        carried: errors with the model's values as they are; only the delays of the recording and what is each
            run's own are fitted.
        own: held-out errors of the same effects fitted to this run.
        ideal: errors of the ideal model.
        ratio: carried over own, geometric over the channels x, y, w.
        warning: why not to trust the model here; empty when it carries over.
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
        model: with fitted values.
        runs: to predict.
        source: what the model is fed with.
        fitted_on: terrains it was fitted on, for the warning.
        per_run: labels of numbers that belong to each run alone, which no model carries over but a fit finds.
    """
    found = []
    frozen = model.swap(
        *(effect.fix(*(n for n in effect.values if f"{effect.id}.{n}" not in per_run)) for effect in model)
    )
    for run in runs:
        problem = Problem([run], model.vehicle, source)
        carried = hold_out(problem, fit_model(problem, frozen))
        own = hold_out(problem, fit_model(problem, model, exact=True))
        ideal = hold_out(problem, fit_model(problem, model.ideal, exact=True))
        ratios = np.array(carried.pooled.ratios(own.pooled)[:3])
        ratio = float(np.exp(np.mean(np.log(ratios))))
        found.append(
            Transfer(run.name, run.terrain, carried, own, ideal, ratio, _warn(run, ratio, fitted_on))
        )
    return found


def _warn(run: MotionRun, ratio: float, fitted_on: Sequence[str]) -> str:
    if ratio <= CARRIES_OVER:
        return ""
    where = f" on {run.terrain}" if run.terrain != "unknown" else ""
    came = f" (fitted on {', '.join(sorted(set(fitted_on)))})" if fitted_on else ""
    return (
        f"the model{came} does not carry over to {run.name}{where}: its errors are {ratio:.2f} times "
        "those of a fit to that run"
    )
