"""Fits of models as text: parameters, ladders, contests, and what a model is refused."""

import math
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from pipeline.core import (
    INPUT_WORDS,
    format_angle,
    format_count,
    format_digits,
    format_length,
    format_share,
    round_digits,
    split_interval,
)
from pipeline.datasets import ModelFit
from pipeline.estimation.ladder import Ladder, LadderStep
from pipeline.estimation.rivals import Contest, Rival
from pipeline.estimation.tolerance import FEWEST_PREDICTIONS, Answer, SpeedLimit
from pipeline.estimation.transfer import Transfer, describe_beyond, describe_remaining
from pipeline.models import ModelFile, Number
from pipeline.results import CHANCE, ERRORS_OVER_2S, Errors
from pipeline.run import MotionRun
from pipeline.words.errors import format_fall, format_rises

_HEADS = ("forward", "lateral", "yaw rate", "position", "heading")
_UNITS = ("m/s", "m/s", "deg/s", "over 2 s", "over 2 s")
_WIDTH = 10
"""Columns of an error, with a space before it."""


def format_ladder(ladder: Ladder, floor: Errors | None = None) -> list[str]:
    """The ladder as a text table."""
    heads, units = format_heads("held-out error of")
    lines = [f"{heads}{'removed':>9}", units]
    for number, (step, share) in enumerate(zip(ladder.steps, ladder.explained_shares(floor), strict=True)):
        below = ladder.steps[max(number - 1, 0)]
        added = ", ".join(name for name in step.effects if name not in below.effects)
        removed = "" if share is None else f"{format_share(share, 0):>9}"
        lines.append(f"{'ideal' if number == 0 else f'+ {added}':<30}{_columns(step.errors)}{removed}")
        rises = format_rises(below.errors, step.errors)
        lines += [f"  ! {rises}"] if rises else []
    if floor is not None:
        lines.append(f"{'noise floor (estimated)':<30}{_columns(floor)}")
    if ladder.idle:
        verb = "reduces" if len(ladder.idle) == 1 else "reduce"
        lines.append(f"{', '.join(ladder.idle)} {verb} no held-out error by more than {format_share(CHANCE)}")
    return lines


def describe_step(before: LadderStep, after: LadderStep, refusal: str = "") -> list[str]:
    """Change of the 2 s errors of the whole model, and the objection to it, if any."""
    old, new = before.errors, after.errors
    falls = {
        of: format_fall(getattr(old, key), getattr(new, key), key) for key, (of, _) in ERRORS_OVER_2S.items()
    }
    said = [text or f"{of} unchanged" for of, text in falls.items() if text is not None]
    word = "added" if set(after.effects) > set(before.effects) else "changed"
    line = f"{'held out, before -> after':<30}{'   '.join(said)}"
    note = refusal or format_rises(old, new)
    return [line, f"  ! {note}: {word} as requested"] if note else [line]


def format_measured_errors(name: str, errors: Errors) -> str:
    """One row of errors."""
    return f"{name:<30}{_columns(errors)}"


def format_heads(name: str) -> tuple[str, str]:
    """The headers of the error columns, and their units."""
    heads, units = ("".join(f"{word:>{_WIDTH}}" for word in words) for words in (_HEADS, _UNITS))
    return f"{name:<30}{heads}", f"{'':<30}{units}"


def _columns(errors: Errors) -> str:
    x, y, turn = errors.velocity_rms
    texts = [
        *map(format_digits, (x, y, math.degrees(turn))),
        format_length(errors.t_mrmse_m),
        re.sub(r"degrees?", "deg", format_angle(errors.r_mrmse_rad)),
    ]
    values = (x, y, turn, errors.t_mrmse_m, errors.r_mrmse_rad)
    shown = ("-" if math.isnan(value) else text for value, text in zip(values, texts, strict=True))
    return "".join(f"{text:>{_WIDTH}}" for text in shown)


def format_recordings(runs: Sequence[MotionRun]) -> list[str]:
    """Corrections to and exclusions of poses; empty where there are none."""
    lines = []
    for run in runs:
        spread, outlier_s = run.alignment.latency_spread_s, run.alignment.outlier_s
        if spread > 0.0:
            lines.append(f"{run.name}: the pose latency varies by {spread:.2g} s: corrected")
        if outlier_s > 0.0:
            lines.append(f"{run.name}: {outlier_s:.3g} s excluded: the localization contradicts the wheels")
    return lines


def format_parameters(
    numbers: Mapping[str, Number], own: Mapping[str, Mapping[str, Number]] = MappingProxyType({})
) -> list[str]:
    """Numbers by label with their intervals, one per line; those that runs have of their own instead.

    Args:
        numbers: by label ``effect.name``.
        own: by label, then by run.
    """
    lines = []
    for label, shared in numbers.items():
        for run, number in own.get(label, {"": shared}).items():
            unit = "" if number.unit == "1" else number.unit
            value, *ends = _show_within(number)
            text = f"  {label:<32}{value:>12} {unit:<8}"
            if ends:
                text += f"95 %: {' to '.join(ends)}"
            text += f"  ({number.reason})" if number.doubt else ""
            lines.append(f"{text}  run {run}" if run else text.rstrip())
    return lines


def format_speed_limits(limits: Mapping[str, SpeedLimit], tolerance_m: float, ahead_s: float) -> list[str]:
    """Highest speeds by terrain at which predictions stay within a tolerance, one line each.

    Args:
        limits: by terrain.
        tolerance_m: largest error of position [m].
        ahead_s: time ahead [s].
    """
    head = f"within {format_length(tolerance_m)} at {ahead_s:g} s ahead: "
    return [
        (head if number == 0 else " " * len(head)) + _describe_limit(limit, terrain)
        for number, (terrain, limit) in enumerate(limits.items())
    ]


def _describe_limit(limit: SpeedLimit, terrain: str) -> str:
    """One terrain's highest speed, or why there is none."""
    where = "" if terrain == "unknown" else f" on {terrain}"
    if limit.answer is Answer.TOO_FEW:
        count = f"{format_count(limit.predictions, 'prediction')} while driving"
        return f"unknown{where}: {count}, and {FEWEST_PREDICTIONS} are needed; drive longer"
    fastest, slowest = (f"{format_digits(one)} m/s" for one in (limit.fastest, limit.slowest))
    if limit.answer is Answer.NONE:
        best = format_length(limit.error_slowest)
        return f"at no speed that was driven{where}: at the slowest, {slowest}, 95 % are within {best}"
    if limit.answer is Answer.EVERY:
        best = format_length(limit.error_fastest)
        return (
            f"at every speed that was driven{where}, up to {fastest}: 95 % are within {best} there; "
            "faster driving is not judged"
        )
    reached = split_interval(limit.speed, limit.low, limit.high)
    held = f"{format_share(limit.within)} of the predictions up to there are within it"
    return f"up to {reached[0]} m/s{where} (95 %: {reached[1]} to {reached[2]}); {held}"


def _show_within(number: Number) -> tuple[str, ...]:
    """A value, and the ends of its interval where there is one, with the digits that this supports."""
    value, low, high = (round_digits(one) for one in (number.value, number.low, number.high))
    if math.isnan(value):
        return ("-",)
    return (f"{value:.4g}",) if math.isnan(low) else split_interval(value, low, high)


def format_contest(contest: Contest) -> list[str]:
    """The table as text: `*` marks the smallest error, `=` errors that are not significantly larger."""
    width = max(len(rival.name) for rival in contest.rivals)
    best = {metric: contest.find_best(metric) for metric in ERRORS_OVER_2S}
    lines = [f"{'held-out error over 2 s':<{width}}  numbers  position m   heading deg  fit s"]

    def mark(rival: Rival, metric: str) -> str:
        if rival is best[metric]:
            return "*"
        return "=" if contest.is_best(rival, metric) else " "

    for rival in contest.rivals:
        numbers = "" if rival.numbers is None else str(rival.numbers)
        position, heading = (rival.read(metric) for metric in ERRORS_OVER_2S)
        lines.append(
            f"{rival.name:<{max(width, 23)}}  {numbers:>7}  "
            f"{position:>10.4f} {mark(rival, 't_mrmse_m')} {math.degrees(heading):>10.2f} "
            f"{mark(rival, 'r_mrmse_rad')} {rival.fit_s:>6.1f}"
        )
    lines += ["* smallest; = not significantly larger (95 % interval over stretches of 10 s)"]
    for metric, (words, _) in ERRORS_OVER_2S.items():
        tied = contest.ties[metric]
        said = f"{best[metric].name} has the smallest error of {words}"
        lines.append(f"{said}, not significantly different from {', '.join(tied)}" if tied else said)
    return lines


_TARGETS = {"differential": "ros2_control", "ackermann": "autoware", "mecanum": "nav2", "omni": "nav2"}
"""By the kind of a vehicle: the export that takes most of its effects and needs no other file."""


def suggest_export(file: ModelFile, path: str) -> str:
    """The command that exports a model, by the kind of its vehicle; other kinds have their numbers as JSON.

    Controllers get no value in doubt: a model of which all are is suggested as a function of Python.
    """
    acting = {
        f"{effect.id}.{parameter.name}"
        for effect in file.model
        for parameter in effect.parameters
        if math.isfinite(value := effect.values[parameter.name]) and value != parameter.neutral
    }
    is_known = not acting or bool(acting - set(file.list_doubtful()))
    target = _TARGETS.get(file.model.vehicle.kind, "json") if is_known else "python"
    return f"slip model export {shlex.quote(path)} --to {target}"


def list_omitted(doubtful: Mapping[str, Number]) -> list[str]:
    """Notes beside an exported file: the values that it leaves out, and how they are written all the same."""
    lines = [f"left out: {label}: {number.reason}" for label, number in doubtful.items()]
    return [*lines, "fixed = true beside a value in the model file exports it as your own"] if lines else []


def format_refusals(refusals: Mapping[str, str]) -> str:
    """Refusals in one clause: `slope_drift is not supported by the data (the reduction is not significant)`.

    Args:
        refusals: reasons by id, at least one.
    """
    reasons = list(dict.fromkeys(refusals.values()))
    said = reasons[0] if len(reasons) == 1 else "; ".join(f"{name}: {why}" for name, why in refusals.items())
    verb = "is" if len(refusals) == 1 else "are"
    return f"{', '.join(refusals)} {verb} not supported by the data ({said})"


def describe_offered(others: Collection[str]) -> str:
    """With which effects the values and errors of one that is offered were fitted.

    Args:
        others: ids of the effects of the present model.
    """
    return "as fitted beside the effects of this model" if others else "as fitted with no other effect"


def describe_partial(missing: Collection[str]) -> str:
    """Why values differ from those of a diagnosis; empty where the model has all of its effects.

    Args:
        missing: ids of the effects of the diagnosis that the model lacks.
    """
    lacks = format_count(len(missing), "effect")
    return f"Values as fitted in this model, which lacks {lacks} of the diagnosis." if missing else ""


def format_change(fit: ModelFit, refusals: Mapping[str, str], *, is_made: bool = True) -> list[str]:
    """The ladders of a model before and after a change, and its parameters.

    Args:
        fit: the model on runs.
        refusals: reasons against added effects, by id.
        is_made: whether the change is made in spite of them: else only the ladders are shown.
    """
    old, new, chosen = fit.before, fit.after, fit.chosen
    runs = ", ".join(new.data.names)
    lines = [f"{INPUT_WORDS[chosen.source.value]} of {runs} ({chosen.reason})"]
    lines += format_recordings([run_residuals.run for run_residuals in new.data.residuals_by_run])
    if old is not new:
        lines += ["", "before", *format_ladder(old.ladder, fit.floor), "", "after"]
    lines += format_ladder(new.ladder, fit.floor)
    if not is_made:
        return [*lines, ""]
    if old is not new:
        lines += describe_step(old.whole, new.whole, format_refusals(refusals) if refusals else "")
    if chosen.warning:
        lines.append(chosen.warning)
    lines += ["", "parameters", *format_parameters(fit.list_numbers(), fit.file.list_own())]
    prior = fit.list_prior()
    return [*lines, "", "prior", *format_parameters(prior)] if prior else lines


def format_transfers(rows: Sequence[tuple[str, Transfer]]) -> list[str]:
    """Errors of models on runs that they were not fitted on, by the name of the model."""
    lines = list(format_heads("held-out error of"))
    for name, item in rows:
        lines.append(format_measured_errors(f"{item.run}: ideal", item.ideal.pooled))
        lines.append(format_measured_errors(f"  {Path(name).name} as given", item.carried.pooled))
        lines.append(format_measured_errors("  refitted to this run", item.own.pooled))
        lines.append(f"  {describe_remaining(item.remaining)}")
        lines += [f"  fitted anew, as of the recording: {', '.join(item.renewed)}"] if item.renewed else []
        lines += [f"  {describe_beyond(item.beyond)}"] if item.beyond else []
    return lines
