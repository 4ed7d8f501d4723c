"""Drives that were planned for stored runs: where the report and the workbench show them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from pipeline.core.paths import PathError, resolve_inside
from pipeline.report.pages import PLANS, lead_to, lead_up
from pipeline.store import Manifest, Store
from pipeline.store.files import make_folder, replace_file
from pipeline.store.manifest import QUARANTINE
from pipeline.store.names import encode_run

if TYPE_CHECKING:
    from pipeline.plan.plan import Plan  # numerics that the workbench's pages do without

PREVIEW = "plan.json"


def place_plan(results: Path, run: str, name: str) -> Path:
    """Where a file of a run's plan is, or would be.

    Raises:
        PathError: a link leads out of the results.
    """
    return resolve_inside(results, f"{PLANS}/{encode_run(run)}/{name}")


class _Preview(msgspec.Struct):
    """What a report shows of a plan: the results that it was made for, and as of `preview_plan`."""

    key: str
    drives: bool
    area: str
    duration_s: float
    promises: list[str]


def read_preview(results: Path, run: str, key: str) -> dict[str, object]:
    """The plan of a run in short, with the ``address`` of its page seen from the report.

    Empty where there is none of these results, or none that can be read: others may have written it.

    Args:
        results: the results folder.
        run: name of the run.
        key: of its generation.
    """
    try:
        found = msgspec.json.decode(place_plan(results, run, PREVIEW).read_bytes(), type=_Preview)
    except (OSError, PathError, msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return {}
    address = lead_up(run, f"{PLANS}/{encode_run(run).as_posix()}/plan.html")
    return {**msgspec.structs.asdict(found), "address": address} if found.key == key else {}


def write_drive(plan: Plan, folder: Path, results: Path) -> tuple[Path, ...]:
    """Write a plan's files with its page, if there is anything to drive.

    Args:
        plan: the plan.
        folder: for its files.
        results: results folder, to whose catalogue the page leads.

    Raises:
        PlanError: as `write_plan`.
    """
    from pipeline.plan.files import write_plan  # noqa: PLC0415 - heavy
    from pipeline.report.plan import render_plan  # noqa: PLC0415 - heavy

    return write_plan(plan, folder, render_plan(plan, lead_to(results, folder))) if plan.manoeuvres else ()


def leave_plan(store: Store, manifest: Manifest, plan: Plan) -> Path | None:
    """Put a plan beside the run it was made for, and show it in the run's report.

    Args:
        store: the results.
        manifest: of the run.
        plan: the plan.

    Returns:
        The report; None where the run is not of these results, or has none.

    Raises:
        SlipError: the results cannot be written.
    """
    from pipeline.analysis.analyze import REPORT  # noqa: PLC0415 - it reads the preview
    from pipeline.plan.files import FILES  # noqa: PLC0415 - heavy
    from pipeline.report.plan import preview_plan, show_planned  # noqa: PLC0415 - heavy

    run, results = manifest.run, store.root
    if store.manifest(run) != manifest:
        return None
    preview = place_plan(results, run, PREVIEW)
    make_folder(preview.parent)
    written = {path.name for path in write_drive(plan, preview.parent, results)}
    for name in FILES:
        if name not in written:
            # What was planned before is not to be driven any more.
            (preview.parent / name).unlink(missing_ok=True)
    told = {"key": manifest.key, **preview_plan(plan)}
    replace_file(preview, json.dumps(told, allow_nan=False).encode())
    with store.open_generation(run, manifest.key) as generation:
        current = generation.previous
        if current is None or current.key != manifest.key or REPORT not in current.files:
            return None
        page = current.path(REPORT).read_text(encoding="utf-8")
        for table in current.tables:
            generation.reuse_table(table)
        new = {REPORT, *(f"{QUARANTINE}{table}.parquet" for table in current.tables)}
        for name in [name for name in current.files if name not in new]:
            generation.reuse_file(name)
        generation.write_text(REPORT, show_planned(page, read_preview(results, run, manifest.key)))
        return generation.commit(current.details).path(REPORT)
