"""Page of a drive: the plan of `slip plan`."""

import re
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import polars as pl

from pipeline.core import PathError, read_bounded_text, resolve_inside
from pipeline.plan import FILES, SAFETY, Plan, tabulate_questions, write_plan
from pipeline.report import PLANS, Picture, lead_to, lead_up, list_ways, render_template, set_squares, theme
from pipeline.report.pages import Page, Section
from pipeline.report.theme import (
    Chart,
    Drawing,
    encode_column,
    layer,
    stack,
)
from pipeline.store import (
    REPORT,
    Manifest,
    Store,
    StoreError,
    encode_run,
    make_folder,
    read_stored,
    replace_file,
)

# Subsampling of poses, and the largest number of predicted paths.
_EVERY = 4
_MOST_WAYS = 24
_WIDTH = 640
# Extent of the drawn part of the area, relative to that of the drive, and its minimum.
_ROOM = 1.2
_LEAST = 0.1
_PLACE = re.compile(r'<div id="planned">.*?</div>', re.DOTALL)


def show_planned(page: str, planned: Mapping[str, object]) -> str:
    """Return the report of a run with its planned drive inserted.

    Args:
        page: the report.
        planned: preview of the plan, with the relative ``address`` of its page; may be empty.
    """
    shown = render_template("report/templates/sections/planned.html", planned=planned)
    return _PLACE.sub(lambda _: shown, page, count=1)


def render_plan(plan: Plan, catalogue: str = "") -> str:
    """Render the complete page as HTML; it makes no network request.

    Args:
        plan: what to drive.
        catalogue: relative address of the page over all runs; empty without one.
    """
    area = plan.area
    half = "±: half-width of the 95 % interval, so far and as expected of the logs and this drive together."
    has_intervals = any(one.kind == "interval" for one in plan.informative)
    return Page(
        "What to drive next",
        [
            plan.vehicle,
            f"{plan.commands.duration_s:.0f} s",
            f"{area.length_m:g} x {area.width_m:g} m",
            f"at most {set_squares(plan.limits.format(steered=plan.steered))}",
        ],
        [
            Section(
                "safety",
                "Before you play it",
                warnings=SAFETY,
                lines=[f"Play it with `ros2 bag play plan.mcap`: {plan.type_name} on {plan.topic}"],
            ),
            Section(
                "promises",
                "What it tells",
                tables=[tabulate_questions(plan.list_rows(), note=half if has_intervals else "")],
            ),
            Section(
                "drive",
                "The drive",
                pictures=[_draw_ways(plan), _draw_commands(plan)],
                items=[f"{start:.0f} s: {name}" for name, start in plan.manoeuvres],
            ),
        ],
        ways=list_ways(catalogue),
    ).render()


def _draw_ways(plan: Plan) -> Picture:
    """Draw the expected path, those of other models, and the area."""
    ways = plan.ways[:: max(len(plan.ways) // _MOST_WAYS, 1), ::_EVERY]
    rows = pl.concat(
        pl.DataFrame(
            {
                "x": path.real,
                "y": path.imag,
                "model": np.full(path.size, number),
                "order": np.arange(path.size),
            }
        )
        for number, path in enumerate(ways)
    )
    half_x, half_y = 0.5 * plan.area.length_m, 0.5 * plan.area.width_m
    # A drive that uses only a small part of the area is enlarged.
    share = _ROOM * max(float(np.abs(ways.real).max()) / half_x, float(np.abs(ways.imag).max()) / half_y)
    share = min(max(share, _LEAST), 1.0)
    seen_x, seen_y = share * half_x, share * half_y
    edge = pl.DataFrame(
        {
            "x": [-half_x, half_x, half_x, -half_x, -half_x],
            "y": [-half_y, -half_y, half_y, half_y, -half_y],
            "order": [0, 1, 2, 3, 4],
        }
    )
    wide, tall = ({"domain": [-seen, seen], "nice": False} for seen in (seen_x, seen_y))
    along = encode_column("x:Q", title="ahead of the start [m]", scale=wide)
    aside = encode_column("y:Q", title="to the left [m]", scale=tall)

    def line(name: str, colour: str, opacity: float, *detail: str) -> Chart:
        chart = Chart.of_rows(name).mark("line", color=colour, opacity=opacity, strokeWidth=1.5, clip=True)
        drawn: Chart = chart.encode(x=along, y=aside, order="order:Q", detail=list(detail))
        return drawn

    chart = layer(
        line("plan_area", theme.QUIET, 1.0),
        line("plan_ways", theme.CROSS, 0.4, "model:N"),
        line("plan_way", theme.ON_COMMAND, 1.0),
    ).properties(
        width=_WIDTH,
        height=round(_WIDTH * seen_y / seen_x),
        usermeta={"equal": {"x": [-seen_x, seen_x], "y": [-seen_y, seen_y], "lowest": 80, "highest": 640}},
    )
    tables = {"plan_area": edge, "plan_ways": rows, "plan_way": rows.filter(pl.col("model") == 0)}
    words = (
        f"From the middle of an area of {plan.area.length_m:g} x {plan.area.width_m:g} m and back to within "
        f"{plan.home_m:.1f} m: in blue by the model that explains the logs so far, in grey by others that "
        "they do not rule out."
    )
    return Picture("ways", "Path", Drawing(chart, tables, words, words))


def _draw_commands(plan: Plan) -> Picture:
    """Draw commanded speed and turn over time."""
    turn = "steering [rad]" if plan.steered else "yaw rate [rad/s]"
    rows = pl.DataFrame({"t": plan.commands.times, "speed": plan.commands.speed, "turn": plan.commands.turn})
    panels = [
        Chart.of_rows("plan_commands")
        .mark("line", color=theme.ON_COMMAND, strokeWidth=1.5)
        .encode(x=encode_column("t:Q", title="time [s]"), y=encode_column(f"{name}:Q", title=title))
        .properties(width=_WIDTH, height=110)
        for name, title in (("speed", "speed [m/s]"), ("turn", turn))
    ]
    words = f"Speed and {turn.partition(' [')[0]} of the commands over {plan.commands.duration_s:.0f} s."
    drawing = Drawing(stack(*panels), {"plan_commands": rows}, words=words)
    return Picture("commands", "Commands", drawing)


PREVIEW = "plan.json"
_MOST_GAINS = 6


def locate_plan(results: Path, run: str, name: str) -> Path:
    """Path of a file of a run's plan; it need not exist.

    Raises:
        PathError: a link leads out of the results.
    """
    return resolve_inside(results, f"{PLANS}/{encode_run(run)}/{name}")


class _Preview(msgspec.Struct):
    """Summary of a plan for a report, with the key of the results that it was made for."""

    key: str
    drives: bool
    area: str
    duration_s: float
    gains: list[tuple[str, str, str]]


def read_preview(results: Path, run: str, key: str) -> dict[str, object]:
    """Summary of a run's plan, with the ``address`` of its page relative to the report.

    Empty if there is no plan for these results, or if it is unreadable: the file is untrusted.

    Args:
        results: the results folder.
        run: name of the run.
        key: key of its generation.
    """
    try:
        preview = read_stored(locate_plan(results, run, PREVIEW), _Preview)
    except (StoreError, PathError):
        return {}
    address = lead_up(run, f"{PLANS}/{encode_run(run).as_posix()}/plan.html")
    # Of a drive the first questions are what it is for; of none, all are open.
    table = tabulate_questions(preview.gains[:_MOST_GAINS] if preview.drives else preview.gains)
    shown = {**msgspec.structs.asdict(preview), "address": address, "table": table}
    return shown if preview.key == key else {}


def write_drive(plan: Plan, folder: Path, results: Path) -> tuple[Path, ...]:
    """Write a plan's files and its page, if it has any manoeuvre.

    Args:
        plan: the plan.
        folder: folder for its files.
        results: results folder; the page links to its catalogue.

    Raises:
        PlanError: as `write_plan`.
    """
    return write_plan(plan, folder, render_plan(plan, lead_to(results, folder))) if plan.manoeuvres else ()


def leave_plan(store: Store, manifest: Manifest, plan: Plan) -> Path | None:
    """Store a plan with the run it was made for, and show it in the run's report.

    Args:
        store: the results.
        manifest: manifest of the run.
        plan: the plan.

    Returns:
        Path of the report; None if the run is not of these results, or has no report.

    Raises:
        SlipError: the results cannot be written.
    """
    run, results = manifest.run, store.root
    known = store.manifest(run)
    if known is None or known.key != manifest.key:
        return None
    preview = locate_plan(results, run, PREVIEW)
    make_folder(preview.parent)
    written = {path.name for path in write_drive(plan, preview.parent, results)}
    for name in FILES:
        if name not in written:
            # Files of an earlier plan are obsolete.
            (preview.parent / name).unlink(missing_ok=True)
    area = f"{plan.area.length_m:g} x {plan.area.width_m:g} m"
    summary = _Preview(manifest.key, bool(plan.manoeuvres), area, plan.commands.duration_s, plan.list_rows())
    replace_file(preview, msgspec.json.encode(summary))
    with store.open_generation(run, manifest.key) as generation:
        current = generation.previous
        if current is None or current.key != manifest.key or REPORT not in current.files:
            return None
        page = read_bounded_text(current.path(REPORT))
        generation.reuse_all(REPORT)
        generation.write_text(REPORT, show_planned(page, read_preview(results, run, manifest.key)))
        return generation.commit(current.details).path(REPORT)
