"""What to do next: what the findings ask for, and commands to copy."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.report.run import RunReport
    from pipeline.report.sections import Page


def view_what_now(page: Page) -> dict[str, object]:
    """Commands that go on from this run, and whether anything is open that a drive could decide."""
    if not page.report.text("run"):
        return {"steps": [], "settled": False, "planned": {}}
    diagnosis = page.report.diagnosis
    settled = bool(diagnosis.get("effects")) and not any(
        diagnosis.get(key) for key in ("undecided", "unobservable", "unexplained")
    )
    return {"steps": list_steps(page.report), "settled": settled, "planned": page.report.planned}


def list_steps(report: RunReport) -> list[tuple[str, str]]:
    """What to do, and the command that does it; the most useful first."""
    if report.is_refused:
        return _list_mending_steps(report)
    run = report.text("run")
    # A run that starts with a dash would be read as an option.
    name = shlex.quote(run) if not run.startswith("-") else shlex.quote(f"./{run}")
    return [
        *_list_model_steps(report, name),
        ("Set it beside other vehicles and terrains", "slip compare"),
        ("Look at slip in the viewer that plays the log", f"slip export {name} --to mcap"),
    ]


def _list_mending_steps(report: RunReport) -> list[tuple[str, str]]:
    """Of a run whose numbers mean nothing as it is: look at the log, mend, analyze again."""
    log = shlex.quote(str(report.part("log").get("path") or "run.mcap"))
    return [
        ("Look at what the log holds", f"slip inspect {log}"),
        ("Mend what the findings name, then analyze again", f"slip analyze {log}"),
    ]


def _list_model_steps(report: RunReport, name: str) -> list[tuple[str, str]]:
    diagnosis = report.diagnosis
    if not diagnosis:
        return [("Name the effects that are missing from the model", f"slip diagnose {name}")]
    steps = []
    if diagnosis.get("effects"):
        steps.append(("Keep the model that was named", f"slip diagnose {name} --apply model.toml"))
        steps.append(("Give it to the robot's controller", "slip model export model.toml --to ros2_control"))
    if diagnosis.get("undecided") or diagnosis.get("unobservable"):
        what = "is undecided" if diagnosis.get("undecided") else "this log cannot tell"
        steps += [
            (f"Plan the drive that decides what {what}", f"slip plan {name} --out plan"),
            ("Look at plan/plan.html, lift the wheels, and play it", "ros2 bag play plan/plan.mcap"),
            ("See whether it kept what it promised", "slip plan --check plan NEW.mcap"),
        ]
    return [*steps, ("Try other effects, and plan the next drive, in the browser", "slip serve")]
