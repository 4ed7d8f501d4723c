"""Runs for the model verbs: logs are taken through the stages first, stored runs are read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.motion.errors import MotionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.motion.recording import MotionRun
    from pipeline.store import Manifest
    from pipeline.vehicles import Vehicle


def gather_runs(names: Sequence[str], vehicle: Vehicle, out: Path, *, quiet: bool) -> list[MotionRun]:
    """Runs by name of a log or of a stored run.

    Args:
        names: paths of logs, or names of runs in the results folder.
        vehicle: of the model; a log is analyzed with it.
        out: results folder.
        quiet: tell nothing on stderr.

    Raises:
        SlipError: a log cannot be read, or there is no such run.
    """
    from pipeline.report.motion_run import load_motion_run  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    store = Store(out)
    runs = []
    for name in names:
        manifest = store.manifest(name) if not Path(name).exists() else None
        if manifest is None:
            manifest = _analyze(name, vehicle, out, quiet=quiet)
        runs.append(load_motion_run(manifest, vehicle))
    return runs


def _analyze(name: str, vehicle: Vehicle, out: Path, *, quiet: bool) -> Manifest:
    from pipeline.cli.output import show_progress  # noqa: PLC0415
    from pipeline.job.analyze import analyze_log  # noqa: PLC0415 - heavy
    from pipeline.job.options import Options  # noqa: PLC0415

    path = Path(name)
    if not path.exists():
        raise MotionError(
            "no_such_run",
            "there is neither a log nor a stored run of that name",
            where=name,
            hint=f"Give a path, or one of the runs that `slip status` lists for {out}.",
        )
    said: dict[str, object] = {
        key: value
        for key in ("wheel_radius_m", "track_width_m", "wheelbase_m", "controller_track_multiplier", "kind")
        if (value := getattr(vehicle, key)) is not None
    }
    options = Options(out=out, report=False, overrides={"vehicle": {**said, "name": vehicle.name}})
    with show_progress(path.name, quiet=quiet) as progress:
        return analyze_log(path, options, progress).manifest
