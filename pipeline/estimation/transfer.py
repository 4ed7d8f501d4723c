"""Models on runs that they were not fitted on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import enumerate_texts
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, hold_out
from pipeline.estimation.ladder import measure_driven
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.export import DRIVEN_SPEED, DRIVEN_TURN
from pipeline.models import Model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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
        apart: the same of the errors over 2 s, by `position` and `heading`; those that are known.
        beyond: how many times faster than in the runs of the fit it drives or turns here, by `speed` and
            `yaw rate`; those of which the model knows too little.
        warning: reason not to trust the model here; empty if it transfers.
    """

    run: str
    terrain: str
    carried: HeldOut
    own: HeldOut
    ideal: HeldOut
    ratio: float
    apart: Mapping[str, float]
    beyond: Mapping[str, float]
    warning: str


def carry_over(
    model: Model,
    runs: Sequence[MotionRun],
    source: Input,
    *,
    fitted_on: Sequence[Mapping[str, object]] = (),
    per_run: Sequence[str] = (),
) -> list[Transfer]:
    """Predict runs with a model that was fitted on others.

    Args:
        model: model with fitted values.
        runs: runs to predict.
        source: input of the model.
        fitted_on: the runs of the fit as a model file lists them, for the warning.
        per_run: labels of parameters with one value per run, which are fitted to each run.
    """
    transfers = []
    for run in runs:
        data = EstimationData([run], model.vehicle, source)
        carried = hold_out(data, fit_as_it_is(data, model, per_run))
        own = hold_out(data, fit_model(data, model, exact=True))
        ideal = hold_out(data, fit_model(data, model.ideal, exact=True))
        *velocities, position, heading = carried.pooled.ratios(own.pooled)
        ratio = float(np.exp(np.mean(np.log(velocities))))
        pairs = {"position": position, "heading": heading}
        apart = {name: one for name, one in pairs.items() if math.isfinite(one)}
        beyond = _find_beyond(data, fitted_on)
        warning = _warn(run, ratio, apart, beyond, [str(row.get("terrain")) for row in fitted_on])
        transfers.append(Transfer(run.name, run.terrain, carried, own, ideal, ratio, apart, beyond, warning))
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


def _find_beyond(data: EstimationData, fitted_on: Sequence[Mapping[str, object]]) -> dict[str, float]:
    """By how much a run is driven faster than those of a fit."""
    (driven,) = measure_driven(data)
    beyond = dict[str, float]()
    for name, key in {"speed": DRIVEN_SPEED, "yaw rate": DRIVEN_TURN}.items():
        most = max((float(one) for row in fitted_on if isinstance(one := row.get(key), float)), default=0.0)
        if most > 0.0 and driven[key] > CARRIES_OVER * most:
            beyond[name] = driven[key] / most
    return beyond


def _warn(
    run: MotionRun,
    ratio: float,
    apart: Mapping[str, float],
    beyond: Mapping[str, float],
    terrains: Sequence[str],
) -> str:
    failing = {name: one for name, one in apart.items() if one > CARRIES_OVER}
    if not failing and ratio <= CARRIES_OVER:
        return ""
    where = f" on {run.terrain}" if run.terrain != "unknown" else ""
    came = f" (fitted on {', '.join(sorted(set(terrains)))})" if terrains else ""
    of = f" in {next(iter(failing))} alone" if len(failing) == 1 < len(apart) else ""
    said = enumerate_texts([f"{one:.2f}" for one in failing.values()] or [f"{ratio:.2f}"])
    each = " and ".join(failing) if len(failing) > 1 else ""
    errors = f"its errors{f' of {each}' if each else ''} are"
    text = (
        f"the model{came} does not transfer to {run.name}{where}{of}: {errors} {said} times "
        "those of a fit to that run"
    )
    return f"{text}, which is {describe_beyond(beyond)}" if beyond else text


def describe_beyond(beyond: Mapping[str, float]) -> str:
    """How far a run is outside the driving of a fit."""
    parts = [f"{one:.2g} times the largest {name}" for name, one in beyond.items()]
    return f"driven at up to {enumerate_texts(parts)} of the fit"
