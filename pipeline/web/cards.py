"""A session as the page shows it: numbers, effects as cards, what was done."""

import inspect
import math
from collections.abc import Mapping

from pipeline.models import Effect, Parameter, list_effects
from pipeline.models.bounds import stands_at_bound
from pipeline.models.formula import FormulaEffect
from pipeline.models.model_file import ModelFile
from pipeline.vehicles import Vehicle
from pipeline.web.session import Session

_STEPS = 200
_LATEST = 12


def show_session(session: Session, file: ModelFile) -> dict[str, object]:
    """The state of a session as JSON.

    Args:
        session: with at least one step.
        file: the model of the step that counts.
    """
    step = session.step
    before = session.steps[session.at - 1] if session.at > 0 else None
    return {
        "run": session.run,
        "input": session.input,
        "said": step.said,
        "by_hand": step.by_hand,
        "ideal": _errors(step.ladder[0]),
        "errors": _errors(step.ladder[-1]),
        "before": _errors(before.ladder[-1]) if before is not None and before.ladder else None,
        "floor": _errors(session.floor) if session.floor else None,
        # What the loader of models left out, and why.
        "warnings": list(file.warnings),
        "effects": [
            show_effect(file, name, step.off, step.without.get(name))
            for name in step.order
            if name not in file.left_out
        ],
        "undo": session.steps[session.at].said if session.at > 0 else None,
        "redo": session.steps[session.at + 1].said if session.at + 1 < len(session.steps) else None,
        "history": [each.said for each in session.steps[: session.at + 1]][-_LATEST:],
    }


def show_effect(file: ModelFile, name: str, off: list[str], without: float | None) -> dict[str, object]:
    """One card."""
    effect = file.model.effect(name)
    return {
        "id": name,
        "about": describe_shortly(effect),
        "sentence": "" if effect.is_neutral else effect.describe_motion(file.model.vehicle),
        "formula": [f"{key} += {text}" for key, text in effect.formulas.items()]
        if isinstance(effect, FormulaEffect)
        else [],
        "off": name in off,
        "without_m": without,
        "parameters": [
            _show_parameter(file, effect, parameter)
            for parameter in effect.parameters
            if math.isfinite(effect.values[parameter.name])
        ],
    }


def list_catalogue(vehicle: Vehicle) -> list[dict[str, object]]:
    """Every effect that exists on a vehicle, in the order of a command's way."""
    return [
        {"id": effect.id, "about": describe_shortly(effect), "acts_on": effect.place.name.lower()}
        for effect in list_effects()
        if vehicle.kind in effect.kinds
    ]


def describe_shortly(effect: Effect | type[Effect]) -> str:
    """The first sentence of an effect's page, without its name."""
    if isinstance(effect, FormulaEffect):
        return "a formula of your own"
    kind = effect if inspect.isclass(effect) else type(effect)
    module = inspect.getmodule(kind)
    title = ((module.__doc__ if module else None) or "").strip().splitlines()[0]
    return title.split(": ", 1)[-1].rstrip(".")


def _show_parameter(file: ModelFile, effect: Effect, parameter: Parameter) -> dict[str, object]:
    value = effect.values[parameter.name]
    low, high = find_range(parameter, value)
    interval = file.intervals.get(f"{effect.id}.{parameter.name}")
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "about": parameter.about,
        "value": value,
        "low": interval[0] if interval else None,
        "high": interval[1] if interval else None,
        "from": low,
        "to": high,
        "step": (high - low) / _STEPS,
        "at_bound": value != parameter.neutral and stands_at_bound(value, parameter.bounds),
        "locked": parameter.name in effect.fixed,
    }


def find_range(parameter: Parameter, value: float) -> tuple[float, float]:
    """Ends of a slider: the neutral value, the usual size and the present one inside, within the bounds."""
    neutral = parameter.neutral if math.isfinite(parameter.neutral) else value
    usual = abs(parameter.typical - neutral) or 1.0
    low = min(neutral - usual, neutral - 2.0 * (neutral - value), value - 0.5 * usual)
    high = max(neutral + usual, neutral + 2.0 * (value - neutral), value + 0.5 * usual)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1])


def _errors(rung: Mapping[str, object]) -> dict[str, object]:
    return {"t": rung.get("t_mrmse_m"), "r": rung.get("r_mrmse_rad")}
