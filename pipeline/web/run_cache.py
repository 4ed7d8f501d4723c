"""Runs made ready for fitting, kept in memory: the expensive part of every answer."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import polars as pl

from pipeline.core.arrays import Floats
from pipeline.diagnosis.error_regions import map_errors, pick_regions
from pipeline.diagnosis.unexplained import find_places
from pipeline.identification import Errors, Fitted, Input, Problem, State, choose_input, fit_model, hold_out
from pipeline.identification.describe import errors_as_json
from pipeline.identification.intervals import NOTHING, estimate_intervals
from pipeline.identification.predict import predict_at_from
from pipeline.identification.scoring import score
from pipeline.models import Model, Timing
from pipeline.report.motion_run import load_motion_run, load_vehicle
from pipeline.report.motion_view import MotionStage, MotionView
from pipeline.runs import MotionRun
from pipeline.store import Manifest
from pipeline.vehicles import Vehicle

_MOST_RUNS = 6
_MOST_FITS = 60


@dataclass(frozen=True)
class Judged:
    """A fitted model with its held-out errors and the intervals of its numbers."""

    fitted: Fitted
    errors: Errors
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Shown:
    """A model on a run, as it is shown.

    Attributes:
        view: rows to draw.
        where: the regions that carry most of its error, in the words of `slip diagnose`.
        predict: its body velocities at times of aligned poses [s], shape (n, 3).
    """

    view: MotionView
    where: list[str]
    predict: Callable[[Floats], Floats]


@dataclass
class PreparedRun:
    """One run and input, ready; one thread at a time.

    Attributes:
        manifest: the run's results.
        vehicle: what it was analyzed with.
        run: as arrays.
        problem: ready for fits.
        stage: ready to be shown.
        lock: held while one of these is used.
    """

    manifest: Manifest
    vehicle: Vehicle
    run: MotionRun
    problem: Problem
    stage: MotionStage
    lock: threading.RLock = field(default_factory=threading.RLock)
    _fits: OrderedDict[object, Judged] = field(default_factory=OrderedDict)
    _second: Problem | None = None

    def judge(self, model: Model) -> Judged:
        """Fit a model and score it on data that the fit has not seen; remembered.

        Effects at neutral values are searched, the others start from the values they have.
        """
        key = model.effects
        with self.lock:
            if key not in self._fits:
                fitted = fit_model(self.problem, model, exact=True)
                held_out = hold_out(self.problem, fitted)
                estimates = estimate_intervals(self.problem, fitted) if model.effects else NOTHING
                self._fits[key] = Judged(fitted, held_out.pooled, estimates.shared_intervals)
                while len(self._fits) > _MOST_FITS:
                    self._fits.popitem(last=False)
            self._fits.move_to_end(key)
            return self._fits[key]

    def judge_quickly(self, model: Model) -> Errors:
        """Held-out errors of a fitted model, without intervals."""
        with self.lock:
            return hold_out(self.problem, fit_model(self.problem, model, exact=not model.effects)).pooled

    def score(self, model: Model, timing: Sequence[float]) -> Errors:
        """Errors of a model as it stands, nothing fitted."""
        with self.lock:
            return score(self.problem, self.state(model, timing)).pooled

    def state(self, model: Model, timing: Sequence[float]) -> State:
        """A model with the recording's delays."""
        return State(model.effects, (Timing(timing[1]),))

    def show(
        self,
        model: Model,
        timing: Sequence[float],
        ladder: Sequence[Mapping[str, object]],
        floor: Mapping[str, object] | None,
    ) -> Shown:
        """A model as it stands, to be drawn."""
        with self.lock:
            state = self.state(model, timing)
            whole, comparison = self.problem.whole, self.problem.comparisons[0]
            residual = whole.find_residuals(state)
            regions = map_errors(whole, residual, find_places(comparison))
            return Shown(
                view=self.stage.view(state, ladder, floor),
                where=[region.sentence for region in pick_regions(regions, residual, whole.noise)],
                predict=partial(predict_at_from, comparison, state.effects_of(0), state.timing[0]),
            )

    def second_problem(self) -> Problem:
        """The run made ready once more, for trying many effects beside the work in front."""
        with self.lock:
            if self._second is None:
                self._second = Problem([self.run], self.vehicle, self.problem.source)
            return self._second


class RunCache:
    """The runs that were opened last."""

    def __init__(self) -> None:
        self._prepared: OrderedDict[tuple[str, str, str], PreparedRun] = OrderedDict()
        self._runs: OrderedDict[tuple[str, str], tuple[Vehicle, MotionRun]] = OrderedDict()
        self._lock = threading.Lock()
        self._making: dict[tuple[str, str, str], threading.Lock] = {}

    def load(self, manifest: Manifest) -> tuple[Vehicle, MotionRun]:
        """The run as arrays; remembered."""
        key = (manifest.run, manifest.key)
        with self._lock:
            if key in self._runs:
                return self._runs[key]
        vehicle = load_vehicle(manifest)
        loaded = (vehicle, load_motion_run(manifest, vehicle))
        with self._lock:
            self._runs[key] = loaded
            while len(self._runs) > _MOST_RUNS:
                self._runs.popitem(last=False)
        return loaded

    def list_inputs(self, manifest: Manifest) -> list[str]:
        """What models of a run can be fed with, the usual one first."""
        _, run = self.load(manifest)
        found = [Input.COMMAND] if run.commands is not None else []
        found += [Input.MEASURED] if run.wheels is not None else []
        return [source.value for source in found]

    def prepared(self, manifest: Manifest, source: str | None) -> PreparedRun:
        """A run ready for an input; made where it is not there yet.

        Raises:
            MotionError: the run has too little that can be compared.
        """
        vehicle, run = self.load(manifest)
        chosen = choose_input([run], source).source
        key = (manifest.run, manifest.key, chosen.value)
        with self._lock:
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                if key in self._prepared:
                    self._prepared.move_to_end(key)
                    return self._prepared[key]
            problem = Problem([run], vehicle, chosen)
            places = None
            if "velocities" in manifest.tables:
                places = manifest.read("velocities").select(pl.col("t", "x", "y")).sort("t")
            prepared = PreparedRun(manifest, vehicle, run, problem, MotionStage(problem, places))
            with self._lock:
                self._prepared[key] = prepared
                while len(self._prepared) > _MOST_RUNS:
                    self._prepared.popitem(last=False)
            return prepared


def rung_as_json(effects: Sequence[str], errors: Errors) -> dict[str, object]:
    """A rung of the ladder as the JSON of `slip diagnose` has it."""
    return {"effects": list(effects), **errors_as_json(errors)}
