"""Runs for the model verbs: stored runs are read, logs without results are analyzed first."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.analysis.geometry import Owner
    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle


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
    from pipeline.analysis.geometry import agree_on_vehicle  # noqa: PLC0415 - heavy
    from pipeline.analysis.options import Options  # noqa: PLC0415
    from pipeline.analysis.stored import open_run  # noqa: PLC0415 - heavy
    from pipeline.cli.output import say, show_progress  # noqa: PLC0415
    from pipeline.report.motion_run import load_motion_run, load_vehicle  # noqa: PLC0415 - heavy

    options = Options(out=out, report=False, diagnosis=True)
    manifests, notes = [], []
    for name in names:
        with (
            show_progress(Path(name).name, quiet=quiet) as progress,
            open_run(name, options, progress) as opened,
        ):
            manifests.append(opened.manifest)
        notes += [opened.note] if opened.note and not quiet else []
    known = {found.run: load_vehicle(found) for found in manifests}
    chosen = agree_on_vehicle(vehicle or next(iter(known.values())), known, owner)
    for note in notes:
        say(f"slip: {note}")
    return chosen, [load_motion_run(manifest, chosen) for manifest in manifests]
