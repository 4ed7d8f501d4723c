"""Models on runs that they were not fitted on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core import enumerate_texts, format_share
from pipeline.estimation.estimation_data import EstimationData
from pipeline.estimation.held_out import HeldOut, hold_out
from pipeline.estimation.ladder import measure_driven
from pipeline.estimation.model_fit import Fitted, fit_model
from pipeline.export import DRIVEN_SPEED, DRIVEN_TURN
from pipeline.models import Late, Model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.estimation.run_residuals import Input
    from pipeline.run import MotionRun

LOST = 0.1
"""Largest error that a model has on another run beyond that of a fit to that run, in parts of the ideal
model's, for it to transfer: where a fit leaves nearly nothing of that error, twice as much is no failure."""
_FASTER = 1.1
"""Ratio of the driven speeds from which on a run is driven faster than those of a fit."""
_VELOCITIES = ("forward speed", "lateral speed", "yaw rate")


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
        remaining: errors over 2 s in parts of the ideal model's, of carried and of own, by `position` and
            `heading`; those of velocities where neither is known.
        renewed: labels of parameters of the recording, such as its clock, which were fitted anew.
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
    remaining: Mapping[str, tuple[float, float]]
    renewed: Sequence[str]
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
    transfers, renewed = [], _list_of_recording(model)
    for run in runs:
        data = EstimationData([run], model.vehicle, source)
        carried = hold_out(data, fit_as_it_is(data, model, per_run))
        own = hold_out(data, fit_model(data, model, exact=True))
        ideal = hold_out(data, fit_model(data, model.ideal, exact=True))
        *velocities, position, heading = carried.pooled.ratios(own.pooled)
        ratio = float(np.exp(np.mean(np.log(velocities))))
        pairs = {"position": position, "heading": heading}
        apart = {name: one for name, one in pairs.items() if math.isfinite(one)}
        remaining, beyond = _compare_with_ideal(carried, own, ideal), _find_beyond(data, fitted_on)
        warning = _warn(run, remaining, renewed, beyond, [str(row.get("terrain")) for row in fitted_on])
        held_out = carried, own, ideal
        transfers.append(
            Transfer(run.name, run.terrain, *held_out, ratio, apart, remaining, renewed, beyond, warning)
        )
    return transfers


def _compare_with_ideal(carried: HeldOut, own: HeldOut, ideal: HeldOut) -> dict[str, tuple[float, float]]:
    """Errors of two models in parts of the ideal one's; see `Transfer.remaining`."""
    both = zip(*(one.pooled.ratios(ideal.pooled) for one in (carried, own)), strict=True)
    named = dict(zip((*_VELOCITIES, "position", "heading"), both, strict=True))
    known = {name: pair for name, pair in named.items() if all(map(math.isfinite, pair))}
    over_2_s = {name: pair for name, pair in known.items() if name not in _VELOCITIES}
    return over_2_s or known


def _list_of_recording(model: Model) -> list[str]:
    """Labels of parameters that belong to a recording and not to the robot: the clock of its poses."""
    return [f"{effect.id}.{name}" for effect in model if effect.late is Late.POSES for name in effect.values]


def fit_as_it_is(data: EstimationData, model: Model, per_run: Sequence[str] = ()) -> Fitted:
    """A model with its values: only delays of the recording and parameters of single runs are fitted."""
    free = {*per_run, *_list_of_recording(model)}
    return fit_model(
        data,
        model.swap(
            *(effect.fix(*(n for n in effect.values if f"{effect.id}.{n}" not in free)) for effect in model)
        ),
    )


def _find_beyond(data: EstimationData, fitted_on: Sequence[Mapping[str, object]]) -> dict[str, float]:
    """By how much a run is driven faster than those of a fit."""
    (driven,) = measure_driven(data)
    beyond = dict[str, float]()
    for name, key in {"speed": DRIVEN_SPEED, "yaw rate": DRIVEN_TURN}.items():
        most = max((float(one) for row in fitted_on if isinstance(one := row.get(key), float)), default=0.0)
        if most > 0.0 and driven[key] > _FASTER * most:
            beyond[name] = driven[key] / most
    return beyond


def _warn(
    run: MotionRun,
    remaining: Mapping[str, tuple[float, float]],
    renewed: Sequence[str],
    beyond: Mapping[str, float],
    terrains: Sequence[str],
) -> str:
    failing = {name: pair for name, pair in remaining.items() if pair[0] - pair[1] > LOST}
    if not failing:
        return ""
    where = f" on {run.terrain}" if run.terrain != "unknown" else ""
    came = f" (fitted on {', '.join(sorted(set(terrains)))})" if terrains else ""
    of = f" in {next(iter(failing))} alone" if len(failing) == 1 < len(remaining) else ""
    again = f" with its {enumerate_texts(renewed)} fitted anew" if renewed else ""
    text = (
        f"the model{came} does not transfer to {run.name}{where}{of} ({describe_remaining(failing)}){again}"
    )
    return f"{text}; the run is {describe_beyond(beyond)}" if beyond else text


def describe_remaining(remaining: Mapping[str, tuple[float, float]]) -> str:
    """How much of the ideal model's error a model leaves, and how much a fit to the run."""
    given = enumerate_texts([f"{format_share(pair[0])} in {name}" for name, pair in remaining.items()])
    own = enumerate_texts([format_share(pair[1]) for pair in remaining.values()])
    return f"ideal model's error left: {given}, refitted {own}"


def describe_beyond(beyond: Mapping[str, float]) -> str:
    """How far a run is outside the driving of a fit."""
    parts = [f"{one:.2g} times the largest {name}" for name, one in beyond.items()]
    return f"driven at up to {enumerate_texts(parts)} of the fit"
