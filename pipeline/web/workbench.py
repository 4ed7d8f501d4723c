"""State and logic of the server: results, prepared runs, sessions, trials of effects, and jobs."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.core import Newest, SlipError
from pipeline.estimation import Errors
from pipeline.estimation.additions import Addition, Tries, explain_refusal, rank_named
from pipeline.models import Effect, FormulaEffect, Model, write_model
from pipeline.results import RunDiagnosis, find_refusal, read_findings, read_model, read_suggestion
from pipeline.store import Manifest, Store, make_folder
from pipeline.web import Ask, WorkbenchError, evaluating
from pipeline.web.actions import Editor, PreparedRun, RunCache, Shown, keep_floor, move, open_session
from pipeline.web.jobs import Jobs
from pipeline.web.session import (
    Session,
    SessionFile,
    list_catalogue,
    list_formulas,
    make_formula,
    show_session,
    summarize_effect,
    switch_off,
)
from pipeline.web.session_figures import FigureCache
from pipeline.web.stored_runs import (
    find_plan,
    find_run,
    read_diagnosis,
    read_summary,
    summarize_run,
)
from pipeline.words import diagnosis_as_json

_MOST_KEPT = 40
_FITS = frozenset({"add", "add_named", "add_found", "formula", "drop", "fit", "try"})
"""Actions that fit a model."""


@dataclass
class Trial:
    """Trial of the highest-ranked effects as additions to one model.

    Attributes:
        owner: client that requested it.
        total: number of effects to try; None before they are ranked.
        tried: number of effects tried so far.
        additions: effects that reduce the error, as JSON.
        stopped: whether a stop has been requested.
    """

    owner: str
    total: int | None = None
    tried: int = 0
    additions: list[dict[str, object]] = field(default_factory=list)
    stopped: bool = False

    @property
    def is_broken(self) -> bool:
        """Whether it was stopped before it was complete."""
        return self.stopped and self.tried != self.total

    def show(self) -> dict[str, object]:
        """The trial as JSON, additions in order of the decrease of both errors over 2 s."""
        return {
            "done": self.tried == self.total,
            "tried": self.tried,
            "total": self.total,
            "found": self.additions,
        }


class Trials:
    """Running and finished trials by run, input and model, one thread each; a new one stops older ones."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], Trial] = {}
        self._lock = threading.Lock()
        self._in_front = 0
        self._idle = threading.Event()
        self._idle.set()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Pause the trials while a client waits for an answer."""
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
        """The trial of a model, unless there is none or it was stopped before it was complete."""
        with self._lock:
            trial = self._known.get(_key(prepared, model))
        return None if trial is None or trial.is_broken else trial

    def begin(self, prepared: PreparedRun, model: Model, owner: str) -> Trial:
        """Try the highest-ranked effects as additions to a model, in the background.

        Args:
            prepared: the run.
            model: model with its present values.
            owner: client; each has one trial, and a new one ends the previous one.
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
            trial = Trial(owner)
            self._known[key] = trial
        work = (prepared, model, trial, self._idle)
        threading.Thread(target=_try_all, args=work, daemon=True).start()
        return trial


def _key(prepared: PreparedRun, model: Model) -> tuple[object, ...]:
    manifest = prepared.manifest
    return (manifest.run, manifest.key, prepared.data.source.value, model.effects)


def _try_all(prepared: PreparedRun, model: Model, trial: Trial, idle: threading.Event) -> None:
    try:
        with evaluating(prepared.manifest.run):
            _try_each(prepared, model, trial, idle)
    except SlipError:
        # The model cannot be fitted, so no addition can be tried.
        trial.tried = trial.total = 0


def _try_each(prepared: PreparedRun, model: Model, trial: Trial, idle: threading.Event) -> None:
    idle.wait()
    tries = Tries(prepared.second_data(), model)
    trial.total, additions = len(tries.candidates), list[Addition]()
    for addition in tries.try_each():
        additions += [] if addition is None else [addition]
        trial.additions = [show_addition(one, tries.before, model) for one in tries.fold(additions)]
        trial.tried += 1
        idle.wait()
        if trial.stopped:
            return


def show_addition(addition: Addition, before: Errors, model: Model) -> dict[str, object]:
    """Change of a model's errors over 2 s by an additional effect, as JSON."""
    effect, after = addition.effect, addition.errors
    return {
        "id": effect.id,
        "about": summarize_effect(effect),
        "sentence": "" if effect.is_neutral else effect.describe_motion(model.vehicle, model),
        "left": addition.remaining,
        "helps": addition.helps,
        "formula": list_formulas(effect),
        "twins": list(addition.twins),
        "from": {"t": before.t_mrmse_m, "r": before.r_mrmse_rad},
        "to": {"t": after.t_mrmse_m, "r": after.r_mrmse_rad},
    }


def rank_offers(editor: Editor, diagnosis: RunDiagnosis | None) -> list[dict[str, object]]:
    """What the diagnosis of a run has beyond a session, as JSON, the largest gain first.

    These are its effects and the formula that it suggests, each with the errors of the model once it is in.
    """
    prepared, step = editor.prepared, editor.session.step
    file = None if diagnosis is None else read_model(diagnosis)
    intervals = {} if file is None else file.intervals
    missing = (one for one in editor.diagnosed if one.id not in step.order)
    sound = Model(prepared.vehicle, tuple(one for one in missing if explain_refusal(one, intervals) is None))
    with prepared.lock:
        offered = prepared.data.active_effects(sound)
        before = prepared.score(switch_off(editor.model, step.off), step.timing)
        model = switch_off(editor.begin(editor.model), step.off)
        ranked = rank_named(prepared.measure_errors, model, before, offered)
    return [show_addition(one, before, model) for one in ranked]


_MOST_ALBUMS = 6


class Sessions:
    """The workbench without its HTTP layer.

    Args:
        results: the results folder.
        jobs: jobs of uploaded logs, diagnoses and plans.
    """

    def __init__(self, results: Path, jobs: Jobs) -> None:
        self.results = results
        self.store = Store(results)
        self.jobs = jobs
        self._cache = RunCache()
        self._trials = Trials()
        self._figures = Newest[FigureCache](_MOST_ALBUMS)
        self._lock = threading.Lock()

    def answer(self, ask: Ask) -> dict[str, object]:
        """Apply a request to a session, store the session, and return the content of the page.

        Raises:
            SlipError: it cannot be done; the session is unchanged.
        """
        file, prepared = self._find(ask)
        with self._trials.waiting(), prepared.lock, evaluating(ask.run):
            session = open_session(file, prepared)
            if ask.action == "preview":
                return self._preview(self._edit(file, prepared, session), ask)
            diagnosis = read_diagnosis(self.results, prepared.manifest)
            changed = keep_floor(self._change(file, prepared, session, ask), prepared, diagnosis)
            # A step that cannot be shown is not stored.
            shown = self._show(file, prepared, changed)
            if changed is not session:
                file.write(changed)
            return shown

    def draw(self, ask: Ask) -> dict[str, object]:
        """Figures of a session, or of one of its tabs."""
        return self._look(ask, lambda cache, shown: cache.draw(shown, ask.tab, ask.stretch))

    def redraw(self, ask: Ask) -> dict[str, object]:
        """Rows of a session's figures that depend on the model."""
        return self._look(ask, lambda cache, shown: cache.redraw(shown, ask.stretch))

    def save(self, ask: Ask) -> dict[str, object]:
        """Write the model file of a session, without the effects that are switched off.

        The data of its fit are written as well, unless values were set by hand since.
        """
        file, session = self._read_session(ask.run, ask.slot)
        parsed = file.parse(session.step.model)
        written = replace(parsed, model=switch_off(parsed.model, session.step.off))
        if written.model.effects and not session.step.by_hand:
            with evaluating(ask.run):
                written = self._find(ask)[1].note_fit(written)
        make_folder(file.model_path.parent)
        write_model(written, file.model_path)
        return {"path": str(file.model_path)}

    def diagnose(self, ask: Ask) -> dict[str, object]:
        """Start the diagnosis of a run."""
        return {"job": self.jobs.diagnose(find_run(self.store, ask.run)).show()}

    def plan(self, ask: Ask) -> dict[str, object]:
        """Start the plan of a drive that decides the open questions of a run."""
        return {"job": self.jobs.plan(find_run(self.store, ask.run), ask.area).show()}

    def format_model(self, run: str, slot: str) -> str:
        """The model file of a session as text."""
        _, session = self._read_session(run, slot)
        return session.step.model

    def _find(self, ask: Ask) -> tuple[SessionFile, PreparedRun]:
        manifest = find_run(self.store, ask.run)
        file = SessionFile(self.results, ask.run, ask.slot)
        stored = None if ask.input is not None else file.read()
        source = stored.input if stored is not None and stored.key == manifest.key else ask.input
        return file, self._cache.prepared(manifest, source)

    def _read_session(self, run: str, slot: str) -> tuple[SessionFile, Session]:
        find_run(self.store, run)
        file = SessionFile(self.results, run, slot)
        session = file.read()
        if session is None:
            raise WorkbenchError(
                "no_such_desk", "there is no model of this run", where=run, hint="Open the run first."
            )
        return file, session

    def _change(self, file: SessionFile, prepared: PreparedRun, session: Session, ask: Ask) -> Session:
        editor = self._edit(file, prepared, session)
        if ask.action in _FITS and (refusal := find_refusal(read_findings(read_summary(prepared.manifest)))):
            hint = "No fit to it has a meaning: open another run."
            raise WorkbenchError("no_fit", refusal, where=ask.run, hint=hint)

        def make() -> Effect:
            return make_formula(ask.effect, ask.channel, ask.formula, ask.parameters)

        named = {effect.id for effect in editor.diagnosed}
        changes: dict[str, Callable[[], Session]] = {
            "open": lambda: session,
            # The diagnosis tested its effects together with all others.
            "add": lambda: editor.add_effect(ask.effect, anyway=ask.anyway or ask.effect in named),
            "add_named": lambda: self._add_named(editor, ask),
            "add_found": lambda: self._add_suggestion(editor, ask),
            "formula": lambda: editor.add_effect(make(), anyway=ask.anyway),
            "drop": lambda: editor.drop_effect(ask.effect),
            "switch": lambda: editor.switch_effect(ask.effect),
            "set": lambda: editor.set_value(ask.effect, {ask.parameter: ask.value}),
            "lock": lambda: editor.lock_value(ask.effect, ask.parameter),
            "fit": editor.fit,
            "undo": lambda: move(file, session, -1),
            "redo": lambda: move(file, session, 1),
            "try": lambda: self._begin_trial(editor, ask),
        }
        return changes[ask.action]()

    def _edit(self, file: SessionFile, prepared: PreparedRun, session: Session) -> Editor:
        """The operations on a session, with what the diagnosis of its run found."""
        diagnosis = read_diagnosis(self.results, prepared.manifest)
        formula = () if diagnosis is None else read_suggestion(diagnosis, prepared.vehicle)
        return Editor(file, prepared, session, (*_list_named(diagnosis), *formula))

    def _add_named(self, editor: Editor, ask: Ask) -> Session:
        diagnosis = read_diagnosis(self.results, editor.prepared.manifest)
        missing = _list_missing(diagnosis, editor.session)
        if not missing:
            is_diagnosed = diagnosis is not None
            raise WorkbenchError(
                "nothing_to_add" if is_diagnosed else "not_diagnosed",
                "the model has all effects of the diagnosis"
                if is_diagnosed
                else "this run was not diagnosed",
                where=ask.run,
                hint="Look for other effects." if is_diagnosed else "Diagnose it first.",
            )
        return editor.add_effects(missing, f"+ all {len(missing)} of the diagnosis", anyway=True)

    def _add_suggestion(self, editor: Editor, ask: Ask) -> Session:
        formulas = [effect for effect in editor.diagnosed if isinstance(effect, FormulaEffect)]
        if not formulas:
            raise WorkbenchError(
                "no_formula", "no formula was found on this run", where=ask.run, hint="Diagnose it first."
            )
        return editor.add_effect(formulas[-1], anyway=True)

    def _begin_trial(self, editor: Editor, ask: Ask) -> Session:
        """Rank further effects to add.

        Requires an explicit request while something that the diagnosis found helps.
        """
        file, session = editor.file, editor.session
        model = switch_off(editor.begin(editor.model), session.step.off)
        diagnosis = read_diagnosis(self.results, editor.prepared.manifest)
        if ask.anyway or not any(one["helps"] for one in rank_offers(editor, diagnosis)):
            self._trials.begin(editor.prepared, model, f"{file.slot} {file.run}")
        return session

    def _preview(self, editor: Editor, ask: Ask) -> dict[str, object]:
        """Preview of a value while the slider moves; nothing is stored."""
        trial = editor.set_value(ask.effect, {ask.parameter: ask.value})
        shown = _view(editor.file, editor.prepared, trial)
        figures = self._figures_of(editor.prepared.manifest)
        redrawn = figures.redraw(shown, ask.stretch)
        return {"session": show_session(trial, editor.file.parse(trial.step.model)), **redrawn}

    def _show(self, file: SessionFile, prepared: PreparedRun, session: Session) -> dict[str, object]:
        editor = self._edit(file, prepared, session)
        model = switch_off(editor.begin(editor.model), session.step.off)
        trial = self._trials.find(prepared, model)
        diagnosis = read_diagnosis(self.results, prepared.manifest)
        return {
            "session": show_session(session, file.parse(session.step.model)),
            "run": summarize_run(prepared.manifest),
            "inputs": self._cache.list_inputs(prepared.manifest),
            "catalogue": list_catalogue(prepared.vehicle),
            "diagnosis": None if diagnosis is None else diagnosis_as_json(diagnosis),
            "named": rank_offers(editor, diagnosis),
            "missing": [effect.id for effect in _list_missing(diagnosis, session)],
            "plan": find_plan(self.results, prepared.manifest),
            "trial": trial.show() if trial is not None else None,
            "slot": file.slot,
        }

    def _look(self, ask: Ask, how: Callable[[FigureCache, Shown], dict[str, object]]) -> dict[str, object]:
        with self._trials.waiting(), evaluating(ask.run):
            file, prepared = self._find(ask)
            with prepared.lock:
                session = open_session(file, prepared)
            return how(self._figures_of(prepared.manifest), _view(file, prepared, session))

    def _figures_of(self, manifest: Manifest) -> FigureCache:
        with self._lock:
            return self._figures.recall((manifest.run, manifest.key), lambda: FigureCache(manifest))


def _view(file: SessionFile, prepared: PreparedRun, session: Session) -> Shown:
    """The model of a session on its run, without the effects that are switched off."""
    step = session.step
    model = switch_off(file.parse(step.model).model, step.off)
    return prepared.show(model, step.timing, step.ladder, session.floor or None)


def _list_missing(diagnosis: RunDiagnosis | None, session: Session) -> list[Effect]:
    """Effects of a run's diagnosis that the session's model lacks."""
    return [one for one in _list_named(diagnosis) if one.id not in session.step.order]


def _list_named(diagnosis: RunDiagnosis | None) -> list[Effect]:
    """Effects of a run's diagnosis, with their values."""
    named = None if diagnosis is None else read_model(diagnosis)
    return [] if named is None else list(named.model)
