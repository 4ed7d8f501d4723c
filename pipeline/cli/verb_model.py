"""`slip model`: make, show, change, fit, compare and export a model file."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from pipeline import api, models, sources, words
from pipeline.cli.conventions import (
    CLEAN,
    Force,
    OwnEffects,
    Results,
    print_lines,
    print_note,
    require_new,
)
from pipeline.cli.model_runs import (
    Against,
    On,
    Spoken,
    compare_rivals,
    literature,
    new_effect,
    open_model,
    read_metres,
    read_seconds,
)
from pipeline.core import INPUT_WORDS, SlipError


def build_model() -> App:
    """The verb and its own verbs."""
    model = App(name="model", help="Make, show, change, fit, compare and export a motion model.")
    for command in (new, new_effect, literature, show, add, fit, compare, speed, export):
        model.command(command)
    model.command(drop, name=("drop", "remove"))
    return model


def new(  # noqa: D417 - the shared option documents itself
    model: Path,
    /,
    *ids: str,
    vehicle: str,
    template: Annotated[str | None, Parameter(name="--from")] = None,
    effects: OwnEffects = None,
    force: Force = False,
    quiet: bool = False,
) -> int:
    """Make a model file for a vehicle.

    Args:
        model: the file to make.
        ids: ids of effects to begin with, at neutral values, as `slip effects` lists them.
        vehicle: vehicle preset, for example husky_a200.
        template: a model of the literature to begin with, as `slip model literature` lists them.
        quiet: print nothing.
    """
    require_new(model, force=force)
    section = sources.VehicleSection(preset=vehicle)
    chosen = sources.resolve_vehicle(section, recorded=None, where=str(model))
    made = models.find_model(template or "ideal").make(chosen)
    models.load_effects(effects or ())
    for name in ids:
        made = made + models.find_effect(name)()
    models.write_model(models.ModelFile(made), model)
    if not quiet:
        print_lines([f"{model}: {chosen.name}, {_list_effects(made.ids)}", *_list_idle(made)])
    return CLEAN


def show(  # noqa: D417 - the shared option documents itself
    model: Path, /, *, effects: OwnEffects = None, json: bool = False
) -> int:
    """Show a model: its effects, values, intervals and runs.

    Args:
        model: the model file.
        json: print one JSON object.
    """
    file = open_model(model, effects)
    if json:
        sys.stdout.write(api.dump_model(file))
        return CLEAN
    parameters = words.format_parameters(file.list_numbers(), file.list_own())
    lines = [f"{file.model.vehicle.name}: {_list_effects(file.model.ids)}", *parameters]
    lines += _list_idle(file.model)
    if runs := file.list_fitted("runs"):
        source = str(file.fit.get("input"))
        names = ", ".join(str(run.get("run")) for run in runs)
        lines.append(f"fitted {INPUT_WORDS.get(source, source)}: {names}")
    lines += [f"undecided: {' or '.join(group)}" for group in file.undecided]
    print_lines(lines)
    return CLEAN


def add(  # noqa: D417 - the shared options document themselves
    model: Path, /, *ids: str, spoken: Spoken, anyway: bool = False
) -> int:
    """Add effects to a model, fit it, and show what they bring.

    An effect is refused, and the file stays as it was, if the data do not support it: its sign is impossible,
    an error over 2 s rises or none falls, the reduction is not significant, or an interval includes the
    neutral value. One that cannot act on the input is always refused: it would have no value.

    Args:
        model: the model file.
        ids: ids of effects, as `slip effects` lists them.
        anyway: add the effects even if the data do not support them.
    """
    file = open_model(model, spoken.effects)
    changed = file.model
    for name in ids:
        changed = changed + models.find_effect(name)()
    return _change(model, file, replace(file, model=changed), spoken, must_help=not anyway)


def drop(  # noqa: D417 - the shared options document themselves
    model: Path, /, *ids: str, spoken: Spoken
) -> int:
    """Drop effects from a model, and fit the rest.

    Args:
        model: the model file.
        ids: ids of effects that the model has.
    """
    file = open_model(model, spoken.effects)
    changed = file.model
    for name in ids:
        changed = changed - name
    return _change(model, file, replace(file, model=changed), spoken)


def fit(  # noqa: D417 - the shared options document themselves
    model: Path | None = None,
    /,
    *,
    spoken: Spoken,
    predict: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    afresh: bool = False,
    first: str | None = None,
    prior: Literal["fleet"] | None = None,
) -> int:
    """Fit the parameters of a model to runs.

    With --predict, other runs are predicted with them.

    Args:
        model: the model file, which is overwritten: copy it to keep it. With --prior it may be missing, or
            be left out: the model then uses the fleet's prior.
        predict: logs or runs that the fit must not see, to be predicted with it.
        afresh: discard the present values and search from the start.
        first: fit the first seconds of driving only, for example 20s.
        prior: fleet: use the other runs of the vehicle in the results folder as a prior.
    """
    first_s = None if first is None else read_seconds(first)
    if prior is not None and (model is None or not model.exists()):
        models.load_effects(spoken.effects or ())
        file = api.expect_model(spoken.open(), spoken.input, spoken.results)
    elif model is None:
        hint = "Give one, or use the fleet's prior: --prior fleet."
        raise SlipError("no_model", "no model file was given", where="slip model fit", hint=hint)
    else:
        file = open_model(model, spoken.effects)
    changed = file
    if afresh:
        bare = file.model.swap(*(effect.unfitted for effect in file.model))
        changed = replace(file, model=bare, numbers={})
    return _change(model, file, changed, spoken, predict=predict or (), first_s=first_s, prior=prior)


def compare(  # noqa: D417 - the shared options document themselves
    model: Path | None = None, other: Path | None = None, /, *, spoken: Spoken, against: Against = None
) -> int:
    """Compare two models, with their present values, on runs.

    A fit of each to the runs is shown as well. With --against, the given models
    and models of the literature are fitted to the runs, and their held-out errors compared.

    Args:
        model: a model file; with --against it may be left out.
        other: another one.
    """
    paths = list(dict.fromkeys(path for path in (model, other) if path is not None))
    if against is None and (model is None or other is None):
        hint = "Give two, or compare with others: --against literature."
        raise SlipError("no_model", "two model files are compared", where="slip model compare", hint=hint)
    opened = [open_model(path, spoken.effects) for path in paths]
    if against is not None:
        return compare_rivals(dict(zip(map(str, paths), opened, strict=True)), spoken)
    files = dict(zip(map(str, paths), opened, strict=True))
    carried = api.carry_models(files, spoken.open(), source=spoken.input, owner=spoken.vehicle_of)
    fed = f"{INPUT_WORDS[carried.chosen.source.value]} ({carried.chosen.reason})"
    return spoken.print(
        carried.to_json(), lambda: [fed, *words.format_transfers(carried.rows)], carried.warnings
    )


def speed(  # noqa: D417 - the shared options document themselves
    model: Path, /, *, spoken: Spoken, within: str, ahead: str = "2s"
) -> int:
    """Find the highest speed at which predictions stay within a tolerance.

    One answer for each terrain of the runs: the highest speed with 95 % of the predicted positions within it,
    no speed that was driven, or every one.

    Args:
        model: the model file.
        within: largest error of the predicted position, for example 10cm.
        ahead: how far ahead, up to 2s.
    """
    within_m, ahead_s = read_metres(within), read_seconds(ahead, "--ahead")
    file = open_model(model, spoken.effects)
    speeds = api.find_speeds(
        file, spoken.open(), within_m, ahead_s, source=spoken.input, owner=spoken.vehicle_of
    )
    chosen = speeds.chosen
    lines = [
        f"{INPUT_WORDS[chosen.source.value]} of {', '.join(speeds.runs)} ({chosen.reason})",
        *words.format_speed_limits(speeds.limits, within_m, ahead_s),
    ]
    return spoken.print(speeds.to_json(), lambda: lines, [*filter(None, [chosen.warning])])


def export(  # noqa: D417 - the options document themselves
    model: Path,
    /,
    *,
    to: str,
    current: Annotated[
        Path | None,
        Parameter(help="vesc, px4: the robot's file of parameters, which is corrected"),
    ] = None,
    on: Annotated[
        list[str] | None,
        Parameter(
            help="robot_localization, nav2_amcl: logs or runs for the held-out errors", consume_multiple=True
        ),
    ] = None,
    gate: Annotated[
        Literal["off", "on", "auto"] | None,
        Parameter(help="autoware: the steering offset is not applied, applied, or applied and learned on"),
    ] = None,
    results: Results = Path("results"),
    file: Annotated[Path | None, Parameter(help="file to write; standard output without one")] = None,
    force: Force = False,
    effects: OwnEffects = None,
) -> int:
    """Export a model to what people run.

    Each line names the effect that it comes from.

    Args:
        model: the model file.
        to: ros2_control, nav2, nav2_amcl, autoware, vesc, px4, robot_localization, gazebo, json, python
            or latex.
    """
    if file is not None:
        require_new(file, force=force)
    opened = open_model(model, effects)
    if on:
        api.require_errors(to)
    runs = On(on=on, results=results).open() if on else ()
    text = api.export_file(opened, to, current=current, gate=gate, runs=runs)
    for line in words.list_omitted(api.list_omitted(opened, to)):
        print_note(line)
    if file is None:
        sys.stdout.write(text)
    else:
        models.write_text(file, text, code="export_unwritable")
    return CLEAN


def _change(
    path: Path | None,
    before: models.ModelFile,
    after: models.ModelFile,
    spoken: On,
    *,
    predict: Sequence[str] = (),
    must_help: bool = False,
    first_s: float | None = None,
    prior: Literal["fleet"] | None = None,
) -> int:
    """Evaluate a model before and after a change, fit it, write its file, and print.

    Raises:
        SlipError: ``no_help``, with ``must_help``: the file is unchanged.
    """
    gathered = spoken.open(*predict)
    changed = api.change_model(
        before,
        after,
        gathered[: len(spoken.on)],
        gathered[len(spoken.on) :],
        source=spoken.input,
        owner=spoken.vehicle_of,
        first_s=first_s,
        fleet=None if prior is None else spoken.results,
    )
    refusals = changed.refusals
    if must_help and refusals:
        if not (spoken.json or spoken.quiet):
            # What it would have made of the errors is shown all the same.
            print_lines(words.format_change(changed.fit, refusals, is_made=False))
        hint = "Add the others without it" if len(refusals) < len(changed.added) else "Choose another effect"
        what = f"{words.format_refusals(refusals)}: the model is unchanged"
        raise SlipError("no_help", what, where=str(path), hint=f"{hint}, or give --anyway")
    if path is not None:
        models.write_model(changed.fit.file, path)

    def format_lines() -> list[str]:
        lines = words.format_change(changed.fit, refusals)
        lines += [] if path is None else [f"written: {path}"]
        rows = [(str(path), item) for item in changed.carried]
        return lines + (["", *words.format_transfers(rows)] if rows else [])

    return spoken.print(changed.to_json(None if path is None else str(path)), format_lines, changed.warnings)


def _list_effects(ids: Sequence[str]) -> str:
    return ", ".join(ids) if ids else "the ideal model, no effect"


def _list_idle(model: models.Model) -> list[str]:
    """Effects that do not act, since the model lacks what they act beside."""
    return [f"  ! {effect.id} {why}" for effect in model if (why := models.explain_idle(effect, model.ids))]
