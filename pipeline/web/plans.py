"""Drives that were planned here for a stored run: their files and their previews, beside the results."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pipeline.analysis.diagnosis import read_recording
from pipeline.core.paths import resolve_inside
from pipeline.store.files import make_folder, replace_file
from pipeline.store.names import encode_run
from pipeline.web.errors import WorkbenchError
from pipeline.web.runs import read_json
from pipeline.web.session import FOLDER

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.store import Manifest

PREVIEW = "plan.json"
KINDS = {
    "plan.html": "text/html",
    PREVIEW: "application/json",
    "plan.toml": "application/toml",
    "plan.csv": "text/csv",
    "plan.mcap": "application/octet-stream",
}
"""Files of a plan, with their media types."""
_TIME = "60s"


def write_run_plan(results: Path, manifest: Manifest, area: str) -> None:
    """Plan the drive that decides what a stored run could not; it works for many seconds.

    Args:
        results: the results folder.
        manifest: of the run.
        area: free ground, as `20x10m`.

    Raises:
        SlipError: nothing can be said of the run, or no drive fits into the area.
    """
    from pipeline.analysis import plan as asked  # noqa: PLC0415 - heavy, and only for the worker process
    from pipeline.plan import Request, choose_limits, make_plan, parse_area, write_plan  # noqa: PLC0415
    from pipeline.plan.limits import parse_time  # noqa: PLC0415
    from pipeline.report.pages import lead_to  # noqa: PLC0415
    from pipeline.report.plan import preview_plan, render_plan  # noqa: PLC0415

    vehicle, recording = read_recording(manifest)
    place, seconds = parse_area(area, vehicle), parse_time(_TIME)
    studied = asked.study([recording], vehicle)
    knowledge, diagnosis = studied.knowledge, studied.diagnosis
    limits = choose_limits(vehicle, None if knowledge.problem is None else knowledge.problem.largest)
    wanted = asked.UNDECIDED if diagnosis.undecided else asked.ALL
    questions = asked.ask(knowledge, [wanted], limits, seconds, diagnosis)
    topic, type_name = asked.choose_topic(vehicle, asked.read_command(manifest), recording.path)
    request = Request(limits, place, seconds, (manifest.run,), topic, type_name)
    plan = make_plan(knowledge, questions, request)
    preview = find_file(results, manifest.run, PREVIEW)
    make_folder(preview.parent)
    if plan.manoeuvres:
        write_plan(plan, preview.parent, render_plan(plan, lead_to(results, preview.parent)))
    drives = {"drives": bool(plan.manoeuvres), "area": area, "duration_s": plan.commands.duration_s}
    told = {"key": manifest.key, **drives, **preview_plan(plan)}
    replace_file(preview, json.dumps(told, allow_nan=False).encode())


def find_plan(results: Path, manifest: Manifest) -> str | None:
    """What tells the run's present plan from one before; None where there is none of these results."""
    path = find_file(results, manifest.run, PREVIEW)
    return str(path.stat().st_mtime_ns) if read_json(path).get("key") == manifest.key else None


def find_file(results: Path, run: str, name: str) -> Path:
    """Where a file of a run's plan is, or would be.

    Raises:
        WorkbenchError: ``no_plan``: a plan has no such file.
        PathError: a link leads out of the results.
    """
    if name not in KINDS:
        raise WorkbenchError("no_plan", "a plan has no such file", where=run, hint="Open the run again.")
    return resolve_inside(results, f"{FOLDER}/plans/{encode_run(run)}/{name}")
