"""Replay of a log's commands with the twin of a model, the ideal model and the kinematic model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.core.program import finite_or_none, pick
from pipeline.estimation.comparison import Input
from pipeline.estimation.fit import Fitted, fit_model
from pipeline.estimation.folds import FOLDS, number_predictions, refit
from pipeline.estimation.problem import Prediction, Problem, fit_as_it_is, predict_from
from pipeline.estimation.state import State
from pipeline.export.targets.twin_files import find_driven_speed
from pipeline.export.twin_body import TwinBody, build_twin_body
from pipeline.job import INPUTS
from pipeline.job.run_results import diagnose_stored, find_diagnosis
from pipeline.job.twin_world import load_mujoco, make_twin_effects
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.report.motion_view import read_model_text
from pipeline.run.recording import MotionError, MotionRun

if TYPE_CHECKING:
    from pipeline.core.arrays import Flags, Floats
    from pipeline.models.effect import Effect
    from pipeline.store import Manifest

SIDES = ("ideal", "model", "twin")
"""Predictions that are compared with the measured motion."""
LEAST_REPRODUCED = 0.9
"""Smallest fraction of the model's error reduction that a complete twin reproduces."""
_WINDOW_S = 30.0
_PATH_EVERY_S = 2.0


@dataclass(frozen=True)
class ReplayError:
    """RMS error of predictions over 2 s from measured poses: position [m] and heading [rad]."""

    t_mrmse_m: float
    r_mrmse_rad: float


@dataclass(frozen=True)
class MissingEffect:
    """An effect that contact does not reproduce: its description, and the model's error [m] without it."""

    effect: str
    motion: str
    t_mrmse_m: float


@dataclass(frozen=True)
class TwinReplay:
    """Predictions of a log with three models.

    Attributes:
        run: name of the run.
        model: model of the twin; if it was fitted to this log, with the estimates from the whole log.
        body: the twin.
        is_seen: whether the model was fitted to this log; each prediction is then evaluated with parameters
            that were fitted without its stretch.
        errors: errors by `SIDES`.
        missing: effects that contact does not reproduce, in order of decreasing error.
        paths: rows ``t piece x y series`` of predictions over 2 s, including the measured path.
        horizon_errors: rows ``t value series``: the error of each prediction [m].
        predictions: number of predictions.
    """

    run: str
    model: Model
    body: TwinBody
    is_seen: bool
    errors: dict[str, ReplayError]
    missing: tuple[MissingEffect, ...]
    paths: pl.DataFrame
    horizon_errors: pl.DataFrame
    predictions: int

    @property
    def reproduced(self) -> float:
        """Fraction of the model's error reduction, relative to the ideal model, that the twin reproduces."""
        ideal, model, twin = (self.errors[side].t_mrmse_m for side in SIDES)
        return (ideal - twin) / (ideal - model) if ideal > model else float("nan")

    @property
    def is_worse(self) -> bool:
        """Whether the twin reproduces clearly less than its model."""
        return self.reproduced < LEAST_REPRODUCED

    def to_json(self) -> dict[str, object]:
        """The JSON object of `slip simulate --twin`."""
        return {
            "run": self.run,
            "vehicle": self.body.vehicle.id,
            "effects": list(self.model.ids),
            "fitted_to_this_log": self.is_seen,
            "predictions": self.predictions,
            "errors": {side: pick(error, "t_mrmse_m", "r_mrmse_rad") for side, error in self.errors.items()},
            "missing": [pick(one, "effect", "motion", "t_mrmse_m") for one in self.missing],
            "controller": [effect.id for effect in self.body.controller],
            "notes": list(self.body.notes),
            "reproduced": finite_or_none(self.reproduced),
        }


def find_run_model(manifest: Manifest, results: Path) -> ModelFile:
    """The model that the diagnosis of a run proposes.

    Raises:
        MotionError: ``nothing_named``: the twin would be the ideal model.
    """
    content = find_diagnosis(results, manifest) or diagnose_stored([manifest], INPUTS, None, None, None)
    file = read_model_text(content)
    if file is None or not file.model.effects:
        what = "the diagnosis of the run names no effect, so there is nothing that a twin would reproduce"
        hint = "Give a model: slip simulate RUN --twin model.toml."
        raise MotionError("nothing_named", what, where=manifest.run, hint=hint)
    return file


def replay_twin(file: ModelFile, run: MotionRun) -> TwinReplay:
    """Replay the commands of a run.

    Parameters that were fitted to this run are refitted without each stretch of ten seconds; others are
    used unchanged.

    Args:
        file: the model.
        run: the run, read with the model's vehicle.

    Raises:
        MotionError: ``mujoco_needed``; ``wrong_vehicle``; ``no_command``; ``twin_unstable``.
    """
    load_mujoco()
    problem = Problem([run], file.model.vehicle, Input.COMMAND)
    model = file.model.keep(effect.id for effect in problem.active_effects(file.model))
    is_seen = not file.list_fitted("runs") or any(
        row.get("sha256") == run.sha256 or row.get("run") == run.name for row in file.list_fitted("runs")
    )
    if is_seen:
        fitted = fit_model(problem, Model(problem.vehicle, model.effects), per_run=file.per_run, exact=True)
    else:
        fitted = fit_as_it_is(problem, Model(problem.vehicle, model.effects), file.per_run)
    speed = find_driven_speed(file)
    return _Replay(problem, fitted, speed, is_seen=is_seen).replay()


class _Replay:
    def __init__(self, problem: Problem, fitted: Fitted, speed_mps: float, *, is_seen: bool) -> None:
        self.problem, self.fitted, self.speed_mps, self.is_seen = problem, fitted, speed_mps, is_seen
        (self.comparison,) = problem.comparisons
        self.effects = fitted.state.effects_of(0)
        self.body = self._build(self.effects)

    def _build(self, effects: Sequence[Effect]) -> TwinBody:
        return build_twin_body(Model(self.problem.vehicle, tuple(effects)), self.speed_mps)

    def replay(self) -> TwinReplay:
        missing = [effect.id for effect in self.body.missing]
        position, yaw = self._find_errors(missing)
        errors = {side: ReplayError(_rms(position[side]), _rms(yaw[side])) for side in SIDES}
        context = self.comparison.context
        costs = [
            MissingEffect(
                effect.id, effect.describe_motion(context.vehicle, self.effects), _rms(position[effect.id])
            )
            for effect in self.body.missing
        ]
        paths, horizon_errors = self._draw_paths(), self._list_horizon_errors(position)
        return TwinReplay(
            run=self.comparison.run.name,
            model=Model(self.problem.vehicle, self.effects),
            body=self.body,
            is_seen=self.is_seen,
            errors=errors,
            missing=tuple(sorted(costs, key=lambda one: -one.t_mrmse_m)),
            paths=paths,
            horizon_errors=horizon_errors,
            predictions=int(np.unique(self.comparison.horizons.number).size),
        )

    def _list_states(self) -> Iterator[tuple[State, Flags]]:
        """Parameters and the predictions to evaluate them on: one set for all if the run is unseen."""
        (numbers,) = number_predictions(self.problem)
        if not self.is_seen:
            yield self.fitted.state, np.ones(numbers.size, dtype=bool)
            return
        for fold, training in enumerate(self.problem.training):
            state = self.fitted.state
            for part, fit, train in zip(self.problem.parts, self.fitted.fits, training, strict=True):
                state = state.take_over(refit(part, fit, train), fit.free)
            yield state, numbers % FOLDS == fold

    def _find_errors(self, missing: Sequence[str]) -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Errors of position [m] and heading [rad] of every prediction, by side and by removed effect."""
        count = self.comparison.horizons.number.size
        position = {side: np.full(count, np.nan) for side in (*SIDES, *missing)}
        yaw = {side: np.full(count, np.nan) for side in position}
        for state, in_test in self._list_states():
            if not in_test.any():
                continue
            effects, timing = state.effects_of(0), state.timing[0]
            asked: dict[str, Callable[[], Sequence[Effect]]] = {
                "ideal": tuple,
                "model": lambda effects=effects: effects,  # type: ignore[misc]
                "twin": lambda effects=effects, in_test=in_test: make_twin_effects(  # type: ignore[misc]
                    self._build(effects), self._find_cells(in_test)
                ),
            }
            for name in missing:
                asked[name] = lambda effects=effects, name=name: [e for e in effects if e.id != name]  # type: ignore[misc]
            for side, make in asked.items():
                errors = self.comparison.find_horizon_errors(make(), timing)
                position[side][in_test], yaw[side][in_test] = errors.position[in_test], errors.yaw[in_test]
        return position, yaw

    def _find_cells(self, in_test: Flags) -> Flags:
        """Cells that these predictions use, shape (n,)."""
        grid = self.comparison.grid
        times = self.comparison.horizons.times[in_test]
        late = self.comparison.run.alignment.heading_delay_s
        steps = np.zeros(grid.times.size + 1, dtype=np.int64)
        margin = 2.0 * grid.step_s + abs(late)
        np.add.at(steps, np.searchsorted(grid.times, times[:, 0] - margin), 1)
        np.add.at(steps, np.searchsorted(grid.times, times[:, 1] + margin), -1)
        used: Flags = np.cumsum(steps)[:-1] > 0
        return used

    def _draw_paths(self) -> pl.DataFrame:
        timing = self.fitted.state.timing[0]
        track = self.comparison.run.track
        frames = [_tabulate_track(track.times, track.path)]
        sides = {"ideal": (), "model": self.effects, "twin": make_twin_effects(self.body)}
        for side, effects in sides.items():
            made = predict_from(self.comparison, effects, timing, rate_hz=10.0)
            frames.append(_tabulate_arcs(made, side))
        return pl.concat(frames)

    def _list_horizon_errors(self, position: dict[str, Floats]) -> pl.DataFrame:
        horizons = self.comparison.horizons
        first = np.unique(horizons.number, return_index=True)[1]
        count = np.maximum(np.bincount(horizons.number), 1)
        frames = []
        for side in SIDES:
            squares = np.bincount(horizons.number, np.nan_to_num(position[side]) ** 2) / count
            values = np.sqrt(squares)[np.unique(horizons.number)]
            frames.append(pl.DataFrame({"t": horizons.times[first, 0], "value": values, "series": side}))
        return pl.concat(frames)


def _rms(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _tabulate_track(times: Floats, path: np.ndarray[tuple[int], np.dtype[np.complex128]]) -> pl.DataFrame:
    piece = np.cumsum(np.diff(times, prepend=times[:1]) > _WINDOW_S).astype(np.int32)
    return pl.DataFrame({"t": times, "piece": piece, "x": path.real, "y": path.imag, "series": "measured"})


def _tabulate_arcs(made: Prediction, side: str) -> pl.DataFrame:
    slot = np.floor(made.start_times / _PATH_EVERY_S)
    starts = np.flatnonzero(np.diff(slot, prepend=-1.0) > 0.0)
    steps = made.horizon_times.size
    return pl.DataFrame(
        {
            "t": (made.start_times[starts][:, None] + made.horizon_times).ravel(),
            "piece": np.repeat(np.arange(starts.size, dtype=np.int32), steps),
            "x": made.poses[starts, :, 0].ravel(),
            "y": made.poses[starts, :, 1].ravel(),
            "series": side,
        }
    )
