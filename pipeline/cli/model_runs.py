"""Shared by verbs that work on models: runs, model files, few-shot fits, models of the literature."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline import datasets, models, sources
from pipeline.analysis import Options
from pipeline.cli.conventions import (
    CLEAN,
    OwnEffects,
    Results,
    open_shown,
    print_json,
    print_lines,
    print_note,
    print_result,
    print_warnings,
)
from pipeline.core import INPUT_WORDS, NORMAL_95, SlipError, format_count

if TYPE_CHECKING:
    from pipeline.estimation.estimation_data import EstimationData
    from pipeline.run import MotionRun
    from pipeline.store import Manifest


def open_model(path: Path, effects: Sequence[Path] | None) -> models.ModelFile:
    """Read a model file, with the user's own effects that are in the given Python files.

    Raises:
        MotionError: a file is wrong, or the model has an effect that is not known.
    """
    models.load_effects(effects or ())
    return models.read_model(path)


def new_effect(file: Path, /, *, force: bool = False, quiet: bool = False) -> int:
    """Write a template of an effect of your own.

    The template runs unchanged.

    Args:
        file: the Python file to write; the effect has the name of the file, wind for wind.py.
        force: replace a file that is there.
        quiet: print nothing.
    """
    from pipeline.run import MotionError  # noqa: PLC0415

    text = models.draft_effect(file)
    if file.exists() and not force:
        what, hint = "the file already exists", "Give --force to replace it."
        raise MotionError("effect_exists", what, where=str(file), hint=hint)
    models.write_text(file, text, code="effect_unwritable")
    if not quiet:
        own, model = shlex.quote(str(file)), shlex.quote(str(file.with_name("robot.toml")))
        print_lines(
            [
                f"{file}: the effect {file.stem}; change its formula, its parameters and its test",
                f"next      slip model new {model} --vehicle husky_a200",
                f"next      slip model add {model} {file.stem} --effects {own} --on run.mcap",
            ]
        )
    return CLEAN


def gather_runs(
    names: Sequence[str],
    vehicle: sources.Vehicle | None,
    owner: sources.Owner | None,
    out: Path,
    *,
    quiet: bool,
) -> tuple[sources.Vehicle, list[MotionRun]]:
    """Runs by name of a log or of a stored run, read with one vehicle's geometry; results stay as they are.

    Args:
        names: paths of logs, or names of runs in the results folder.
        vehicle: of the model; None for that of the first run.
        owner: geometry to use where the run's is another one.
        out: results folder.
        quiet: print nothing on stderr.

    Returns:
        The vehicle that counts, and the runs.

    Raises:
        SlipError: a log cannot be read, there is no such run, or its vehicle contradicts the model's.
    """
    if not names:
        raise SlipError("no_runs", "--on names no run", hint="Give logs, or runs of the results folder")
    options = Options(out=out, report=False, diagnosis=True)
    manifests: list[Manifest] = []
    notes: list[str] = []
    for name in names:
        with open_shown(name, options, quiet=quiet, notify=notes.append) as opened:
            manifests.append(opened.manifest)
    recordings = datasets.read_runs(manifests, vehicle, owner)
    for note in notes:
        print_note(note)
    return recordings


def judge_measured(file: models.ModelFile, target: str, names: Sequence[str], out: Path) -> models.ModelFile:
    """A model as `slip model fit --input measured` would write it, for a target that writes held-out errors.

    Args:
        file: the model; its own file stays.
        target: name of the target.
        names: paths of logs, or names of runs in the results folder.
        out: results folder.

    Raises:
        MotionError: the target writes none, or a run has no measured wheels; others as `gather_runs`.
    """
    from pipeline.estimation.estimation_data import EstimationData  # noqa: PLC0415
    from pipeline.estimation.ladder import assess_model, note_fit  # noqa: PLC0415
    from pipeline.estimation.odometry_noise import measure_alphas  # noqa: PLC0415
    from pipeline.estimation.run_residuals import Input  # noqa: PLC0415 - heavy
    from pipeline.export import require_errors  # noqa: PLC0415

    require_errors(target)
    vehicle, runs = gather_runs(names, file.model.vehicle, None, out, quiet=False)
    file = replace(file, model=replace(file.model, vehicle=vehicle))
    data = EstimationData(runs, vehicle, Input.MEASURED)
    assessment = assess_model(data, file.model, per_run=file.per_run)
    noted = note_fit(file, assessment)
    steps = zip(noted.list_fitted("ladder"), assessment.ladder.steps, strict=True)
    ladder = [{**row, "odometry_alphas": measure_alphas(data, step.fitted)} for row, step in steps]
    return replace(noted, fit={**noted.fit, "ladder": ladder})


_SECONDS = re.compile(r"(\d+(?:\.\d+)?)\s*s?")


def read_seconds(text: str, where: str = "--first") -> float:
    """Seconds of `20s` or `20`, an option's.

    Raises:
        MotionError: ``bad_duration``.
    """
    from pipeline.run import MotionError  # noqa: PLC0415 - heavy

    match = _SECONDS.fullmatch(text.strip())
    if match is None or not float(match[1]) > 0.0:
        raise MotionError("bad_duration", f"{text!r} is not a duration", where=where, hint="Write 20s.")
    return float(match[1])


_METRES = re.compile(r"(\d+(?:\.\d+)?)\s*(mm|cm|m)")


def read_metres(text: str) -> float:
    """Metres of `10cm`, `0.1m` or `100mm`: a length needs its unit; `limit_speeds` refuses one of zero.

    Raises:
        MotionError: ``bad_tolerance``.
    """
    from pipeline.run import MotionError  # noqa: PLC0415 - heavy

    match = _METRES.fullmatch(text.strip())
    if match is None:
        what = f"{text!r} is not a length"
        raise MotionError("bad_tolerance", what, where="--within", hint="Write 10cm or 0.1m.")
    return float(match[1]) * sources.LENGTH_UNITS[match[2]]


def require_model(path: Path | None) -> Path:
    """The model file.

    Raises:
        MotionError: ``no_model``: none was given.
    """
    from pipeline.run import MotionError  # noqa: PLC0415 - heavy

    if path is None:
        hint = "Give one, or use the fleet's prior: --prior fleet."
        raise MotionError("no_model", "no model file was given", where="slip model fit", hint=hint)
    return path


def require_models(model: Path | None, other: Path | None) -> None:
    """Two model files were given.

    Raises:
        MotionError: ``no_model``.
    """
    from pipeline.run import MotionError  # noqa: PLC0415 - heavy

    if model is None or other is None:
        hint = "Give two, or compare with others: --against literature."
        raise MotionError("no_model", "two model files are compared", where="slip model compare", hint=hint)


def cut_first(runs: Sequence[MotionRun], first_s: float) -> list[MotionRun]:
    """The first seconds of driving of each run.

    Raises:
        MotionError: ``too_short``: a run was not driven for so long.
    """
    from pipeline.run import cut_run, find_driven  # noqa: PLC0415 - heavy

    return [cut_run(run, end_s=find_driven(run, first_s)) for run in runs]


def expect_runs(
    runs: Sequence[MotionRun], vehicle: sources.Vehicle, source: Literal["command", "measured"], out: Path
) -> datasets.Expected:
    """The fleet's prior on the ground of these runs, which themselves do not count.

    Raises:
        SlipError: there is no fleet; or ``several_terrains``.
    """
    from pipeline.run import MotionError  # noqa: PLC0415
    from pipeline.store import Store  # noqa: PLC0415

    terrains = sorted({run.terrain for run in runs})
    if len(terrains) > 1:
        raise MotionError(
            "several_terrains",
            f"the runs are on {', '.join(terrains)}, and a prior applies to one terrain",
            where=", ".join(run.name for run in runs),
            hint="Fit the runs of each terrain separately.",
        )
    without = [run.sha256 for run in runs]
    return datasets.expect_run(Store(out), vehicle.id, terrains[0], source, without=without)


def expect_model(names: Sequence[str], source: str | None, out: Path, *, quiet: bool) -> models.ModelFile:
    """The model of the fleet's prior for the vehicle and the ground of runs.

    Raises:
        SlipError: a log cannot be read, runs are of several vehicles, or there is no fleet.
    """
    from pipeline.estimation.run_residuals import choose_input  # noqa: PLC0415

    vehicle, runs = gather_runs(names, None, None, out, quiet=quiet)
    chosen = choose_input(runs, source)
    return models.ModelFile(
        models.Model(vehicle, expect_runs(runs, vehicle, chosen.source.value, out).effects)
    )


def tie_to_fleet(data: EstimationData, model: models.Model, out: Path) -> EstimationData:
    """The data with the fleet's numbers as prior.

    Raises:
        SlipError: see `expect_runs`.
    """
    expected = expect_runs(data.runs, model.vehicle, data.source.value, out)
    return data.with_prior(expected.prior)


def prior_as_json(data: EstimationData) -> dict[str, dict[str, object]]:
    """What was known of the numbers before the fit, by label: value and 95 % interval; empty if nothing."""
    values: dict[str, dict[str, object]] = {}
    for label, (mean, deviation) in data.paths[0].prior.numbers.items():
        effect, _, name = label.partition(".")
        half = NORMAL_95 * deviation
        parameter = models.find_effect(effect)().parameter(name)
        low, high = models.cut_interval(mean - half, mean + half, parameter.bounds)
        values[label] = {"value": mean, "low": low, "high": high, "unit": parameter.unit}
    return values


Against = Annotated[Literal["literature"] | None, Parameter(help="compare with models of the literature")]


def literature(name: str | None = None, /, *, json: bool = False) -> int:
    """List motion models of the literature, or show one.

    `slip model new FILE --from NAME` makes a model file of it.

    Args:
        name: a model of the literature.
        json: print one JSON object.
    """
    if name is None:
        every = models.list_literature()
        content = {"models": [_as_json(model) for model in every]}
        return print_result(content, lambda: [_list_model(model) for model in every], json=json)
    model = models.find_model(name)
    return print_result(_as_json(model), lambda: _format_model(model), json=json)


def _as_json(model: models.LiteratureModel) -> dict[str, object]:
    return {
        "name": model.name,
        "title": model.title,
        "formula": list(model.formula),
        "source": model.source,
        "link": model.link,
        "kinds": list(model.kinds),
        "numbers": model.count_numbers(),
        "effects": list(model.effects),
        "terms": dict(model.terms),
        "needs": model.needs,
    }


def _list_model(model: models.LiteratureModel) -> str:
    number = model.count_numbers()
    count = format_count(number, "number")
    return f"{model.name:<28} {count:<14} {model.title}"


def _format_model(model: models.LiteratureModel) -> list[str]:
    lines = [f"{model.name}: {model.title}", "", *(f"    {formula}" for formula in model.formula), ""]
    lines += [f"vehicles  {', '.join(model.kinds)}"]
    lines += [f"needs     {model.needs}"] if model.needs else []
    lines += [f"numbers   {model.count_numbers()}"]
    lines += [f"effects   {', '.join(model.effects)}"] if model.effects else []
    lines += [f"formula   {channel} += {text}" for channel, text in model.terms.items()]
    source = f"{model.source}, {model.link}" if model.link else model.source
    return [*lines, f"source    {source}"]


def compare_rivals(files: Mapping[str, models.ModelFile], spoken: On) -> int:
    """Fit models and those of the literature to runs, and print their held-out errors.

    Args:
        files: models by the name of their file; may be empty.
        spoken: the runs, and how the answer is printed.
    """
    from pipeline.words import format_contest  # noqa: PLC0415 - heavy

    quiet = spoken.quiet or spoken.json
    known = next((file.model.vehicle for file in files.values()), None)
    vehicle, runs = gather_runs(spoken.on, known, spoken.vehicle_of, spoken.results, quiet=quiet)
    contest = datasets.contest_models(files, runs, vehicle, spoken.input)
    warnings = [contest.chosen.warning] if contest.chosen.warning else []
    if len(models.list_models(vehicle)) == 1:
        warnings.append(
            f"no model of the literature but the ideal one describes a {vehicle.kind} vehicle: "
            "`slip model literature` lists each model with its vehicles"
        )
    if spoken.json:
        print_json({**contest.to_json(), "warnings": warnings})
    elif not spoken.quiet:
        words = INPUT_WORDS[contest.chosen.source.value]
        print_lines(
            [
                f"{words} of {', '.join(contest.runs)} ({contest.chosen.reason})",
                *format_contest(contest.contest),
            ]
        )
        print_warnings(warnings)
    return CLEAN


@dataclass(frozen=True, kw_only=True)
class On:
    """On what a model is fitted and judged, and how the answer is printed."""

    on: Annotated[list[str], Parameter(help="logs, or runs of the results folder", consume_multiple=True)]
    input: Annotated[
        Literal["command", "measured"] | None,
        Parameter(help="input of the model (default: the command if effects need it, else as last time)"),
    ] = None
    vehicle_of: Annotated[
        Literal["model", "run"] | None,
        Parameter(help="geometry to use where the run is of another vehicle (default: refuse)"),
    ] = None
    results: Results = Path("results")
    effects: OwnEffects = None
    json: Annotated[bool, Parameter(help="print one JSON object")] = False
    quiet: Annotated[bool, Parameter(help="print no progress and no table")] = False


Spoken = Annotated[On, Parameter(name="*")]
