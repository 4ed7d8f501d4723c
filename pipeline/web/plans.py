"""Drives that were planned for a stored run: their files and their previews, beside the results."""

from pathlib import Path

from pipeline.analysis.diagnosis import read_recording
from pipeline.analysis.planned import PREVIEW, leave_plan, place_plan, read_preview
from pipeline.store import Manifest, Store
from pipeline.web.errors import WorkbenchError

KINDS = {
    "plan.html": "text/html",
    PREVIEW: "application/json",
    "plan.toml": "application/toml",
    "plan.csv": "text/csv",
    "plan.mcap": "application/octet-stream",
}
"""Files of a plan, with their media types."""
_TIME = "60s"


def write_run_plan(store: Store, manifest: Manifest, area: str) -> None:
    """Plan the drive that decides what a stored run could not; it works for many seconds.

    Args:
        store: the results.
        manifest: of the run.
        area: free ground, as `20x10m`.

    Raises:
        SlipError: nothing can be said of the run, or no drive fits into the area.
    """
    from pipeline.analysis.plan import Wish, plan_drive, read_command, study  # noqa: PLC0415 - heavy
    from pipeline.plan.limits import parse_area, parse_time  # noqa: PLC0415

    vehicle, recording = read_recording(manifest)
    wish = Wish(parse_area(area, vehicle), parse_time(_TIME))
    studied = study([recording], vehicle)
    planned = plan_drive(vehicle, studied, wish, [recording], read_command(manifest))
    leave_plan(store, manifest, planned.plan)


def find_plan(results: Path, manifest: Manifest) -> str | None:
    """What tells the run's present plan from one before; None where there is none of these results."""
    if not read_preview(results, manifest.run, manifest.key):
        return None
    return str(find_file(results, manifest.run, PREVIEW).stat().st_mtime_ns)


def find_file(results: Path, run: str, name: str) -> Path:
    """Where a file of a run's plan is, or would be.

    Raises:
        WorkbenchError: ``no_plan``: a plan has no such file.
        PathError: a link leads out of the results.
    """
    if name not in KINDS:
        raise WorkbenchError("no_plan", "a plan has no such file", where=run, hint="Open the run again.")
    return place_plan(results, run, name)
