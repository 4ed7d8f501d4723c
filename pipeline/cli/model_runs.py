"""Shared by verbs that work on models: runs, model files, models of the literature."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pipeline import api, models, sources, store, words
from pipeline.analysis import Options
from pipeline.cli.conventions import (
    CLEAN,
    Force,
    OwnEffects,
    Results,
    open_shown,
    print_lines,
    print_note,
    print_result,
    require_new,
)
from pipeline.core import INPUT_WORDS, SlipError, format_count


def open_model(path: Path, effects: Sequence[Path] | None) -> models.ModelFile:
    """Read a model file, with the user's own effects that are in the given Python files.

    Raises:
        SlipError: a file is wrong, or the model has an effect that is not known.
    """
    models.load_effects(effects or ())
    return models.read_model(path)


def new_effect(  # noqa: D417 - the shared option documents itself
    file: Path, /, *, force: Force = False, quiet: bool = False
) -> int:
    """Write a template of an effect of your own.

    The template runs unchanged.

    Args:
        file: the Python file to write; the effect has the name of the file, wind for wind.py.
        quiet: print nothing.
    """
    text = models.draft_effect(file)
    require_new(file, force=force)
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


_SECONDS = re.compile(r"(\d+(?:\.\d+)?)\s*s?")


def read_seconds(text: str, where: str = "--first") -> float:
    """Seconds of `20s` or `20`, an option's.

    Raises:
        SlipError: ``bad_duration``.
    """
    match = _SECONDS.fullmatch(text.strip())
    if match is None or not float(match[1]) > 0.0:
        raise SlipError("bad_duration", f"{text!r} is not a duration", where=where, hint="Write 20s.")
    return float(match[1])


_METRES = re.compile(r"(\d+(?:\.\d+)?)\s*(mm|cm|m)")


def read_metres(text: str) -> float:
    """Metres of `10cm`, `0.1m` or `100mm`: a length needs its unit; `limit_speeds` refuses one of zero.

    Raises:
        SlipError: ``bad_tolerance``.
    """
    match = _METRES.fullmatch(text.strip())
    if match is None:
        what = f"{text!r} is not a length"
        raise SlipError("bad_tolerance", what, where="--within", hint="Write 10cm or 0.1m.")
    return float(match[1]) * sources.LENGTH_UNITS[match[2]]


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
        rows = [(f"{one.name:<28}", format_count(one.count_numbers(), "number"), one.title) for one in every]
        return print_result(content, lambda: [f"{a} {b:<14} {c}" for a, b, c in rows], json=json)
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
    contest, kind = api.contest_models(files, spoken.open(), source=spoken.input, owner=spoken.vehicle_of)
    warnings = [contest.chosen.warning] if contest.chosen.warning else []
    # The ideal model is one of them.
    if len(contest.contest.rivals) == len(files) + 1:
        warnings.append(
            f"no model of the literature but the ideal one describes a {kind} vehicle: "
            "`slip model literature` lists each model with its vehicles"
        )
    fed = f"{INPUT_WORDS[contest.chosen.source.value]} of {', '.join(contest.runs)} ({contest.chosen.reason})"
    return spoken.print(contest.to_json(), lambda: [fed, *words.format_contest(contest.contest)], warnings)


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

    def open(self, *others: str) -> list[store.Manifest]:
        """Results of these runs, by name or by their log, and of others; what is there stays as it is.

        Raises:
            SlipError: there is no name, a log cannot be read, or there is no such run.
        """
        if not self.on:
            raise SlipError("no_runs", "--on names no run", hint="Give logs, or runs of the results folder")
        options = Options(out=self.results, report=False, diagnosis=True)
        with ExitStack() as stack:
            show = partial(open_shown, options=options, quiet=self.quiet or self.json)
            return [stack.enter_context(show(name)).manifest for name in (*self.on, *others)]

    def print(
        self,
        content: Mapping[str, object],
        format_lines: Callable[[], Iterable[str]],
        warnings: Sequence[str],
    ) -> int:
        """Print an answer and its warnings; the exit code."""
        answer = {**content, "warnings": list(warnings)}
        print_result(answer, format_lines, json=self.json, quiet=self.quiet)
        for text in () if self.json or self.quiet else warnings:
            print_note(f"slip: {text}")
        return CLEAN


Spoken = Annotated[On, Parameter(name="*")]
