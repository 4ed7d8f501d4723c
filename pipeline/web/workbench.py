"""State and logic of the server: prepared runs, sessions, trials of effects, and jobs."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.api.model_changes import carry_models
from pipeline.core import Newest, SlipError
from pipeline.estimation import EstimationData
from pipeline.estimation.additions import Addition, Tries
from pipeline.estimation.stored_diagnosis import find_diagnosis, read_stored_diagnosis
from pipeline.models import Model, ModelFile, format_model, write_model
from pipeline.results import Errors, RunDiagnosis, as_written
from pipeline.store import DIAGNOSIS, Manifest, Store, StoreError, locate_beside, make_folder
from pipeline.web import Ask, Slot, WorkbenchError, evaluating
from pipeline.web.cards import describe_effect, list_catalogue, make_formula, show_addition, show_parameter
from pipeline.web.jobs import Jobs
from pipeline.web.prepared import PreparedRun, prepare_run
from pipeline.web.runs import find_run, summarize_run
from pipeline.web.session import Session, open_session
from pipeline.words import describe_end, describe_partial, diagnosis_as_json

_MOST_RUNS = 4
_MOST_SESSIONS = 8


@dataclass
class Trial:
    """Trial of the highest-ranked effects as additions to one model, in the background.

    Attributes:
        prepared: the run.
        model: the model with its present values.
        total: number of effects to try; None before they are ranked.
        tried: number of effects tried so far.
        helpful: effects that reduce the error, as JSON, in order of the decrease of both errors over 2 s.
        stopped: whether another one takes its place.
    """

    prepared: PreparedRun
    model: Model
    total: int | None = None
    tried: int = 0
    helpful: list[dict[str, object]] = field(default_factory=list)
    stopped: bool = False

    def run(self) -> None:
        """Try each effect, on data of its own: meanwhile the session uses those of the run."""
        prepared, model = self.prepared, self.model
        additions = list[Addition]()
        with suppress(SlipError), evaluating(prepared.manifest.run):
            data = EstimationData([prepared.run], prepared.vehicle, prepared.data.source)
            tries = Tries(data, model)
            self.total = len(tries.candidates)
            for addition in tries.try_each():
                additions += [] if addition is None else [addition]
                self.helpful = [
                    show_addition(one, tries.before, model, prepared.asked) for one in tries.fold(additions)
                ]
                self.tried += 1
                if self.stopped:
                    return
        # Of a model that cannot be fitted, no addition can be tried.
        self.total = self.tried

    def show(self) -> dict[str, object]:
        """The trial as JSON."""
        return {
            "done": self.tried == self.total,
            "tried": self.tried,
            "total": self.total,
            "found": self.helpful,
        }


class Workbench:
    """The workbench without its HTTP layer; it does one thing at a time.

    Args:
        results: the results folder.
        jobs: analyses and diagnoses in the background.
    """

    def __init__(self, results: Path, jobs: Jobs) -> None:
        self.results = results
        self.store = Store(results)
        self.jobs = jobs
        self._runs = Newest[PreparedRun](_MOST_RUNS)
        self._sessions = Newest[Session](_MOST_SESSIONS)
        self._trials: dict[Slot, Trial] = {}
        self._lock = threading.Lock()

    def answer(self, ask: Ask) -> dict[str, object]:
        """Apply a request to a session, and return the content of the page.

        Raises:
            SlipError: it cannot be done; the session is unchanged.
        """
        with self._lock, evaluating(ask.run):
            session = self._find(ask)
            changed = self._change(session, ask)
            if ask.action == "preview":
                redrawn = session.prepared.figures.redraw(changed.show(), ask.stretch)
                return {"session": show_session(changed), **redrawn}
            shown = self._show(changed, ask)
            # A step that cannot be shown is not kept.
            self._sessions.keep((ask.slot, ask.run), changed)
            return shown

    def draw(self, ask: Ask) -> dict[str, object]:
        """Figures of a session, or of one of its tabs."""
        with self._lock, evaluating(ask.run):
            session = self._find(ask)
            return session.prepared.figures.draw(session.show(), ask.tab, ask.stretch)

    def redraw(self, ask: Ask) -> dict[str, object]:
        """Rows of a session's figures that depend on the model."""
        with self._lock, evaluating(ask.run):
            session = self._find(ask)
            return session.prepared.figures.redraw(session.show(), ask.stretch)

    def save(self, ask: Ask) -> dict[str, object]:
        """Write the model file of a session.

        The data of its fit are written as well, unless values were set by hand since.
        """
        file = self._make_file(ask)
        suffix = ".toml" if ask.slot == "a" else f".{ask.slot}.toml"
        path = locate_beside(self.results, "models", ask.run, suffix)
        make_folder(path.parent)
        write_model(file, path)
        return {"path": str(path)}

    def validate(self, ask: Ask) -> dict[str, object]:
        """Errors of a session's model on another run, whose numbers are not fitted to it.

        They are those of `slip model compare`; other requests need not wait for them.
        """
        file, there = self._make_file(ask), find_run(self.store, ask.on)
        if refusal := summarize_run(there)["refusal"]:
            hint = "No error on it has a meaning: choose another run."
            raise WorkbenchError("no_fit", str(refusal), where=ask.on, hint=hint)
        with evaluating(ask.on):
            ((_, item),) = carry_models({ask.run: file}, [there], source=ask.input).rows
        errors = {"ideal": item.ideal, "carried": item.carried, "own": item.own}
        return {
            "on": ask.on,
            **{name: _errors(one.pooled) for name, one in errors.items()},
            "warning": item.warning,
        }

    def format_model(self, ask: Ask) -> str:
        """The model file of a session as text."""
        return format_model(self._make_file(ask))

    def diagnose(self, ask: Ask) -> dict[str, object]:
        """Start the diagnosis of a run."""
        return {"job": self.jobs.diagnose(find_run(self.store, ask.run)).show()}

    def _make_file(self, ask: Ask) -> ModelFile:
        with self._lock, evaluating(ask.run):
            return self._find(ask).format_file()

    def _find(self, ask: Ask) -> Session:
        """The session of a run, a new one if there is none or it is of other results or of another input."""
        manifest = find_run(self.store, ask.run)
        diagnosis = self._read_diagnosis(manifest)
        known = self._sessions.find((ask.slot, ask.run))
        if known is not None:
            run, source = known.prepared.manifest, known.prepared.data.source.value
            if run.key == manifest.key and ask.input in (None, source):
                return replace(known, diagnosis=diagnosis)
        prepared = self._runs.find((ask.run, manifest.key, ask.input))
        if prepared is None:
            prepared = prepare_run(manifest, ask.input)
            for name in (ask.input, prepared.data.source.value):
                self._runs.keep((ask.run, manifest.key, name), prepared)
        return self._sessions.keep((ask.slot, ask.run), open_session(prepared, diagnosis))

    def _read_diagnosis(self, manifest: Manifest) -> RunDiagnosis | None:
        if DIAGNOSIS not in manifest.files:
            return find_diagnosis(self.results, manifest)
        with suppress(StoreError):
            return read_stored_diagnosis(manifest)
        return None

    def _change(self, session: Session, ask: Ask) -> Session:
        fits = ("add", "formula", "drop", "fit", "try")
        if ask.action in fits and (refusal := summarize_run(session.prepared.manifest)["refusal"]):
            hint = "No fit to it has a meaning: open another run."
            raise WorkbenchError("no_fit", str(refusal), where=ask.run, hint=hint)

        def add_formula() -> Session:
            made = make_formula(ask.effect, ask.channel, ask.formula, ask.parameters)
            return session.add([made], anyway=ask.anyway)

        def set_value() -> Session:
            return session.set_value(ask.effect, ask.parameter, ask.value)

        changes: dict[str, Callable[[], Session]] = {
            "open": lambda: session,
            "add": lambda: session.add(ask.effects or [ask.effect], anyway=ask.anyway),
            "formula": add_formula,
            "drop": lambda: session.drop(ask.effect),
            "set": set_value,
            "preview": set_value,
            "lock": lambda: session.lock(ask.effect, ask.parameter),
            "fit": session.fit,
            "undo": lambda: session.move(-1),
            "redo": lambda: session.move(1),
            "try": lambda: self._try(session, ask),
        }
        return changes[ask.action]()

    def _try(self, session: Session, ask: Ask) -> Session:
        """Try further effects; unasked only if nothing that the diagnosis found helps."""
        is_asked = ask.anyway or not session.list_offers()
        if is_asked and self._find_trial(session, ask.slot) is None:
            if ask.slot in self._trials:
                self._trials[ask.slot].stopped = True
            trial = Trial(session.prepared, session.begin(session.step.model))
            self._trials[ask.slot] = trial
            threading.Thread(target=trial.run, daemon=True).start()
        return session

    def _find_trial(self, session: Session, slot: Slot) -> Trial | None:
        """The trial of the current model, if it is the latest of this side of the page."""
        trial, model = self._trials.get(slot), session.begin(session.step.model)
        is_its = trial is not None and trial.prepared is session.prepared
        return trial if trial is not None and is_its and trial.model.effects == model.effects else None

    def _show(self, session: Session, ask: Ask) -> dict[str, object]:
        prepared, diagnosis = session.prepared, session.diagnosis
        missing = [one.id for one in session.named if one.id not in session.step.order]
        trial = self._find_trial(session, ask.slot)
        return {
            "session": show_session(session),
            "run": summarize_run(prepared.manifest),
            "inputs": prepared.inputs,
            "catalogue": list_catalogue(prepared.vehicle),
            "diagnosis": None if diagnosis is None else diagnosis_as_json(diagnosis),
            "named": session.list_offers(),
            "missing": missing,
            "partial": describe_partial(missing),
            "trial": None if trial is None else trial.show(),
        }


def show_session(session: Session) -> dict[str, object]:
    """The state of a session as JSON."""
    step, at, floor = session.step, session.at, session.floor
    done, remains = describe_end(step.ladder[-1], floor)
    later = session.steps[at + 1 :]
    return {
        "run": session.prepared.manifest.run,
        "input": session.prepared.data.source.value,
        "said": step.said,
        "by_hand": step.by_hand,
        "done": done,
        "remains": remains,
        "ideal": _errors(step.ladder[0]),
        "errors": _errors(step.ladder[-1]),
        "before": _errors(session.steps[at - 1].ladder[-1]) if at else None,
        "floor": _errors(floor),
        "effects": [show_card(session, name) for name in step.order],
        "undo": step.said if at else None,
        "redo": later[0].said if later else None,
    }


def show_card(session: Session, name: str) -> dict[str, object]:
    """Card of one effect of the current model."""
    step, effect = session.step, session.step.model.effect(name)
    file = ModelFile(step.model, numbers=step.numbers)
    return {
        **describe_effect(effect, step.model, session.prepared.asked),
        "without_m": step.without.get(name),
        "refused": step.refused.get(name),
        "parameters": [
            show_parameter(effect, one, file.find_number(effect, one), is_fitted=not step.by_hand)
            for one in effect.parameters
            if math.isfinite(effect.values[one.name])
        ],
    }


def _errors(errors: Errors) -> dict[str, float]:
    return {"t": as_written(errors, "t_mrmse_m"), "r": as_written(errors, "r_mrmse_rad")}
