"""Joint fit of one model to all runs of a vehicle, and the forecast from the evidence of each run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.core.program import SlipError
from pipeline.estimation.comparison import Comparison, Input
from pipeline.estimation.joint_fit import fit_part_jointly, split_normals
from pipeline.estimation.parts import Part, WheelPart
from pipeline.estimation.problem import Problem
from pipeline.fleet.forecast import Forecast, forecast_vehicle, join_evidence, list_held
from pipeline.fleet.joint_levels import RunEvidence
from pipeline.job.prediction import find_estimates
from pipeline.models.effect import Effect, Late
from pipeline.models.model import Model
from pipeline.report.motion_view import load_motion_run, load_vehicle

if TYPE_CHECKING:
    from pipeline.core.arrays import Floats
    from pipeline.estimation.fit import PartFit
    from pipeline.run.recording import MotionRun
    from pipeline.sources import Vehicle
    from pipeline.store import Store

MOST_JOINED = 24
"""Largest number of jointly fitted runs, those on the terrain first: more take longer for the same result."""
OTHER_GROUND = 0.1
"""Weight of a run on another terrain, so that runs on the requested terrain dominate and the others determine
the remaining parameters. The median heading error of seven runs, divided by that of their own models, is 1.29
with 0.3, 1.22 with 0.1 and 1.21 with 0.03; with 0.03 the largest error grows (`python
benchmarks/transfer.py`)."""
LEAST_FALL = 0.01
"""Decrease of the mean logarithm of the runs' residual scale to add an effect: one percent of the error."""


def forecast_deployment(
    store: Store,
    vehicle: str,
    terrain: str,
    source: Literal["command", "measured"] = "command",
    *,
    without: Sequence[str] = (),
) -> Forecast:
    """Forecast the parameters of a vehicle on a terrain from the runs of the results.

    The stored models define the effects and the start values of the fit (`forecast_vehicle`). This model is
    fitted to all runs of the vehicle jointly, each weighted by its own misfit, with less weight for other
    terrains. An effect that fewer models have is added if it lowers the misfit over all runs. The normal
    equations of the single runs determine the variation of the parameters between terrains and runs
    (`join_evidence`): a parameter that a run does not determine has no weight.

    Args:
        store: the results.
        vehicle: id of the vehicle.
        terrain: name of the terrain; it need not have runs.
        source: input of the model.
        without: SHA-256 of recordings to exclude, such as those to be predicted.

    Raises:
        SlipError: there is no fleet, or no run of the vehicle.
    """
    estimates = find_estimates(store, without=without)
    start = forecast_vehicle(estimates, vehicle, terrain, source)
    runs = list(_load_runs(store, start))
    if not start.numbers or not runs:
        return start
    geometry, held = runs[0][1], list_held(estimates, vehicle, source)
    problem = Problem([run for run, _ in runs], geometry, Input(source))
    clocks = [effect for effect in held if effect.late is Late.POSES]
    shares = np.array([1.0 if run.terrain == terrain else OTHER_GROUND for run in problem.runs])
    fits: list[tuple[Part, PartFit]] = []
    also: list[str] = []
    for part in problem.parts:
        mine = [effect for effect in (*start.effects, *clocks) if part.owns(effect)]
        state = problem.start_state(problem.active_effects(Model(geometry, tuple(mine))))
        fit = fit_part_jointly(part, state, shares)
        if isinstance(part, WheelPart):
            fit = _add_held(part, fit, held, shares)
            also += [effect.id for effect in fit.state.effects if effect.id not in state.ids]
        fits.append((part, fit))
    if also:
        start = forecast_vehicle(estimates, vehicle, terrain, source, also=also)
    return join_evidence(start, _gather(problem, fits, start), read_values(problem, fits, terrain))


def _load_runs(store: Store, start: Forecast) -> Iterator[tuple[MotionRun, Vehicle]]:
    """Runs of the forecast that have its input, those on its terrain first."""
    for name in start.runs[:MOST_JOINED]:
        manifest = store.manifest(name)
        with contextlib.suppress(SlipError):
            if manifest is not None:
                vehicle = load_vehicle(manifest)
                run = load_motion_run(manifest, vehicle)
                Comparison(run, vehicle, Input(start.input))
                yield run, vehicle


def _add_held(part: Part, fit: PartFit, held: Sequence[Effect], shares: Floats) -> PartFit:
    """Extend the fit with effects of some stored models if they lower the misfit over all runs."""
    for effect in held:
        taken = any(
            effect.id == one.id or effect.id in one.contains or one.id in effect.contains
            for one in fit.state.effects
        )
        if taken or not part.owns(effect):
            continue
        extended = fit_part_jointly(part, fit.state.add(effect), shares)
        if fit.loss - extended.loss >= LEAST_FALL:
            fit = extended
    return fit


def _gather(problem: Problem, fits: Sequence[tuple[Part, PartFit]], start: Forecast) -> list[RunEvidence]:
    """Normal equations of every run for all parameters of a forecast, in its order."""
    labels = [number.label for number in start.numbers]
    size = len(labels)
    normals, pulls = np.zeros((len(problem.runs), size, size)), np.zeros((len(problem.runs), size))
    for part, fit in fits:
        for run, summed in enumerate(split_normals(part, fit)):
            rows = [index for index, label in enumerate(summed.labels) if label in labels]
            places = [labels.index(summed.labels[row]) for row in rows]
            normals[run][np.ix_(places, places)] += summed.normal[np.ix_(rows, rows)]
            pulls[run][places] += summed.pull[rows]
    return [
        RunEvidence(run.name, run.terrain, normal, pull)
        for run, normal, pull in zip(problem.runs, normals, pulls, strict=True)
    ]


def read_values(problem: Problem, fits: Sequence[tuple[Part, PartFit]], terrain: str) -> Mapping[str, float]:
    """Values of the joint fits by label; a terrain parameter has its value on this terrain.

    For a terrain without runs it is the median over the other terrains, which is robust against an unusual
    one such as ice.
    """
    first = {run.terrain: number for number, run in reversed([*enumerate(problem.runs)])}
    runs = [first[terrain]] if terrain in first else [*first.values()]
    values: dict[str, float] = {}
    for _, fit in fits:
        for number in fit.free:
            if number.effect:
                acting = (replace(number, run=run) for run in runs)
                values[number.label] = float(np.median([fit.state.get(one) for one in acting]))
    return values
