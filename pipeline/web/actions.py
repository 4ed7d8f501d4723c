"""What one does in a session: add, drop, switch, set, fit, undo. Each gives the next session."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from pipeline.identification.describe import errors_as_json
from pipeline.identification.ladder import CHANCE, ERRORS_OVER_2S, list_rises
from pipeline.models import Effect, Model, find_effect
from pipeline.web.cards import show_session
from pipeline.web.errors import WorkbenchError
from pipeline.web.run_cache import PreparedRun, rung_as_json
from pipeline.web.session import Session, SessionFile, Step, begin_session, format_step, switch_off

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pipeline.identification import Errors

    Rungs = Mapping[tuple[str, ...], dict[str, object]]


def open_session(file: SessionFile, prepared: PreparedRun) -> Session:
    """The session of a run as it was left; begun anew where there is none or the results have changed.

    Steps that cannot be opened any more are left out.
    """
    session = file.read()
    source = prepared.problem.source.value
    if session is not None and (session.key != prepared.manifest.key or session.input != source):
        session = None
    session = session.move(0) if session is not None else None
    while session is not None and session.steps and not _can_open(file, session):
        session = session.drop(session.at)
    if session is None or not session.steps:
        session = begin_session(prepared.manifest.run, prepared.manifest.key, source, prepared.vehicle)
        begun = Editor(file, prepared, session)
        fitted = begun.fit_anew(begun.model, session.step.order, session.step.said, afresh=True)
        session = msgspec.structs.replace(fitted, steps=[fitted.step], at=0)
        file.write(session)
    return session


def move(file: SessionFile, session: Session, by: int) -> Session:
    """The session a step back (-1) or forward (1); steps that cannot be opened any more are left out."""
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
    """What changes a session; the session itself stays as it is.

    Attributes:
        file: where it is kept.
        prepared: the run.
        session: the session before.
    """

    file: SessionFile
    prepared: PreparedRun
    session: Session

    @property
    def model(self) -> Model:
        """The model before, with the effects that are switched off."""
        return self.file.parse(self.session.step.model).model

    def add_effect(self, effect: Effect | str, *, anyway: bool = False) -> Session:
        """Put an effect on top of the model and fit all of it.

        Raises:
            WorkbenchError: ``error_rises``, see `add_effects`.
        """
        made = find_effect(effect)() if isinstance(effect, str) else effect
        return self.add_effects([made], f"+ {made.id}", anyway=anyway)

    def add_effects(self, effects: Sequence[Effect], said: str, *, anyway: bool) -> Session:
        """Put effects on top of the model at once, and fit all of it.

        Raises:
            WorkbenchError: ``error_rises``, an error over 2 s is higher with them and nobody said to take
                them anyway.
        """
        model, step = self.model, self.session.step
        for made in effects:
            model = model + made
        changed = self.fit_anew(model, [*step.order, *(made.id for made in effects)], said)
        rises = _describe_rises(step.ladder[-1], changed.step.ladder[-1])
        if rises and not anyway:
            raise WorkbenchError(
                "error_rises",
                f"with {said.removeprefix('+ ')} {' and '.join(rises)}: it was not taken",
                where=self.session.run,
                hint="Take something else, or take it anyway",
            )
        return changed

    def drop_effect(self, name: str) -> Session:
        """Take an effect away and fit the rest."""
        step = self.session.step
        order, off = ([each for each in names if each != name] for names in (step.order, step.off))
        return self.fit_anew(self.model - name, order, f"\u2212 {name}", off=off)

    def fit(self) -> Session:
        """Fit all values that are not locked, from where they are."""
        return self.fit_anew(self.model, self.session.step.order, "fit", afresh=True)

    def switch_effect(self, name: str) -> Session:
        """Switch an effect off, or on again, without a fit: what it carries alone shows at once."""
        model, off = self.model, self.session.step.off
        model.effect(name)
        off = [each for each in off if each != name] if name in off else [*off, name]
        return self._score_by_hand(model, f"{name} {'off' if name in off else 'on'}", off)

    def set_value(self, name: str, values: Mapping[str, float]) -> Session:
        """Set values of an effect by hand, without a fit."""
        told = ", ".join(f"{key} = {value:.4g}" for key, value in values.items())
        return self._score_by_hand(
            self.model.change(name, **values), f"{name}: {told}", self.session.step.off
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
        _require_numbers(errors, self.session.run)
        shown = [name for name in step.order if name not in off]
        ladder = [rung for rung in step.ladder if set(_effects_of(rung)) < set(shown)]
        ladder.append(rung_as_json(shown, errors))
        text = format_step(model, {})
        return self.session.push(
            msgspec.structs.replace(step, said=said, model=text, off=off, ladder=ladder, by_hand=True)
        )

    def fit_anew(
        self, model: Model, order: list[str], said: str, *, off: list[str] | None = None, afresh: bool = False
    ) -> Session:
        """Fit a model; its ladder goes up in the order in which effects were added.

        Args:
            model: with the effects that are switched off.
            order: of its effects.
            said: what was done.
            off: effects that are switched off; None for those that are.
            afresh: whether rungs that were fitted before are fitted again, too.
        """
        prepared, off = self.prepared, self.session.step.off if off is None else off
        known = {} if afresh else _known_rungs(self.session.step)
        whole = prepared.judge(switch_off(model, off))
        _require_numbers(whole.errors, self.session.run)
        fitted = whole.fitted.model
        shown = [name for name in order if name in fitted]
        ladder = []
        for count in range(len(shown)):
            rung = known.get(tuple(shown[:count]))
            if rung is None:
                rung = rung_as_json(shown[:count], prepared.judge_quickly(fitted.keep(shown[:count])))
            ladder.append(rung)
        ladder.append(rung_as_json(shown, whole.errors))
        delays = (prepared.run.alignment.heading_delay_s, whole.fitted.state.timing[0].wheel_delay_s)
        step = Step(
            said=said,
            model=format_step(model.swap(*fitted.effects), whole.intervals),
            order=order,
            off=off,
            timing=delays,
            ladder=ladder,
            without={name: prepared.score(fitted - name, delays).t_mrmse_m for name in shown},
        )
        return self.session.push(step)


def _describe_rises(before: Mapping[str, object], after: Mapping[str, object]) -> list[str]:
    told = []
    for key in list_rises(before, after, CHANCE):
        word, unit = ERRORS_OVER_2S[key]
        told.append(f"the {word} error over 2 s rises from {before[key]:.3g} to {after[key]:.3g} {unit}")
    return told


def _effects_of(rung: Mapping[str, object]) -> list[str]:
    found = rung.get("effects")
    return [str(name) for name in found] if isinstance(found, list) else []


def _require_numbers(errors: Errors, run: str) -> None:
    if not (math.isfinite(errors.t_mrmse_m) and math.isfinite(errors.r_mrmse_rad)):
        hint = "The model is as it was; take other values or another formula."
        raise WorkbenchError(
            "not_finite", "with that the model predicts no finite motion on this run", where=run, hint=hint
        )


def _known_rungs(step: Step) -> Rungs:
    """The rungs of a step that were fitted, by their effects; the last one was not after a change by hand."""
    rungs = step.ladder[:-1] if step.by_hand else step.ladder
    return {tuple(_effects_of(rung)): rung for rung in rungs}


def keep_floor(session: Session, prepared: PreparedRun) -> Session:
    """The session with the noise floor of its run."""
    floor = errors_as_json(prepared.problem.floor)
    return session if session.floor == floor else msgspec.structs.replace(session, floor=floor)
