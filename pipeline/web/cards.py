"""Effects as the page shows them: cards with sliders, rows of what to add, and formulas that are typed."""

import math
import re

from pipeline.core import split_interval
from pipeline.estimation.additions import Addition
from pipeline.models import (
    Asked,
    Effect,
    FormulaEffect,
    Model,
    Number,
    Parameter,
    list_effects,
    list_own_effects,
    make_parameter,
    name_effect,
    refuse_taken,
)
from pipeline.results import Errors
from pipeline.sources import Vehicle
from pipeline.web import WorkbenchError
from pipeline.words import describe_offered

_STEPS = 200
_ID = re.compile(r"[a-z][a-z0-9_]{0,39}")
_NUMBER = r"[-+]?(?:\d{1,30}(?:\.\d{0,30})?|\.\d{1,30})(?:[eE][-+]?\d{1,3})?"
_PARAMETER = re.compile(
    r"(?P<name>[A-Za-z][A-Za-z0-9_]{0,39})\s*\[(?P<unit>[^\[\]]{0,40})\]\s*"
    rf"(?P<low>{_NUMBER})\s*(?:\.\.|to)\s*(?P<high>{_NUMBER})",
    re.ASCII,
)


def show_addition(addition: Addition, before: Errors, model: Model, asked: Asked) -> dict[str, object]:
    """Change of a model's errors over 2 s by an additional effect."""
    effect, after = addition.effect, addition.errors
    return {
        **describe_effect(effect, model, asked),
        "beside": describe_offered(model.ids),
        "left": addition.remaining,
        "twins": list(addition.twins),
        "from": {"t": before.t_mrmse_m, "r": before.r_mrmse_rad},
        "to": {"t": after.t_mrmse_m, "r": after.r_mrmse_rad},
    }


def describe_effect(effect: Effect, model: Model, asked: Asked) -> dict[str, object]:
    """What an effect of a model is, and what it does here; its formula if it is one."""
    formulas = effect.formulas if isinstance(effect, FormulaEffect) else {}
    return {
        "id": effect.id,
        "about": _summarize(effect),
        "sentence": "" if effect.is_neutral else effect.describe_motion(model.vehicle, model, asked),
        "formula": [f"{key} += {text}" for key, text in formulas.items()],
    }


def list_catalogue(vehicle: Vehicle) -> list[dict[str, object]]:
    """Every effect that exists on a vehicle, ordered from the command to the pose."""
    return [
        {"id": effect.id, "name": name_effect(effect.id), "about": _summarize(effect)}
        for effect in (*list_effects(), *list_own_effects().values())
        if vehicle.kind in effect.kinds
    ]


def _summarize(effect: Effect | type[Effect]) -> str:
    """The first sentence of an effect's page, without its name."""
    if isinstance(effect, FormulaEffect):
        return "a formula"
    return effect.find_page().splitlines()[0].split(": ", 1)[-1].rstrip(".")


def show_parameter(
    effect: Effect, parameter: Parameter, number: Number, *, is_fitted: bool
) -> dict[str, object]:
    """A parameter as a slider.

    Args:
        effect: with its values.
        parameter: of the effect.
        number: its value, with interval and doubt.
        is_fitted: whether the value comes from a fit.
    """
    value, is_determined = number.value, math.isfinite(number.low)
    # What is usual for a parameter of somebody's formula is not known: its value says how large it is.
    is_measure = isinstance(effect, FormulaEffect) and value != parameter.neutral
    low, high = _find_range(parameter, value, value if is_measure else parameter.typical)
    # With the digits that the interval supports, as on the screen.
    said, *ends = split_interval(value, number.low, number.high) if is_determined else ("",)
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "about": parameter.about,
        "value": value,
        "said": said,
        "ends": ends,
        "from": low,
        "to": high,
        "step": (high - low) / _STEPS,
        "doubt": number.reason,
        "at_bound": number.at_bound,
        "locked": parameter.name in effect.fixed,
        "undetermined": is_fitted and not is_determined and parameter.name not in effect.fixed,
    }


def _find_range(parameter: Parameter, value: float, typical: float) -> tuple[float, float]:
    """Ends of a slider within the bounds; they include the neutral, the usual and the present value."""
    is_finite = math.isfinite(parameter.neutral)
    neutral = parameter.neutral if is_finite else value
    usual = (abs(typical - neutral) if is_finite else max(abs(value), abs(typical))) or 1.0
    low = min(neutral - usual, neutral - 2.0 * (neutral - value), value - 0.5 * usual)
    high = max(neutral + usual, neutral + 2.0 * (value - neutral), value + 0.5 * usual)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1])


def make_formula(name: str, channel: str, text: str, parameters: str) -> FormulaEffect:
    """Build an effect from the typed fields.

    Args:
        name: id of the effect, in snake_case.
        channel: `v_x`, `v_y` or `v_w`.
        text: arithmetic over signals and parameters, for example `c * v0 * w0`.
        parameters: for example `c [s] -0.5 .. 0.5, d [1] 0 .. 2`.

    Raises:
        WorkbenchError: ``bad_name``, ``bad_parameter``.
        MotionError: the formula cannot be parsed, or its unit is not the channel's.
    """
    if not _ID.fullmatch(name):
        hint = "Use small letters, digits and _, a letter first, at most 40."
        raise WorkbenchError("bad_name", f"{name!r} cannot name an effect", hint=hint)
    refuse_taken(name, "")
    declared: dict[str, Parameter] = {}
    for part in filter(None, map(str.strip, parameters.split(","))):
        match = _PARAMETER.fullmatch(part)
        low, high = map(float, match.group("low", "high")) if match else (0.0, 0.0)
        if match is None or match["name"] in declared or not 0.0 < high - low < math.inf:
            hint = (
                "Write name [unit] low .. high, for example: c [s] -0.5 .. 0.5; each name once, and two "
                "finite numbers, the smaller one first."
            )
            raise WorkbenchError("bad_parameter", f"{part[:80]!r} is not a parameter", hint=hint)
        neutral = 0.0 if low <= 0.0 <= high else low
        unit = match["unit"].strip() or "1"
        declared[match["name"]] = make_parameter(match["name"], unit, (low, high), neutral=neutral)
    return FormulaEffect(name, {channel: text}, tuple(declared.values()), where=name)
