"""Actions of a session (add, drop, switch, set, fit, undo), on runs that are prepared in memory."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import msgspec
import numpy as np
import polars as pl

from pipeline import results
from pipeline.core import Floats, Newest
from pipeline.estimation import (
    Errors,
    Estimates,
    EstimationData,
    Fitted,
    HeldOut,
    Input,
    ModelState,
    choose_input,
)
from pipeline.estimation.additions import explain_refusal, explain_refusals
from pipeline.estimation.apportion import apportion, find_half
from pipeline.estimation.error_regions import map_errors, pick_regions
from pipeline.estimation.errors import errors_as_json
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.held_out import score
from pipeline.estimation.intervals import NOTHING, estimate_intervals
from pipeline.estimation.ladder import LadderStep, ModelAssessment, judge_whole, note_fit
from pipeline.estimation.prediction import predict_at_from
from pipeline.models import Effect, Model, ModelFile, Timing, find_effect, name_term
from pipeline.report.motion_view import MotionStage, MotionView
from pipeline.results import RunDiagnosis, SlipBudget, list_excess, read_result
from pipeline.run import HORIZON_S, MotionRun, load_motion_run
from pipeline.sources import Vehicle, load_vehicle
from pipeline.store import Manifest
from pipeline.web import WorkbenchError
from pipeline.web.session import (
    Session,
    SessionFile,
    Step,
    begin_session,
    format_step,
    show_session,
    switch_off,
)
from pipeline.words import describe_region, format_refusals

_MOST_RUNS = 6
_MOST_FITS = 60


@dataclass(frozen=True)
class Judged:
    """A fitted model with its held-out errors and the intervals of its parameters."""

    fitted: Fitted
    held_out: HeldOut
    estimates: Estimates

    @property
    def errors(self) -> Errors:
        """Held-out errors."""
        return self.held_out.pooled

    @property
    def ladder_step(self) -> LadderStep:
        """As a step of a ladder."""
        return LadderStep(self.fitted, self.held_out)

    @property
    def intervals(self) -> Mapping[str, tuple[float, float]]:
        """95 % intervals by label ``effect.parameter``."""
        return self.estimates.shared_intervals


@dataclass(frozen=True)
class Shown:
    """A model on a run, as it is shown.

    Attributes:
        view: rows to draw.
        where: regions with most of its error, as text of `slip diagnose`.
        largest: span with the largest part of its squared error over 2 s [s]; None without predictions.
        predict: function for its body velocities at times of aligned poses [s], shape (n, 3).
        apportion: function for its budgets by cause, given the length scale of the slip modulus [m].
    """

    view: MotionView
    where: list[str]
    largest: tuple[float, float] | None
    predict: Callable[[Floats], Floats]
    apportion: Callable[[float], Sequence[SlipBudget]]


@dataclass
class PreparedRun:
    """One run with one input, prepared for fits and figures; for one thread at a time.

    Attributes:
        manifest: the run's results.
        vehicle: vehicle that it was analyzed with.
        run: the run as arrays.
        data: the estimation data.
        stage: data of the figures.
        lock: lock for the use of these attributes.
    """

    manifest: Manifest
    vehicle: Vehicle
    run: MotionRun
    data: EstimationData
    stage: MotionStage
    lock: threading.RLock = field(default_factory=threading.RLock)
    _fits: Newest[Judged] = field(default_factory=lambda: Newest(_MOST_FITS))
    _errors: Newest[Errors] = field(default_factory=lambda: Newest(_MOST_FITS))
    _second: EstimationData | None = None

    def judge(self, model: Model) -> Judged:
        """Fit a model and score it on held-out data; results are cached.

        Effects at neutral values are fitted by a search; the others start from their present values.
        """

        def fit() -> Judged:
            whole = judge_whole(self.data, model)
            fitted = whole.fitted
            return Judged(fitted, whole.held_out, estimate_intervals(fitted) if model.effects else NOTHING)

        with self.lock:
            return self._fits.recall(model.effects, fit)

    def remember(self, model: Model, judged: Judged) -> None:
        """Cache the fit of a model; callers also cache it for the model as written to its file."""
        with self.lock:
            self._fits.keep(model.effects, judged)

    def apportion(self, model: Model, length_scale_m: float) -> Sequence[SlipBudget]:
        """Budgets by cause of a model, after fitting it; empty for the ideal model."""
        with self.lock:
            assessment = self._assess_ladder(model)
            if not assessment.fitted.model.effects:
                return ()
            return apportion(assessment, length_scale_m=length_scale_m)

    def note_fit(self, file: ModelFile) -> ModelFile:
        """A model file with the data of its fit to this run, if a fit to it gives these values."""
        with self.lock:
            noted = note_fit(file, self._assess_ladder(file.model))
            return noted if _list_keys(noted.model) == _list_keys(file.model) else file

    def _assess_ladder(self, model: Model) -> ModelAssessment:
        whole = self.judge(model)
        return ModelAssessment(self.data, whole.ladder_step, whole.estimates)

    def measure_errors(self, model: Model) -> Errors:
        """Held-out errors of a model, fitted as `judge` does; without intervals."""
        with self.lock:
            known = self._fits.find(model.effects)
            if known is not None:
                return known.errors
            return self._errors.recall(model.effects, lambda: judge_whole(self.data, model).errors)

    def score(self, model: Model, timing: Sequence[float]) -> Errors:
        """Errors of a model with its present values: held out where a fit gave these, else as they are."""
        with self.lock:
            known = self.find_fit(model)
            return score(self.data, self.state(model, timing)).pooled if known is None else known.errors

    def find_fit(self, model: Model) -> Judged | None:
        """The known fit that gave a model its present values; None if none did."""
        known = self._fits.find(model.effects)
        return known if known is not None and _list_keys(known.fitted.model) == _list_keys(model) else None

    def state(self, model: Model, timing: Sequence[float]) -> ModelState:
        """A model with the recording's delays."""
        return ModelState(model.effects, (Timing(timing[1]),))

    def show(
        self,
        model: Model,
        timing: Sequence[float],
        ladder: Sequence[Mapping[str, object]],
        floor: Mapping[str, object] | None,
    ) -> Shown:
        """Prepare a model with its present values for the figures."""
        with self.lock:
            state = self.state(model, timing)
            whole, run_residuals = self.data.whole, self.data.residuals_by_run[0]
            residual = whole.find_residuals(state)
            regions = map_errors(whole, residual, whole.find_places())
            steps = [read_result(step, results.Step) for step in ladder]
            least = None if floor is None else read_result(floor, results.Errors)
            view = self.stage.view(state, steps, least)
            return Shown(
                view=view,
                largest=_find_largest(view, steps[-1], least),
                where=[describe_region(one) for one in pick_regions(regions, residual, whole.noise)],
                predict=partial(predict_at_from, run_residuals, state.effects_of(0), state.timing[0]),
                apportion=partial(self.apportion, model),
            )

    def second_data(self) -> EstimationData:
        """Second data of the run, for trials of many effects in the background."""
        with self.lock:
            if self._second is None:
                self._second = EstimationData([self.run], self.vehicle, self.data.source)
            return self._second


def _find_largest(
    view: MotionView, last: results.Step, floor: results.Errors | None
) -> tuple[float, float] | None:
    """The span with the largest part of the squared error that is furthest above its noise floor."""
    excess = list_excess(RunDiagnosis(ladder=(last,), noise_floor=floor))
    is_heading = excess and max(excess, key=excess.__getitem__) == "r_mrmse_rad"
    known = view.horizon_errors.select("t", error="model_yaw" if is_heading else "model")
    known = known.filter(pl.col("error").is_finite())
    if known.is_empty():
        return None
    # Predictions are numbered by the middle of their 2 s.
    number = np.floor((known["t"].to_numpy() + 0.5 * HORIZON_S) / HORIZON_S).astype(np.int64)
    start, end, _ = find_half(number, np.square(known["error"].to_numpy()))[1][0]
    return start, end


class RunCache:
    """Cache of the most recently opened runs."""

    def __init__(self) -> None:
        self._prepared = Newest[PreparedRun](_MOST_RUNS)
        self._runs = Newest[tuple[Vehicle, MotionRun]](_MOST_RUNS)
        self._lock = threading.Lock()
        self._making: dict[tuple[str, str, str], threading.Lock] = {}

    def load(self, manifest: Manifest) -> tuple[Vehicle, MotionRun]:
        """The vehicle and the run as arrays; cached."""
        key = (manifest.run, manifest.key)
        with self._lock:
            known = self._runs.find(key)
        if known is not None:
            return known
        vehicle = load_vehicle(manifest)
        loaded = (vehicle, load_motion_run(manifest, vehicle))
        with self._lock:
            return self._runs.keep(key, loaded)

    def list_inputs(self, manifest: Manifest) -> list[str]:
        """Available inputs for models of a run, the default first."""
        _, run = self.load(manifest)
        sources = [Input.COMMAND] if run.commands is not None else []
        sources += [Input.MEASURED] if run.wheels is not None else []
        return [source.value for source in sources]

    def prepared(self, manifest: Manifest, source: str | None) -> PreparedRun:
        """The prepared run for an input; cached.

        Raises:
            MotionError: the run has too few data to compare.
        """
        vehicle, run = self.load(manifest)
        chosen = choose_input([run], source).source
        key = (manifest.run, manifest.key, chosen.value)
        with self._lock:
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                known = self._prepared.find(key)
            if known is not None:
                return known
            data = EstimationData([run], vehicle, chosen)
            velocities = manifest.read("velocities") if "velocities" in manifest.tables else None
            prepared = PreparedRun(manifest, vehicle, run, data, MotionStage(data, velocities))
            with self._lock:
                return self._prepared.keep(key, prepared)


def _list_keys(model: Model) -> list[object]:
    return [effect.rounded.key for effect in model.effects]


def step_as_json(effects: Sequence[str], errors: Errors) -> dict[str, object]:
    """A step of the ladder as in the JSON of `slip diagnose`."""
    return {"effects": list(effects), **errors_as_json(errors)}


if TYPE_CHECKING:
    LadderSteps = Mapping[tuple[str, ...], dict[str, object]]


def open_session(file: SessionFile, prepared: PreparedRun) -> Session:
    """The stored session of a run, or a new one if there is none or the results have changed.

    Steps that can no longer be opened are dropped.
    """
    session = file.read()
    source = prepared.data.source.value
    if session is not None and (session.key != prepared.manifest.key or session.input != source):
        session = None
    session = session.move(0) if session is not None else None
    while session is not None and session.steps and not _can_open(file, session):
        session = session.drop(session.at)
    if session is None or not session.steps:
        session = begin_session(prepared.manifest.run, prepared.manifest.key, source, prepared.vehicle)
        editor = Editor(file, prepared, session)
        fitted = editor.fit_anew(editor.model, session.step.order, session.step.said, afresh=True)
        session = msgspec.structs.replace(fitted, steps=[fitted.step], at=0)
        file.write(session)
    return session


def move(file: SessionFile, session: Session, by: int) -> Session:
    """The session one step back (-1) or forward (1); steps that can no longer be opened are dropped."""
    while True:
        moved = session.move(by)
        if moved.at == session.at or _can_open(file, moved):
            return moved
        session = session.drop(moved.at)


def _can_open(file: SessionFile, session: Session) -> bool:
    try:
        show_session(session, file.parse(session.step.model))
    except Exception:  # noqa: BLE001 - whatever a file holds that was written elsewhere
        return False
    return True


@dataclass(frozen=True)
class Editor:
    """Operations on a session; each returns a changed copy.

    Attributes:
        file: file of the session.
        prepared: the run.
        session: the session before the change.
        diagnosed: what the diagnosis of the run found, with its values: fits of these effects begin there.
    """

    file: SessionFile
    prepared: PreparedRun
    session: Session
    diagnosed: Sequence[Effect] = ()

    @property
    def model(self) -> Model:
        """The model before the change, including the effects that are switched off."""
        return self.file.parse(self.session.step.model).model

    def begin(self, model: Model) -> Model:
        """The model from which a fit begins: effects of the diagnosis have the values that it gives them.

        So a model has the errors that the diagnosis gives it, whatever was fitted or set before, and in
        whichever order its effects were added.
        """
        return model.swap(
            *(one for one in self.diagnosed if one.id in model and not model.effect(one.id).fixed)
        )

    def add_effect(self, effect: Effect | str, *, anyway: bool = False) -> Session:
        """Add an effect to the model and fit the whole model.

        Raises:
            WorkbenchError: ``no_help``, see `add_effects`.
        """
        named = {one.id: one for one in self.diagnosed}
        made = (named.get(effect) or find_effect(effect)()) if isinstance(effect, str) else effect
        return self.add_effects([made], f"+ {name_term(made.id)}", anyway=anyway)

    def add_effects(self, effects: Sequence[Effect], said: str, *, anyway: bool) -> Session:
        """Add several effects to the model at once, and fit the whole model.

        Raises:
            WorkbenchError: ``no_help``, an effect is refused and ``anyway`` is false.
        """
        model, step = self.begin(self.model), self.session.step
        for made in effects:
            model = model + made
        changed = self.fit_anew(model, [*step.order, *(made.id for made in effects)], said)
        refusals = {made.id: why for made in effects if (why := changed.step.refused.get(made.id))}
        if refusals and not anyway:
            raise WorkbenchError(
                "no_help",
                f"{format_refusals(refusals)}: the model is unchanged",
                where=self.session.run,
                hint="Choose another effect, or apply it anyway",
            )
        return changed

    def drop_effect(self, name: str) -> Session:
        """Remove an effect and fit the rest."""
        step = self.session.step
        order, off = ([each for each in names if each != name] for names in (step.order, step.off))
        return self.fit_anew(self.begin(self.model) - name, order, f"\u2212 {name}", off=off)

    def fit(self) -> Session:
        """Fit all values that are not locked, starting from the present ones."""
        return self.fit_anew(self.model, self.session.step.order, "fit", afresh=True)

    def switch_effect(self, name: str) -> Session:
        """Switch an effect off or on without a fit, to show its contribution immediately."""
        model, off = self.model, self.session.step.off
        model.effect(name)
        off = [each for each in off if each != name] if name in off else [*off, name]
        return self._score_by_hand(model, f"{name} {'off' if name in off else 'on'}", off)

    def set_value(self, name: str, values: Mapping[str, float]) -> Session:
        """Set values of an effect by hand, without a fit."""
        changes = ", ".join(f"{key} = {value:.4g}" for key, value in values.items())
        return self._score_by_hand(
            self.model.change(name, **values), f"{name}: {changes}", self.session.step.off
        )

    def lock_value(self, name: str, parameter: str) -> Session:
        """Lock a value against fits, or unlock it."""
        parsed = self.file.parse(self.session.step.model)
        effect = parsed.model.effect(name)
        changed = effect.loosen(parameter) if parameter in effect.fixed else effect.fix(parameter)
        text = format_step(parsed.model.swap(changed), parsed.intervals)
        said = f"{name}.{parameter} {'locked' if parameter in changed.fixed else 'unlocked'}"
        return self.session.push(msgspec.structs.replace(self.session.step, said=said, model=text))

    def _score_by_hand(self, model: Model, said: str, off: list[str]) -> Session:
        step = self.session.step
        errors = self.prepared.score(switch_off(model, off), step.timing)
        known = self.prepared.find_fit(switch_off(model, off))
        _require_numbers(errors, self.session.run)
        shown = [name for name in step.order if name not in off]
        ladder = [ladder_step for ladder_step in step.ladder if set(_effects_of(ladder_step)) < set(shown)]
        ladder.append(step_as_json(shown, errors))
        text = format_step(model, {} if known is None else known.intervals)
        return self.session.push(
            msgspec.structs.replace(
                step, said=said, model=text, off=off, ladder=ladder, by_hand=known is None
            )
        )

    def fit_anew(
        self, model: Model, order: list[str], said: str, *, off: list[str] | None = None, afresh: bool = False
    ) -> Session:
        """Fit a model; the steps of its ladder are in the order in which effects were added.

        Args:
            model: model including the effects that are switched off.
            order: order of its effects.
            said: short text of the action.
            off: effects that are switched off; None for the present ones.
            afresh: whether to refit steps that were fitted before.
        """
        prepared, off = self.prepared, self.session.step.off if off is None else off
        known = {} if afresh else _list_known_steps(self.session.step)
        whole = prepared.judge(switch_off(model, off))
        _require_numbers(whole.errors, self.session.run)
        fitted = whole.fitted.model
        shown = [name for name in order if name in fitted]
        ladder = []
        for count in range(len(shown)):
            ladder_step = known.get(tuple(shown[:count]))
            if ladder_step is None:
                below = self.begin(fitted.keep(shown[:count]))
                ladder_step = step_as_json(shown[:count], prepared.measure_errors(below))
            ladder.append(ladder_step)
        ladder.append(step_as_json(shown, whole.errors))
        delays = (prepared.run.alignment.heading_delay_s, whole.fitted.state.timing[0].wheel_delay_s)
        text = format_step(model.swap(*fitted.effects), whole.intervals)
        prepared.remember(switch_off(self.file.parse(text).model, off), whole)
        step = Step(
            said=said,
            model=text,
            order=order,
            off=off,
            timing=delays,
            ladder=ladder,
            without={name: prepared.score(fitted - name, delays).t_mrmse_m for name in shown},
            refused=self._explain_refusals(whole, shown),
        )
        return self.session.push(step)

    def _explain_refusals(self, whole: Judged, shown: Sequence[str]) -> dict[str, str]:
        """Reasons why effects of a fitted model are refused, by id; earlier reasons are preserved."""
        step, data = self.session.step, self.prepared.data
        refusals: dict[str, str] = {}
        if not set(shown) <= set(step.order):
            before = self.prepared.judge(switch_off(self.model, step.off))
            refusals = explain_refusals(data, before.ladder_step, whole.ladder_step, lambda: whole.intervals)
        conditions = data.conditions
        for name in (name for name in shown if name in step.order):
            why = explain_refusal(whole.fitted.model.effect(name), whole.intervals, conditions)
            if why := why or step.refused.get(name):
                refusals[name] = why
        return refusals


def _effects_of(ladder_step: Mapping[str, object]) -> list[str]:
    names = ladder_step.get("effects")
    return [str(name) for name in names] if isinstance(names, list) else []


def _require_numbers(errors: Errors, run: str) -> None:
    if not (math.isfinite(errors.t_mrmse_m) and math.isfinite(errors.r_mrmse_rad)):
        hint = "The model is unchanged; take other values or another formula."
        raise WorkbenchError(
            "not_finite", "with that the model predicts no finite motion on this run", where=run, hint=hint
        )


def _list_known_steps(step: Step) -> LadderSteps:
    """Fitted ladder steps by their effects; after a manual change the last one is not fitted."""
    rungs = step.ladder[:-1] if step.by_hand else step.ladder
    return {tuple(_effects_of(ladder_step)): ladder_step for ladder_step in rungs}


def keep_floor(session: Session, prepared: PreparedRun, diagnosis: RunDiagnosis | None) -> Session:
    """The session with the noise floor of its run: that of its diagnosis, else what the ideal model shows.

    Args:
        session: a session of the run.
        prepared: the run.
        diagnosis: of the run; None without one.
    """
    known = None
    if diagnosis is not None:
        paths = {name: one.noise_floor for name, one in diagnosis.by_path.items()}
        known = {**paths, diagnosis.input: diagnosis.noise_floor}.get(prepared.data.source.value)
    floor: dict[str, object] = dict(
        errors_as_json(estimate_floor(prepared.data)) if known is None else results.to_json(known)
    )
    return session if session.floor == floor else msgspec.structs.replace(session, floor=floor)
