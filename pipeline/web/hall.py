"""Everything the server holds: results, runs made ready, desks, trials, jobs; what is asked, answered."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.models.model_text import write_model
from pipeline.report.diagnosed import read_model_text
from pipeline.store import Store
from pipeline.store.files import make_folder
from pipeline.web import work
from pipeline.web.bench import Bench
from pipeline.web.cards import list_catalogue, show_desk
from pipeline.web.desk import DeskFile, switch_off
from pipeline.web.diagnoses import read_diagnosis
from pipeline.web.errors import WorkbenchError, evaluating
from pipeline.web.formulas import make_formula
from pipeline.web.jobs import Jobs
from pipeline.web.live import Album
from pipeline.web.proposals import Trials
from pipeline.web.runs import describe_run, find_run

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pipeline.batch.work import Report, Task
    from pipeline.models.formula import FormulaEffect
    from pipeline.models.model_file import ModelFile
    from pipeline.report.motion_view import MotionView
    from pipeline.store import Manifest
    from pipeline.web.bench import Stand
    from pipeline.web.desk import Desk
    from pipeline.web.limits import Limits
    from pipeline.web.places import Places
    from pipeline.web.requests import Ask

_MOST_ALBUMS = 6


class Hall:
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
        self._bench = Bench()
        self._trials = Trials()
        self._albums: OrderedDict[tuple[str, str], Album] = OrderedDict()
        self._lock = threading.Lock()

    def answer(self, ask: Ask) -> dict[str, object]:
        """Do what was asked of a desk, keep it, and say what the page must show.

        Raises:
            SlipError: it cannot be done; the desk is as it was.
        """
        manifest = find_run(self.store, ask.run)
        file = DeskFile(self.results, ask.run, ask.slot)
        stand = self._bench.stand(manifest, self._input_of(ask, file, manifest))
        with stand.lock, evaluating(ask.run):
            desk = work.open_desk(file, stand)
            if ask.action == "preview":
                return self._preview(file, stand, desk, ask)
            changed = work.learn_floor(
                self._change(file, stand, desk, ask), read_diagnosis(self.results, manifest)
            )
            # A step that cannot be shown is not kept.
            shown = self._show(file, stand, changed)
            if changed is not desk:
                file.write(changed)
            return shown

    def draw(self, ask: Ask) -> dict[str, object]:
        """All figures of a desk."""
        album, view = self._look(ask)
        with evaluating(ask.run):
            return album.draw(view)

    def redraw(self, ask: Ask) -> dict[str, object]:
        """The rows of a desk's figures that a change moves."""
        album, view = self._look(ask)
        with evaluating(ask.run):
            return album.redraw(view)

    def format_model(self, run: str, slot: str) -> str:
        """The model file of a desk as text."""
        _, desk = self._read_desk(run, slot)
        return desk.step.model

    def save_model(self, run: str, slot: str) -> Path:
        """Write the model file of a desk; the effects that are switched off are left out."""
        file, desk = self._read_desk(run, slot)
        parsed = file.parse(desk.step.model)
        make_folder(file.model_path.parent)
        write_model(replace(parsed, model=switch_off(parsed.model, desk.step.off)), file.model_path)
        return file.model_path

    def _input_of(self, ask: Ask, file: DeskFile, manifest: Manifest) -> str | None:
        if ask.input is not None:
            return ask.input
        kept = file.read()
        return kept.input if kept is not None and kept.key == manifest.key else None

    def _open(self, ask: Ask) -> tuple[Stand, Desk, ModelFile]:
        manifest = find_run(self.store, ask.run)
        file = DeskFile(self.results, ask.run, ask.slot)
        stand = self._bench.stand(manifest, self._input_of(ask, file, manifest))
        with stand.lock, evaluating(ask.run):
            desk = work.open_desk(file, stand)
        return stand, desk, file.parse(desk.step.model)

    def _read_desk(self, run: str, slot: str) -> tuple[DeskFile, Desk]:
        find_run(self.store, run)
        file = DeskFile(self.results, run, slot)
        desk = file.read()
        if desk is None:
            raise WorkbenchError(
                "no_such_desk", "no model of this run lies here", where=run, hint="Open the run first."
            )
        return file, desk

    def _change(self, file: DeskFile, stand: Stand, desk: Desk, ask: Ask) -> Desk:
        changes: dict[str, Callable[[], Desk]] = {
            "open": lambda: desk,
            "add": lambda: work.add_effect(file, stand, desk, ask.effect, anyway=ask.anyway),
            "add_named": lambda: self._add_named(file, stand, desk, ask),
            "formula": lambda: work.add_effect(file, stand, desk, _read_formula(ask), anyway=ask.anyway),
            "drop": lambda: work.drop_effect(file, stand, desk, ask.effect),
            "switch": lambda: work.switch_effect(file, stand, desk, ask.effect),
            "set": lambda: work.set_value(file, stand, desk, ask.effect, {ask.parameter: ask.value}),
            "lock": lambda: work.lock_value(file, desk, ask.effect, ask.parameter),
            "fit": lambda: work.fit_desk(file, stand, desk),
            "undo": lambda: work.move(file, desk, -1),
            "redo": lambda: work.move(file, desk, 1),
            "try": lambda: self._begin_trial(file, stand, desk),
        }
        return changes[ask.action]()

    def _add_named(self, file: DeskFile, stand: Stand, desk: Desk, ask: Ask) -> Desk:
        found = read_diagnosis(self.results, stand.manifest)
        named = None if found is None else read_model_text(found)
        if named is None:
            raise WorkbenchError(
                "not_diagnosed", "nothing was named on this run", where=ask.run, hint="Diagnose it first."
            )
        missing = [effect for effect in named.model if effect.id not in desk.step.order]
        said = f"+ all {len(missing)} that were named"
        return work.add_effects(file, stand, desk, missing, said, anyway=ask.anyway)

    def _begin_trial(self, file: DeskFile, stand: Stand, desk: Desk) -> Desk:
        model = switch_off(file.parse(desk.step.model).model, desk.step.off)
        self._trials.begin(stand, model, f"{file.slot} {file.run}")
        return desk

    def _preview(self, file: DeskFile, stand: Stand, desk: Desk, ask: Ask) -> dict[str, object]:
        """What a value would do, while the slider moves; nothing is kept."""
        trial = work.set_value(file, stand, desk, ask.effect, {ask.parameter: ask.value})
        parsed = file.parse(trial.step.model)
        model = switch_off(parsed.model, trial.step.off)
        view = stand.view(model, trial.step.timing, trial.step.ladder, desk.floor or None)
        return {"desk": show_desk(trial, parsed), **self._album(stand.manifest).redraw(view)}

    def _show(self, file: DeskFile, stand: Stand, desk: Desk) -> dict[str, object]:
        parsed = file.parse(desk.step.model)
        trial = self._trials.find(stand, switch_off(parsed.model, desk.step.off))
        return {
            "desk": show_desk(desk, parsed),
            "run": describe_run(stand.manifest),
            "inputs": self._bench.list_inputs(stand.manifest),
            "catalogue": list_catalogue(stand.vehicle),
            "diagnosis": read_diagnosis(self.results, stand.manifest),
            "trial": trial.show() if trial is not None else None,
            "slot": file.slot,
        }

    def _look(self, ask: Ask) -> tuple[Album, MotionView]:
        stand, desk, parsed = self._open(ask)
        model = switch_off(parsed.model, desk.step.off)
        with evaluating(ask.run):
            view = stand.view(model, desk.step.timing, desk.step.ladder, desk.floor or None)
        return self._album(stand.manifest), view

    def _album(self, manifest: Manifest) -> Album:
        key = (manifest.run, manifest.key)
        with self._lock:
            if key not in self._albums:
                self._albums[key] = Album(manifest)
                while len(self._albums) > _MOST_ALBUMS:
                    self._albums.popitem(last=False)
            self._albums.move_to_end(key)
            return self._albums[key]


def _read_formula(ask: Ask) -> FormulaEffect:
    return make_formula(ask.effect, ask.channel, ask.formula, ask.parameters)
