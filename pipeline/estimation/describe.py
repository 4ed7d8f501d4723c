"""Results of fits and judgements of models, as JSON values and as lines of text."""

import inspect
import math
import re
from collections.abc import Mapping, Sequence

from pipeline.core import JSON_DIGITS, finite_or_none, format_share, pick_finite
from pipeline.estimation.folds import Errors, errors_as_json
from pipeline.estimation.intervals import NOTHING as NOT_FITTED
from pipeline.estimation.intervals import Estimates
from pipeline.estimation.ladder import ERRORS_OVER_2S, NOTHING, Ladder, LadderStep, list_rises, read_error
from pipeline.models.effect import Effect, Parameter, Search
from pipeline.models.formula import FormulaEffect
from pipeline.models.model import Model
from pipeline.models.model_file import ModelFile
from pipeline.models.parameter import UNDETERMINED, is_of_one_run
from pipeline.run.recording import MotionRun

_HEADS = ("forward", "lateral", "yaw rate", "position", "heading")
_UNITS = ("m/s", "m/s", "deg/s", "m, 2 s", "deg, 2 s")


def ladder_as_json(ladder: Ladder, floor: Errors | None = None) -> list[dict[str, object]]:
    """Steps with their errors, the removed share of the removable error, and `rises` where an error rises."""
    rungs: list[dict[str, object]] = []
    below = ladder.steps[0].errors
    for step, share in zip(ladder.steps, ladder.explained_shares(floor), strict=True):
        rises = list_rises(below, step.errors)
        rungs.append(
            {
                "effects": list(step.effects),
                **errors_as_json(step.errors),
                "explained_share": None if share is None else _round(share),
                **({"rises": list(rises)} if rises else {}),
            }
        )
        below = step.errors
    return rungs


def step_as_json(before: LadderStep, after: LadderStep) -> dict[str, object]:
    """2 s errors of the whole model before and after a change, and which of them rise."""
    return {
        "effects": [list(before.effects), list(after.effects)],
        "t_mrmse_m": [_round(before.errors.t_mrmse_m), _round(after.errors.t_mrmse_m)],
        "r_mrmse_rad": [_round(before.errors.r_mrmse_rad), _round(after.errors.r_mrmse_rad)],
        "rises": list(list_rises(before.errors, after.errors)),
    }


def parameters_as_json(model: Model, estimates: Estimates) -> dict[str, dict[str, object]]:
    """Every parameter by ``effect.name``: value, 95 % interval, unit, and whether it was fitted."""
    entries: dict[str, dict[str, object]] = {}
    for effect in model:
        for parameter in effect.parameters:
            value = effect.values[parameter.name]
            entries[f"{effect.id}.{parameter.name}"] = {
                "value": _round(value),
                "low": None,
                "high": None,
                "unit": parameter.unit,
                "fitted": False,
            }
    for item in estimates.items:
        if not item.free.effect:
            continue
        label = item.free.label
        entry: dict[str, object] = {
            **pick_finite(item, "value", "low", "high", digits=JSON_DIGITS),
            "unit": item.free.unit,
            "fitted": True,
            "at_bound": item.at_bound,
            "observable": item.observable,
        }
        if item.free.run is None:
            entries[label] = entry
        else:
            entries.setdefault(label, {"unit": entry["unit"], "fitted": True}).setdefault("runs", [])
            runs = entries[label]["runs"]
            if isinstance(runs, list):
                runs.append({"run": item.free.run, **entry})
    return entries


def list_parameters(file: ModelFile) -> dict[str, dict[str, object]]:
    """Every parameter of a model file by ``effect.name``, with the intervals of its last fit."""
    parameters = parameters_as_json(file.model, NOT_FITTED)
    for label, (low, high) in file.intervals.items():
        parameters[label] |= {"low": _round(low), "high": _round(high)}
    for label in file.per_run:
        rows = [row for row in file.own_numbers if row.get("parameter") == label]
        if rows and label in parameters:
            parameters[label]["runs"] = rows
    return parameters


def correlations_as_json(estimates: Estimates) -> list[dict[str, object]]:
    """Pairs of parameters that the data hardly distinguish."""
    return [
        {"parameters": [one.label, other.label], "correlation": _round(value)}
        for one, other, value in estimates.list_correlated()
    ]


def format_ladder(ladder: Ladder, floor: Errors | None = None) -> list[str]:
    """The ladder as a text table."""
    heads, units = format_heads("held-out error of")
    lines = [f"{heads}{'removed':>9}", units]
    for number, (step, share) in enumerate(zip(ladder.steps, ladder.explained_shares(floor), strict=True)):
        name = "ideal" if number == 0 else f"+ {_added(ladder.steps[number - 1], step)}"
        removed = "" if share is None else f"{format_share(share, 0):>9}"
        lines.append(f"{name:<30}{_columns(step.errors)}{removed}")
        below = ladder.steps[max(number - 1, 0)].errors
        rises = format_rises(below, step.errors)
        lines += [f"  ! {rises}"] if rises else []
    if floor is not None:
        lines.append(f"{'noise floor (estimated)':<30}{_columns(floor)}")
    if ladder.idle:
        verb = "does" if len(ladder.idle) == 1 else "do"
        lines.append(f"{', '.join(ladder.idle)} {verb} not reduce the held-out error")
    return lines


def describe_step(before: LadderStep, after: LadderStep, refusal: str = "") -> list[str]:
    """Change of the 2 s errors of the whole model, and the objection to it, if any."""
    old, new = before.errors, after.errors
    position = f"{old.t_mrmse_m:.4f} -> {new.t_mrmse_m:.4f} m"
    heading = " -> ".join(f"{math.degrees(one.r_mrmse_rad):.2f}" for one in (old, new)) + " degrees"
    word = "added" if set(after.effects) > set(before.effects) else "changed"
    line = f"{'all effects, before -> after':<30}{position}   {heading}"
    note = refusal or format_rises(old, new)
    return [line, f"  ! {note}: {word} as requested"] if note else [line]


def format_rises(
    below: Errors | Mapping[str, object], errors: Errors | Mapping[str, object], forgiven: float = NOTHING
) -> str:
    """Which 2 s errors rise, and by how much: `position error rises by 2.0%`; empty where none does.

    Args:
        below: errors before, or the step in JSON.
        errors: errors after.
        forgiven: fraction by which an error may rise.
    """
    phrases: list[str] = []
    for key in list_rises(below, errors, forgiven):
        old, new = read_error(below, key), read_error(errors, key)
        by = f" by {format_share(new / old - 1.0)}" if old else ""
        phrases.append(f"{ERRORS_OVER_2S[key][0]} error{'' if phrases else ' rises'}{by}")
    return ", ".join(phrases)


def format_recordings(runs: Sequence[MotionRun]) -> list[str]:
    """Corrections to and exclusions of poses; empty where there are none."""
    lines = []
    for run in runs:
        spread, outlier_s = run.alignment.latency_spread_s, run.alignment.outlier_s
        if spread > 0.0:
            lines.append(f"{run.name}: the pose latency varies by {spread:.2g} s, corrected with the gyro")
        if outlier_s > 0.0:
            lines.append(f"{run.name}: {outlier_s:.3g} s excluded: the localization contradicts the wheels")
    return lines


def format_measured_errors(name: str, errors: Errors) -> str:
    """One row of errors."""
    return f"{name:<30}{_columns(errors)}"


def format_heads(name: str) -> tuple[str, str]:
    """The headers of the error columns, and their units."""
    heads, units = ("".join(f"{word:>9}" for word in words) for words in (_HEADS, _UNITS))
    return f"{name:<30}{heads}", f"{'':<30}{units}"


def _added(before: LadderStep, step: LadderStep) -> str:
    return ", ".join(name for name in step.effects if name not in before.effects)


def _columns(errors: Errors) -> str:
    x, y, turn = errors.velocity_rms
    values = [(x, 4), (y, 4), (math.degrees(turn), 2), (errors.t_mrmse_m, 4)]
    values.append((math.degrees(errors.r_mrmse_rad), 2))
    return "".join(f"{'-' if math.isnan(value) else f'{value:.{digits}f}':>9}" for value, digits in values)


def format_parameters(parameters: Mapping[str, Mapping[str, object]]) -> list[str]:
    """Parameters with intervals, one per line."""
    lines = []
    for label, entry in parameters.items():
        rows = entry.get("runs")
        for row in rows if isinstance(rows, list) else [entry]:
            unit = "" if entry["unit"] == "1" else entry["unit"]
            text = f"  {label:<32}{_show(row.get('value')):>12} {unit:<8}"
            if row.get("low") is not None:
                text += f"95 %: {_show(row['low'])} to {_show(row['high'])}"
            elif row.get("fitted"):
                text += UNDETERMINED
            if row.get("at_bound"):
                text += "  (at its bound)"
            if row.get("observable") is False:
                text += "  (not observable in these runs)"
            if "run" in row:
                text += f"  run {row['run']}"
            lines.append(text.rstrip())
    return lines


def format_effect(effect: type[Effect] | Effect) -> str:
    """An effect's page: docstring, parameters, required excitation, and easily confused effects."""
    if isinstance(effect, FormulaEffect):
        page = effect.describe()
    else:
        module = inspect.getmodule(effect if inspect.isclass(effect) else type(effect))
        page = inspect.cleandoc((module.__doc__ if module else None) or effect.__doc__ or "")
        # A paragraph is one line; the display wraps it.
        page = re.sub(r"(?m)^(\S.*)\n(?=\S)", r"\1 ", page)
    lines = [page, "", f"id            {effect.id}", f"acts on       {effect.place.name.lower()}"]
    lines.append(f"vehicles      {', '.join(effect.kinds)}")
    for parameter in effect.parameters:
        low, high = parameter.bounds
        how = " (searched on a grid)" if parameter.search is Search.GRID else ""
        lines.append(
            f"parameter     {parameter.name} [{parameter.unit}]: {parameter.about}; {low:g} to {high:g}, "
            f"neutral {parameter.neutral:g}, typical {parameter.typical:g}{how}"
        )
        texts = _format_sizes(parameter)
        if not is_of_one_run(effect.parameters):
            spread, unit = parameter.spread, "" if parameter.unit == "1" else f" {parameter.unit}"
            texts.append(
                f"standard deviation between runs on one ground {spread.size:.2g}{unit}: {spread.source}"
            )
        lines += [f"{'':<14}{text}" for text in texts]
    lines.append(f"observed by   {', '.join(need.value for need in effect.needs)}")
    if effect.equivalent_to:
        lines.append(f"same as       {', '.join(effect.equivalent_to)} ({effect.equivalent_when})")
    if effect.contains:
        lines.append(f"contains      {', '.join(effect.contains)}")
    if effect.parts:
        lines.append(f"searched as   {', '.join(part.effect for part in effect.parts)}")
    lines += [
        f"{'' if number else 'by level':<14}{one.level.value}: {one.name}, {one.text}"
        for number, one in enumerate(effect.readings)
    ]
    if effect.confused_with:
        lines.append(f"similar to    {', '.join(effect.confused_with)}")
    return "\n".join(lines)


def _format_sizes(parameter: Parameter) -> list[str]:
    """Detection threshold, exported quantities, observed range and sign of a parameter."""
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    lines = []
    if parameter.least is not None:
        least = parameter.least
        lines.append(f"detection threshold {least.size:g}{unit} from neutral: {least.reason}")
    if parameter.quantities:
        lines.append(f"exported as {' and '.join(quantity.about for quantity in parameter.quantities)}")
    if parameter.plausible is not None:
        range_ = parameter.plausible
        lines.append(f"observed range {range_.low:g} to {range_.high:g}{unit}: {range_.source}")
    if parameter.one_sign:
        lines.append("must be positive: the other sign has no physical meaning")
    return lines


def list_pages(effects: Sequence[type[Effect]]) -> list[str]:
    """The catalogue: one line per effect."""
    lines = []
    for effect in effects:
        module = inspect.getmodule(effect)
        title = ((module.__doc__ if module else None) or "").strip().splitlines()[0]
        lines.append(f"{effect.id:<24}{effect.place.name.lower():<13}{title.split(': ', 1)[-1]}")
    return lines


def _show(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "-"


def _round(value: float) -> float | None:
    return finite_or_none(value, JSON_DIGITS)
