"""Runs for the verbs: stored runs are read, logs without results are analyzed first."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.cli.output import say, show_progress
from pipeline.core.errors import SlipError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from pipeline.analysis.geometry import Owner
    from pipeline.analysis.options import Options
    from pipeline.analysis.stored import OpenedRun
    from pipeline.models.model_file import ModelFile
    from pipeline.runs.recording import MotionRun
    from pipeline.store import Manifest
    from pipeline.vehicles import Vehicle


@contextmanager
def open_shown(
    name: str, options: Options, *, quiet: bool, tell: Callable[[str], None] = say
) -> Iterator[OpenedRun]:
    """A run as `open_run` gives it, its progress shown; ``tell`` is given its note afterwards."""
    from pipeline.analysis.stored import open_run  # noqa: PLC0415 - heavy

    with (
        show_progress(Path(name).name, quiet=quiet) as progress,
        open_run(name, options, progress) as opened,
    ):
        yield opened
    if opened.note and not quiet:
        tell(f"slip: {opened.note}")


def gather_runs(
    names: Sequence[str], vehicle: Vehicle | None, owner: Owner | None, out: Path, *, quiet: bool
) -> tuple[Vehicle, list[MotionRun]]:
    """Runs by name of a log or of a stored run, read with one vehicle's geometry; results stay as they are.

    Args:
        names: paths of logs, or names of runs in the results folder.
        vehicle: of the model; None for that of the first run.
        owner: whose geometry counts where the run's is another one.
        out: results folder.
        quiet: tell nothing on stderr.

    Returns:
        The vehicle that counts, and the runs.

    Raises:
        SlipError: a log cannot be read, there is no such run, or its vehicle contradicts the model's.
    """
    from pipeline.analysis.model_fit import read_runs  # noqa: PLC0415 - heavy
    from pipeline.analysis.options import Options  # noqa: PLC0415

    if not names:
        raise SlipError("no_runs", "--on names no run", hint="Give logs, or runs of the results folder")
    options = Options(out=out, report=False, diagnosis=True)
    manifests: list[Manifest] = []
    notes: list[str] = []
    for name in names:
        with open_shown(name, options, quiet=quiet, tell=notes.append) as opened:
            manifests.append(opened.manifest)
    found = read_runs(manifests, vehicle, owner)
    for note in notes:
        say(note)
    return found


def judge_measured(file: ModelFile, target: str, names: Sequence[str], out: Path) -> ModelFile:
    """A model as `slip model fit --input measured` would write it, for a target that writes held-out errors.

    Args:
        file: the model; its own file stays.
        target: name of the target.
        names: paths of logs, or names of runs in the results folder.
        out: results folder.

    Raises:
        MotionError: the target writes none, or a run has no measured wheels; others as `gather_runs`.
    """
    from pipeline.export.exporter import require_errors  # noqa: PLC0415
    from pipeline.identification.comparison import Input  # noqa: PLC0415 - heavy
    from pipeline.identification.judgement import judge_model, note_fit  # noqa: PLC0415
    from pipeline.identification.problem import Problem  # noqa: PLC0415

    require_errors(target)
    vehicle, runs = gather_runs(names, file.model.vehicle, None, out, quiet=False)
    file = replace(file, model=replace(file.model, vehicle=vehicle))
    problem = Problem(runs, vehicle, Input.MEASURED)
    return note_fit(file, judge_model(problem, file.model, per_run=file.per_run))
