"""What one does in a session: add, drop, switch, set, fit, undo. Each gives the next session."""

from __future__ import annotations

import math
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
        fitted = _fit_anew(
            prepared,
            session,
            _model_of(file, session),
            session.step.order,
            session.step.said,
            off=session.step.off,
            known={},
        )
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


def add_effect(
    file: SessionFile, prepared: PreparedRun, session: Session, effect: Effect | str, *, anyway: bool = False
) -> Session:
    """Put an effect on top of the model and fit all of it.

    Raises:
        WorkbenchError: ``error_rises``, see `add_effects`.
    """
    made = find_effect(effect)() if isinstance(effect, str) else effect
    return add_effects(file, prepared, session, [made], f"+ {made.id}", anyway=anyway)


def add_effects(
    file: SessionFile,
    prepared: PreparedRun,
    session: Session,
    effects: Sequence[Effect],
    said: str,
    *,
    anyway: bool,
) -> Session:
    """Put effects on top of the model at once, and fit all of it.

    Raises:
        WorkbenchError: ``error_rises``, an error over 2 s is higher with them and nobody said to take them
            anyway.
    """
    model = _model_of(file, session)
    for made in effects:
        model = model + made
    order = [*session.step.order, *(made.id for made in effects)]
    changed = _fit_anew(
        prepared, session, model, order, said, off=session.step.off, known=_known_rungs(session.step)
    )
    rises = _describe_rises(session.step.ladder[-1], changed.step.ladder[-1])
    if rises and not anyway:
        raise WorkbenchError(
            "error_rises",
            f"with {said.removeprefix('+ ')} {' and '.join(rises)}: it was not taken",
            where=session.run,
            hint="Take something else, or take it anyway",
        )
    return changed


def _describe_rises(before: Mapping[str, object], after: Mapping[str, object]) -> list[str]:
    told = []
    for key in list_rises(before, after, CHANCE):
        word, unit = ERRORS_OVER_2S[key]
        told.append(f"the {word} error over 2 s rises from {before[key]:.3g} to {after[key]:.3g} {unit}")
    return told


def drop_effect(file: SessionFile, prepared: PreparedRun, session: Session, name: str) -> Session:
    """Take an effect away and fit the rest."""
    model = _model_of(file, session) - name
    order = [each for each in session.step.order if each != name]
    off = [each for each in session.step.off if each != name]
    return _fit_anew(
        prepared, session, model, order, f"\u2212 {name}", off=off, known=_known_rungs(session.step)
    )


def fit_session(file: SessionFile, prepared: PreparedRun, session: Session) -> Session:
    """Fit all values that are not locked, from where they are."""
    model = _model_of(file, session)
    return _fit_anew(prepared, session, model, session.step.order, "fit", off=session.step.off, known={})


def switch_effect(file: SessionFile, prepared: PreparedRun, session: Session, name: str) -> Session:
    """Switch an effect off, or on again, without a fit: what it carries alone shows at once."""
    model = _model_of(file, session)
    model.effect(name)
    off = session.step.off
    off = [each for each in off if each != name] if name in off else [*off, name]
    said = f"{name} {'off' if name in off else 'on'}"
    return session.push(_score_by_hand(prepared, session.step, model, said, off))


def set_value(
    file: SessionFile, prepared: PreparedRun, session: Session, name: str, values: Mapping[str, float]
) -> Session:
    """Set values of an effect by hand, without a fit."""
    model = _model_of(file, session).change(name, **values)
    told = ", ".join(f"{key} = {value:.4g}" for key, value in values.items())
    step = _score_by_hand(prepared, session.step, model, f"{name}: {told}", session.step.off)
    return session.push(step)


def lock_value(file: SessionFile, session: Session, name: str, parameter: str) -> Session:
    """Lock a value against fits, or unlock it."""
    parsed = file.parse(session.step.model)
    effect = parsed.model.effect(name)
    changed = effect.loosen(parameter) if parameter in effect.fixed else effect.fix(parameter)
    model = parsed.model.swap(changed)
    said = f"{name}.{parameter} {'locked' if parameter in changed.fixed else 'unlocked'}"
    step = msgspec.structs.replace(session.step, said=said, model=format_step(model, parsed.intervals))
    return session.push(step)


def _model_of(file: SessionFile, session: Session) -> Model:
    return file.parse(session.step.model).model


def _score_by_hand(prepared: PreparedRun, step: Step, model: Model, said: str, off: list[str]) -> Step:
    errors = prepared.score(switch_off(model, off), step.timing)
    _require_numbers(errors, prepared.manifest.run)
    shown = [name for name in step.order if name not in off]
    ladder = [rung for rung in step.ladder if set(_effects_of(rung)) < set(shown)]
    ladder.append(rung_as_json(shown, errors))
    return msgspec.structs.replace(
        step, said=said, model=format_step(model, {}), off=off, ladder=ladder, by_hand=True
    )


def _effects_of(rung: Mapping[str, object]) -> list[str]:
    found = rung.get("effects")
    return [str(name) for name in found] if isinstance(found, list) else []


def _fit_anew(
    prepared: PreparedRun,
    session: Session,
    model: Model,
    order: list[str],
    said: str,
    *,
    off: list[str],
    known: Rungs,
) -> Session:
    """Fit a model; its ladder goes up in the order in which effects were added.

    Args:
        prepared: the run.
        session: whose step it follows.
        model: with the effects that are switched off.
        order: of its effects.
        said: what was done.
        off: effects that are switched off.
        known: rungs that need not be fitted again.
    """
    whole = prepared.judge(switch_off(model, off))
    _require_numbers(whole.errors, session.run)
    fitted = whole.fitted.model
    shown = [name for name in order if name in fitted]
    ladder = []
    for count in range(len(shown)):
        rung = known.get(tuple(shown[:count]))
        if rung is None:
            rung = rung_as_json(shown[:count], prepared.judge_quickly(fitted.keep(shown[:count])))
        ladder.append(rung)
    ladder.append(rung_as_json(shown, whole.errors))
    timing = whole.fitted.state.timing[0]
    delays = (prepared.run.alignment.heading_delay_s, timing.wheel_delay_s)
    step = Step(
        said=said,
        model=format_step(model.swap(*fitted.effects), whole.intervals),
        order=order,
        off=off,
        timing=delays,
        ladder=ladder,
        without={name: prepared.score(fitted - name, delays).t_mrmse_m for name in shown},
    )
    return session.push(step)


def _require_numbers(errors: Errors, run: str) -> None:
    if not (math.isfinite(errors.t_mrmse_m) and math.isfinite(errors.r_mrmse_rad)):
        raise WorkbenchError(
            "not_finite",
            "with that the model predicts no finite motion on this run",
            where=run,
            hint="The model is as it was; take other values or another formula.",
        )


def _known_rungs(step: Step) -> Rungs:
    """The rungs of a step that were fitted, by their effects; the last one was not after a change by hand."""
    rungs = step.ladder[:-1] if step.by_hand else step.ladder
    return {tuple(_effects_of(rung)): rung for rung in rungs}


def keep_floor(session: Session, prepared: PreparedRun) -> Session:
    """The session with the noise floor of its run."""
    floor = errors_as_json(prepared.problem.floor)
    return session if session.floor == floor else msgspec.structs.replace(session, floor=floor)
