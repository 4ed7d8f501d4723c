"""What to add next, and the figures of a session, whole or only the rows that a change moves."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.core.program import SlipError
from pipeline.estimation import HeldOut, Problem, fit_model, hold_out
from pipeline.estimation.acceptance import compare
from pipeline.estimation.evidence import learn_noise, tile_windows
from pipeline.estimation.learning import compare_losses, list_rises
from pipeline.estimation.parts import make_weights
from pipeline.job.run_results import DIAGNOSIS
from pipeline.job.work import find_residual_modulus
from pipeline.models import Effect, Model, list_effects
from pipeline.report import theme
from pipeline.report.figures import list_figures, over_ground
from pipeline.report.scene import RunReport, Scene, number_in
from pipeline.report.theme import build_spec, pack_rows, share_rows
from pipeline.run import MotionError
from pipeline.store import Manifest
from pipeline.web.actions import PreparedRun, Shown
from pipeline.web.answers import evaluating
from pipeline.web.session import describe_shortly
from pipeline.web.stored_runs import read_summary

FIGURES = (
    "ladder",
    "budget",
    "trajectory",
    "residuals",
    "signature",
    "reach",
    "velocities",
    "autocorrelation",
    "step_response",
    "command_space",
)
_COLOURED = {"trajectory": over_ground.describe, "command_space": over_ground.describe_cells}
_LEFT = "Colours: residual slip of the model."


@dataclass(frozen=True)
class _ModelScene(Scene):
    """A run's tables with the slip that a model leaves, on the scale of the ideal model's.

    Attributes:
        ideal_cap: where the colour ramp ends [m/s], the same for every model.
    """

    ideal_cap: float

    @cached_property
    def modulus_cap(self) -> float:
        return self.ideal_cap


class FigureCache:
    """The tables of one run, read once, and the figures of any model of it.

    Args:
        manifest: the run.
    """

    def __init__(self, manifest: Manifest) -> None:
        wanted = ("velocities", "slip", "windows", "aggregates")
        self._tables = {name: manifest.read(name) for name in wanted if name in manifest.tables}
        self._summary = read_summary(manifest)
        told = manifest.read_json(DIAGNOSIS) if DIAGNOSIS in manifest.files else {}
        self._diagnosis: dict[str, object] = {key: told[key] for key in ("input", "budget") if key in told}
        self._length = number_in(self._summary, "length_scale_m") or 1.0
        self._caps: dict[str, float] = {}

    def draw(self, shown: Shown) -> dict[str, object]:
        """Specifications, rows, titles and words of all figures."""
        scene = self._scene(shown)
        drawn = [(figure, figure.draw(scene)) for figure in list_figures() if figure.id in FIGURES]
        there = {figure.id: (figure, drawing) for figure, drawing in drawn if drawing is not None}
        ordered = [there[name] for name in FIGURES if name in there]
        return {
            "figures": {figure.id: build_spec(drawing) for figure, drawing in ordered},
            "rows": share_rows(drawing for _, drawing in ordered),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
            "shown": [
                {
                    "id": figure.id,
                    "title": figure.title,
                    "width": figure.width,
                    "words": drawing.words,
                    "note": f"{_LEFT} {drawing.note}" if figure.id in _COLOURED else drawing.note,
                }
                for figure, drawing in ordered
            ],
        }

    def redraw(self, shown: Shown) -> dict[str, object]:
        """The rows and words that differ from model to model."""
        scene = self._scene(shown)
        rows: dict[str, pl.DataFrame] = {}
        for figure in list_figures():
            rows.update(figure.live(scene) if figure.live else {})
        if scene.track is not None:
            rows["track"] = scene.track.frame
        words = {name: describe(scene) for name, describe in _COLOURED.items()}
        return {"rows": pack_rows(rows), "where": shown.where, "words": words}

    def _scene(self, shown: Shown) -> Scene:
        """The run as figures need it, fed with what the model is fed with."""
        source = shown.view.input
        summary = {**self._summary, "input": source}
        if source not in self._caps:
            self._caps[source] = Scene(RunReport(summary, self._tables)).modulus_cap
        tables = {**self._tables, "slip": self._leave(shown)} if "slip" in self._tables else self._tables
        report = RunReport(summary, tables, self._diagnosis, motion=shown.view)
        return _ModelScene(report, self._caps[source])

    def _leave(self, shown: Shown) -> pl.DataFrame:
        """The table `slip` with the modulus of what a model leaves of it."""
        slip = self._tables["slip"]
        if not shown.view.effects:
            return slip
        followed = pl.col("input").cast(pl.String) == shown.view.input
        part, rest = slip.filter(followed), slip.filter(~followed)
        left = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
        kept = pl.Series("modulus", left).fill_nan(None)
        return pl.concat([part.with_columns(kept).filter(pl.col("modulus").is_not_null()), rest])


_WORTH = 0.99
_MOST_KEPT = 40
_TWIN = 0.95
"""Cosine between what two effects take off the residuals, from which on they are called twins: nine tenths
of the square of what one does the other does too."""


@dataclass
class Trial:
    """Every effect tried on top of one model.

    Attributes:
        owner: who asked for it.
        total: how many there are to try.
        tried: how many were.
        found: what each would do, as JSON.
        stopped: whether somebody wants it to end.
    """

    owner: str
    total: int
    tried: int = 0
    found: list[dict[str, object]] = field(default_factory=list)
    stopped: bool = False

    @property
    def is_broken(self) -> bool:
        """Whether it was stopped before its end."""
        return self.stopped and self.tried < self.total

    def show(self) -> dict[str, object]:
        """As JSON: those that help first, by how far both errors over 2 s fall."""
        ranked = sorted(self.found, key=lambda entry: (not entry["helps"], entry["left"]))
        return {"total": self.total, "tried": self.tried, "found": ranked}


class Trials:
    """Trials that run or ran, by run, input and model; one thread each, the older ones of a run stopped."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Trial] = {}
        self._lock = threading.Lock()
        self._in_front = 0
        self._idle = threading.Event()
        self._idle.set()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """As long as somebody waits for an answer no further effect is tried."""
        with self._lock:
            self._in_front += 1
            self._idle.clear()
        try:
            yield
        finally:
            with self._lock:
                self._in_front -= 1
                if not self._in_front:
                    self._idle.set()

    def find(self, prepared: PreparedRun, model: Model) -> Trial | None:
        """The trial of a model, if there is one that was not stopped before its end."""
        with self._lock:
            trial = self._known.get(_key(prepared, model))
        return None if trial is None or trial.is_broken else trial

    def begin(self, prepared: PreparedRun, model: Model, owner: str) -> Trial:
        """Try every effect on top of a model, in the background; what its owner had begun before ends.

        Args:
            prepared: the run.
            model: as it stands.
            owner: who asks: one trial each.
        """
        key = _key(prepared, model)
        with self._lock:
            known = self._known.get(key)
            if known is not None and not known.is_broken:
                return known
            for trial in self._known.values():
                trial.stopped = trial.stopped or trial.owner == owner
            while len(self._known) >= _MOST_KEPT:
                self._known.pop(next(iter(self._known)))
            kinds = [
                effect
                for effect in list_effects()
                if prepared.vehicle.kind in effect.kinds and effect.id not in model
            ]
            trial = Trial(owner, len(kinds))
            self._known[key] = trial
        work = (prepared, model, kinds, trial, self._idle)
        threading.Thread(target=_try_all, args=work, daemon=True).start()
        return trial


def _key(prepared: PreparedRun, model: Model) -> tuple[object, ...]:
    manifest = prepared.manifest
    return (manifest.run, manifest.key, prepared.problem.source.value, model.effects)


def _try_all(
    prepared: PreparedRun, model: Model, kinds: list[type[Effect]], trial: Trial, idle: threading.Event
) -> None:
    try:
        with evaluating(prepared.manifest.run):
            _try_each(prepared, model, kinds, trial, idle)
    except SlipError:
        # On top of a model that cannot be fitted nothing can be tried.
        trial.tried = trial.total


def _try_each(
    prepared: PreparedRun, model: Model, kinds: list[type[Effect]], trial: Trial, idle: threading.Event
) -> None:
    problem = prepared.second_problem()
    base: HeldOut = hold_out(problem, fit_model(problem, model))
    taken: dict[str, Floats] = {}
    for kind in kinds:
        name = kind.id
        idle.wait()
        if trial.stopped:
            return
        added = model + kind()
        if len(problem.active_effects(added)) > len(problem.active_effects(model)):
            try:
                held_out = hold_out(problem, fit_model(problem, added))
            except (MotionError, ArithmeticError, ValueError):
                # What cannot be fitted to this run is no proposal.
                held_out = base
            ratio = compare_losses(held_out, base)
            helps = ratio < _WORTH and _reaches_further(base, held_out) and _is_sure(problem, base, held_out)
            twins = _find_twins(name, held_out, base, taken, trial) if helps else []
            trial.found.append(
                {
                    "id": name,
                    "about": describe_shortly(kind),
                    "ratio": ratio,
                    "left": _share_left(base, held_out),
                    "helps": helps,
                    "twins": twins,
                    "from": {"t": base.pooled.t_mrmse_m, "r": base.pooled.r_mrmse_rad},
                    "to": {"t": held_out.pooled.t_mrmse_m, "r": held_out.pooled.r_mrmse_rad},
                }
            )
        trial.tried += 1


def _share_left(base: HeldOut, new: HeldOut) -> float:
    """What stays of the errors over 2 s that the page shows: of position times of heading."""
    before, after = base.pooled, new.pooled
    position = after.t_mrmse_m / max(before.t_mrmse_m, 1e-12)
    return position * after.r_mrmse_rad / max(before.r_mrmse_rad, 1e-12)


def _find_twins(name: str, new: HeldOut, base: HeldOut, taken: dict[str, Floats], trial: Trial) -> list[str]:
    """Effects tried before that take the same off the residuals, which are told so too.

    Args:
        name: id of the effect.
        new: with it.
        base: without it.
        taken: what those before took, of unit length, shape (3 n,); this one is added.
        trial: with what was found of them.
    """
    change = (new.residuals - base.residuals) / np.nanstd(base.residuals, axis=0)
    change = np.nan_to_num(change, posinf=0.0, neginf=0.0).ravel()
    taken[name] = change / max(float(np.linalg.norm(change)), 1e-12)
    twins = [other for other in taken if other != name and abs(taken[other] @ taken[name]) > _TWIN]
    for entry in trial.found:
        if entry["id"] in twins:
            entry["twins"] = [*entry["twins"], name]  # type: ignore[misc]
    return twins


def _reaches_further(base: HeldOut, new: HeldOut) -> bool:
    """Whether a planner would feel it: predictions over two seconds get better, and neither error rises."""
    before, after = base.pooled, new.pooled
    falls = after.t_mrmse_m < before.t_mrmse_m or after.r_mrmse_rad < before.r_mrmse_rad
    return falls and not list_rises(before, after)


def _is_sure(problem: Problem, base: HeldOut, new: HeldOut) -> bool:
    """Whether the loss falls significantly, by the test of the diagnosis."""
    part = problem.whole
    tiles = tile_windows(part)
    noise = learn_noise(tiles, part.channels, new.residuals[tiles.rows])
    weights = make_weights(base.residuals, part)
    return compare(noise, weights, base.residuals, new.residuals).is_significant
