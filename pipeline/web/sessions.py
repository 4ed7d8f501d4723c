"""Everything the server holds: results, runs made ready, sessions, trials, jobs; what is asked, answered."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pipeline.batch.work import Report, Task
from pipeline.models import Model
from pipeline.models.model_text import write_model
from pipeline.report.diagnosed import read_model_text
from pipeline.store import Manifest, Store
from pipeline.store.files import make_folder
from pipeline.web import actions
from pipeline.web.cards import list_catalogue, show_session
from pipeline.web.diagnoses import find_formula, read_diagnosis
from pipeline.web.errors import WorkbenchError, evaluating
from pipeline.web.figure_cache import FigureCache
from pipeline.web.formulas import make_formula
from pipeline.web.jobs import Jobs
from pipeline.web.limits import Limits
from pipeline.web.places import Places
from pipeline.web.plans import find_plan
from pipeline.web.proposals import Trials
from pipeline.web.requests import Ask
from pipeline.web.run_cache import PreparedRun, RunCache, Shown
from pipeline.web.runs import describe_run, find_run
from pipeline.web.session import Session, SessionFile, format_step, switch_off

_MOST_ALBUMS = 6


class Sessions:
    """The workbench without its web side.

    Args:
        results: the results folder.
        limits: what logs and the work on them may cost.
        diagnosis: whether a dropped log is diagnosed too.
        places: what the page is not told.
        work: what the worker process does with a task; importable by its name there.
    """

    def __init__(
        self,
        results: Path,
        limits: Limits,
        *,
        diagnosis: bool,
        places: Places,
        work: Callable[[Task], Report] | None = None,
    ) -> None:
        self.results = results
        self.store = Store(results)
        self.jobs = Jobs(results, limits, diagnosis=diagnosis, places=places, work=work)
        self._cache = RunCache()
        self._trials = Trials()
        self._figures: OrderedDict[tuple[str, str], FigureCache] = OrderedDict()
        self._lock = threading.Lock()

    def answer(self, ask: Ask) -> dict[str, object]:
        """Do what was asked of a session, keep it, and say what the page must show.

        Raises:
            SlipError: it cannot be done; the session is as it was.
        """
        file, prepared = self._find(ask)
        with self._trials.waiting(), prepared.lock, evaluating(ask.run):
            session = actions.open_session(file, prepared)
            if ask.action == "preview":
                return self._preview(file, prepared, session, ask)
            changed = actions.keep_floor(self._change(file, prepared, session, ask), prepared)
            # A step that cannot be shown is not kept.
            shown = self._show(file, prepared, changed)
            if changed is not session:
                file.write(changed)
            return shown

    def draw(self, ask: Ask) -> dict[str, object]:
        """All figures of a session."""
        return self._look(ask, FigureCache.draw)

    def redraw(self, ask: Ask) -> dict[str, object]:
        """The rows of a session's figures that a change moves."""
        return self._look(ask, FigureCache.redraw)

    def format_model(self, run: str, slot: str) -> str:
        """The model file of a session as text."""
        _, session = self._read_session(run, slot)
        return session.step.model

    def save_model(self, run: str, slot: str) -> Path:
        """Write the model file of a session; the effects that are switched off are left out."""
        file, session = self._read_session(run, slot)
        parsed = file.parse(session.step.model)
        make_folder(file.model_path.parent)
        write_model(replace(parsed, model=switch_off(parsed.model, session.step.off)), file.model_path)
        return file.model_path

    def _find(self, ask: Ask) -> tuple[SessionFile, PreparedRun]:
        manifest = find_run(self.store, ask.run)
        file = SessionFile(self.results, ask.run, ask.slot)
        kept = None if ask.input is not None else file.read()
        source = kept.input if kept is not None and kept.key == manifest.key else ask.input
        return file, self._cache.prepared(manifest, source)

    def _read_session(self, run: str, slot: str) -> tuple[SessionFile, Session]:
        find_run(self.store, run)
        file = SessionFile(self.results, run, slot)
        session = file.read()
        if session is None:
            raise WorkbenchError(
                "no_such_desk", "no model of this run lies here", where=run, hint="Open the run first."
            )
        return file, session

    def _change(self, file: SessionFile, prepared: PreparedRun, session: Session, ask: Ask) -> Session:
        changes: dict[str, Callable[[], Session]] = {
            "open": lambda: session,
            "add": lambda: actions.add_effect(file, prepared, session, ask.effect, anyway=ask.anyway),
            "add_named": lambda: self._add_named(file, prepared, session, ask),
            "add_found": lambda: self._add_found(file, prepared, session, ask),
            "formula": lambda: actions.add_effect(
                file,
                prepared,
                session,
                make_formula(ask.effect, ask.channel, ask.formula, ask.parameters),
                anyway=ask.anyway,
            ),
            "drop": lambda: actions.drop_effect(file, prepared, session, ask.effect),
            "switch": lambda: actions.switch_effect(file, prepared, session, ask.effect),
            "set": lambda: actions.set_value(file, prepared, session, ask.effect, {ask.parameter: ask.value}),
            "lock": lambda: actions.lock_value(file, session, ask.effect, ask.parameter),
            "fit": lambda: actions.fit_session(file, prepared, session),
            "undo": lambda: actions.move(file, session, -1),
            "redo": lambda: actions.move(file, session, 1),
            "try": lambda: self._begin_trial(file, prepared, session),
        }
        return changes[ask.action]()

    def _add_named(self, file: SessionFile, prepared: PreparedRun, session: Session, ask: Ask) -> Session:
        found = read_diagnosis(self.results, prepared.manifest)
        named = None if found is None else read_model_text(found)
        if named is None:
            raise WorkbenchError(
                "not_diagnosed", "nothing was named on this run", where=ask.run, hint="Diagnose it first."
            )
        missing = [effect for effect in named.model if effect.id not in session.step.order]
        said = f"+ all {len(missing)} that were named"
        return actions.add_effects(file, prepared, session, missing, said, anyway=ask.anyway)

    def _add_found(self, file: SessionFile, prepared: PreparedRun, session: Session, ask: Ask) -> Session:
        found = read_diagnosis(self.results, prepared.manifest)
        text = find_formula(found)
        if text is None:
            raise WorkbenchError(
                "no_formula", "no formula was found on this run", where=ask.run, hint="Diagnose it first."
            )
        (formula,) = file.parse(format_step(Model(prepared.vehicle), {}) + text).model.effects
        return actions.add_effect(file, prepared, session, formula, anyway=ask.anyway)

    def _begin_trial(self, file: SessionFile, prepared: PreparedRun, session: Session) -> Session:
        model = switch_off(file.parse(session.step.model).model, session.step.off)
        self._trials.begin(prepared, model, f"{file.slot} {file.run}")
        return session

    def _preview(
        self, file: SessionFile, prepared: PreparedRun, session: Session, ask: Ask
    ) -> dict[str, object]:
        """What a value would do, while the slider moves; nothing is kept."""
        trial = actions.set_value(file, prepared, session, ask.effect, {ask.parameter: ask.value})
        parsed = file.parse(trial.step.model)
        model = switch_off(parsed.model, trial.step.off)
        shown = prepared.show(model, trial.step.timing, trial.step.ladder, session.floor or None)
        return {"session": show_session(trial, parsed), **self._figures_of(prepared.manifest).redraw(shown)}

    def _show(self, file: SessionFile, prepared: PreparedRun, session: Session) -> dict[str, object]:
        parsed = file.parse(session.step.model)
        trial = self._trials.find(prepared, switch_off(parsed.model, session.step.off))
        return {
            "session": show_session(session, parsed),
            "run": describe_run(prepared.manifest),
            "inputs": self._cache.list_inputs(prepared.manifest),
            "catalogue": list_catalogue(prepared.vehicle),
            "diagnosis": read_diagnosis(self.results, prepared.manifest),
            "plan": find_plan(self.results, prepared.manifest),
            "trial": trial.show() if trial is not None else None,
            "slot": file.slot,
        }

    def _look(self, ask: Ask, how: Callable[[FigureCache, Shown], dict[str, object]]) -> dict[str, object]:
        with self._trials.waiting(), evaluating(ask.run):
            file, prepared = self._find(ask)
            with prepared.lock:
                session = actions.open_session(file, prepared)
            model = switch_off(file.parse(session.step.model).model, session.step.off)
            shown = prepared.show(model, session.step.timing, session.step.ladder, session.floor or None)
            return how(self._figures_of(prepared.manifest), shown)

    def _figures_of(self, manifest: Manifest) -> FigureCache:
        key = (manifest.run, manifest.key)
        with self._lock:
            if key not in self._figures:
                self._figures[key] = FigureCache(manifest)
                while len(self._figures) > _MOST_ALBUMS:
                    self._figures.popitem(last=False)
            self._figures.move_to_end(key)
            return self._figures[key]
