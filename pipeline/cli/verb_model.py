"""`slip model`: make, show, change, fit, compare and export a model file."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from pipeline import datasets, estimation, models, results, sources, store, words
from pipeline.cli.conventions import (
    CLEAN,
    OwnEffects,
    Results,
    print_lines,
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

if TYPE_CHECKING:
    from pipeline.estimation.transfer import Transfer


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
    force: bool = False,
    quiet: bool = False,
) -> int:
    """Make a model file for a vehicle.

    Args:
        model: the file to make.
        ids: ids of effects to begin with, at neutral values, as `slip effects` lists them.
        vehicle: vehicle preset, for example husky_a200.
        template: a model of the literature to begin with, as `slip model literature` lists them.
        force: replace a file that is there.
        quiet: print nothing.
    """
    if model.exists() and not force:
        what, hint = "the file already exists", "Give --force to replace it."
        raise SlipError("model_exists", what, where=str(model), hint=hint)
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
    from pipeline.estimation.estimates import list_parameters  # noqa: PLC0415 - heavy
    from pipeline.export import export_model  # noqa: PLC0415

    file = open_model(model, effects)
    if json:
        sys.stdout.write(export_model(file, "json"))
        return CLEAN
    parameters = words.format_parameters(list_parameters(file))
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
        file = datasets.expect_model(spoken.open(), spoken.input, store.Store(spoken.results))
    elif model is None:
        hint = "Give one, or use the fleet's prior: --prior fleet."
        raise SlipError("no_model", "no model file was given", where="slip model fit", hint=hint)
    else:
        file = open_model(model, spoken.effects)
    changed = file
    if afresh:
        neutral = [effect.change(**{p.name: p.neutral for p in effect.parameters}) for effect in file.model]
        changed = replace(file, model=file.model.swap(*neutral), intervals={})
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
    manifests = spoken.open()
    files = [datasets.put_on_runs(file, manifests, spoken.vehicle_of) for file in opened]
    # Both models use the same input, so that their errors are comparable.
    last = {file.last_input for file, _ in files}
    effects = [effect for file, _ in files for effect in file.model]
    only = last.pop() if len(last) == 1 else None
    chosen = estimation.choose_input(files[0][1], spoken.input, effects, last=only)
    rows: list[tuple[str, Transfer]] = []
    warnings = [chosen.warning]
    for path, (file, runs) in zip(paths, files, strict=True):
        own = {str(row.get("run")) for row in file.list_fitted("runs")} & {run.name for run in runs}
        seen = "its error there is not a held-out error"
        warnings += [f"{path} was fitted to {name}: {seen}" for name in sorted(own)]
        fitted_on = [str(run.get("terrain")) for run in file.list_fitted("runs")]
        carried = estimation.carry_over(
            file.model, runs, chosen.source, fitted_on=fitted_on, per_run=file.per_run
        )
        rows += [(str(path), item) for item in carried]
    content = {
        "input": chosen.source.value,
        "input_reason": chosen.reason,
        "compared": [_transfer_as_json(name, item) for name, item in rows],
    }
    fed = f"{INPUT_WORDS[chosen.source.value]} ({chosen.reason})"
    warnings += [item.warning for _, item in rows]
    return spoken.print(content, lambda: [fed, *_format_transfers(rows)], [*filter(None, warnings)])


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
    from pipeline.estimation.tolerance import limit_speeds, limits_as_json  # noqa: PLC0415 - heavy

    tolerance_m, ahead_s = read_metres(within), read_seconds(ahead, "--ahead")
    opened = open_model(model, spoken.effects)
    file, runs = datasets.put_on_runs(opened, spoken.open(), spoken.vehicle_of)
    chosen = estimation.choose_input(runs, spoken.input, file.model, last=file.last_input)
    limits = limit_speeds(file, runs, chosen.source, tolerance_m, ahead_s)
    content = {
        "within_m": tolerance_m,
        "ahead_s": ahead_s,
        "input": chosen.source.value,
        "terrains": limits_as_json(limits),
    }
    lines = [
        f"{INPUT_WORDS[chosen.source.value]} of {', '.join(run.name for run in runs)} ({chosen.reason})",
        *words.format_speed_limits(limits, tolerance_m, ahead_s),
    ]
    return spoken.print(content, lambda: lines, [*filter(None, [chosen.warning])])


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
    effects: OwnEffects = None,
) -> int:
    """Export a model to what people run.

    Each line names the effect that it comes from.

    Args:
        model: the model file.
        to: ros2_control, nav2, nav2_amcl, autoware, vesc, px4, robot_localization, gazebo, json or python.
    """
    from pipeline.export import export_model, read_current, require_errors  # noqa: PLC0415 - heavy

    used = None if current is None else read_current(current, to)
    opened = open_model(model, effects)
    if on:
        require_errors(to)
        opened = datasets.judge_measured(opened, On(on=on, results=results).open())
    text = export_model(opened, to, used, gate)
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
    after, gathered = datasets.put_on_runs(after, spoken.open(*predict), spoken.vehicle_of)
    runs, others = gathered[: len(spoken.on)], gathered[len(spoken.on) :]
    fleet = None if prior is None else store.Store(spoken.results)
    fit = datasets.fit_to_runs(before, after, runs, spoken.input, first_s=first_s, fleet=fleet)
    refusals = fit.explain_refusals()
    if must_help and refusals:
        added = set(fit.after.whole.effects) - set(fit.before.whole.effects)
        hint = "Add the others without it" if len(refusals) < len(added) else "Choose another effect"
        what = f"{words.format_refusals(refusals)}: the model is unchanged"
        raise SlipError("no_help", what, where=str(path), hint=f"{hint}, or give --anyway")
    if path is not None:
        models.write_model(fit.file, path)
    provenance = {"fitted_on": [run.terrain for run in runs], "per_run": fit.file.per_run}
    carried = estimation.carry_over(fit.file.model, others, fit.chosen.source, **provenance) if others else []
    content = {
        "model": None if path is None else str(path),
        **fit.to_json(),
        "prior": fit.prior_as_json(),
        "carried_over": [_transfer_as_json(str(path), item) for item in carried],
    }

    def format_lines() -> list[str]:
        lines = _format_change(fit, refusals)
        lines += [] if path is None else [f"written: {path}"]
        return lines + (["", *_format_transfers([(str(path), item) for item in carried])] if carried else [])

    warnings = [text for text in (fit.chosen.warning, *(item.warning for item in carried)) if text]
    return spoken.print(content, format_lines, warnings)


def _transfer_as_json(name: str, item: Transfer) -> dict[str, object]:
    return {
        "model": name,
        "run": item.run,
        "terrain": item.terrain,
        "carried": results.to_json(item.carried.pooled),
        "own_fit": results.to_json(item.own.pooled),
        "ideal": results.to_json(item.ideal.pooled),
        "ratio": item.ratio,
        "warning": item.warning,
    }


def _format_change(fit: datasets.ModelFit, refusals: Mapping[str, str]) -> list[str]:
    from pipeline.estimation.estimates import parameters_as_json  # noqa: PLC0415 - heavy

    old, new, chosen = fit.before, fit.after, fit.chosen
    runs = ", ".join(new.data.names)
    lines = [f"{INPUT_WORDS[chosen.source.value]} of {runs} ({chosen.reason})"]
    lines += words.format_recordings([run_residuals.run for run_residuals in new.data.residuals_by_run])
    if old is not new:
        lines += ["", "before", *words.format_ladder(old.ladder, fit.floor), "", "after"]
    lines += words.format_ladder(new.ladder, fit.floor)
    if old is not new:
        lines += words.describe_step(
            old.whole, new.whole, words.format_refusals(refusals) if refusals else ""
        )
    if chosen.warning:
        lines.append(chosen.warning)
    parameters = parameters_as_json(new.fitted.model, new.estimates)
    prior = fit.prior_as_json()
    lines += ["", "parameters", *words.format_parameters(parameters)]
    return [*lines, "", "prior", *words.format_parameters(prior)] if prior else lines


def _format_transfers(rows: Sequence[tuple[str, Transfer]]) -> list[str]:
    lines = list(words.format_heads("held-out error of"))
    for name, item in rows:
        lines.append(words.format_measured_errors(f"{item.run}: ideal", item.ideal.pooled))
        lines.append(words.format_measured_errors(f"  {Path(name).name} as given", item.carried.pooled))
        lines.append(words.format_measured_errors("  refitted to this run", item.own.pooled))
        lines.append(f"  error as given over error refitted: {item.ratio:.2f}")
    return lines


def _list_effects(ids: Sequence[str]) -> str:
    return ", ".join(ids) if ids else "the ideal model, no effect"


def _list_idle(model: models.Model) -> list[str]:
    """Effects that do not act, since the model lacks what they act beside."""
    return [f"  ! {effect.id} {why}" for effect in model if (why := models.explain_idle(effect, model.ids))]
