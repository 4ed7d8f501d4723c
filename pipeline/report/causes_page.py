"""Page of `slip compare --causes`: datasets side by side as budgets by cause, and what they differ by."""

import math
from collections.abc import Callable, Mapping, Sequence

import polars as pl

from pipeline.core import INPUT_WORDS
from pipeline.fleet.causes import Budget, Causes, Difference
from pipeline.report import (
    MISSING,
    Column,
    Picture,
    Table,
    format_known_share,
    format_number,
    label_names,
    theme,
)
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.theme import Chart, encode_column

_COLOURS = (
    theme.MODEL, theme.ON_COMMAND, theme.ON_MEASURED, theme.SLIP, theme.DRIVETRAIN, theme.MARK,
    theme.MEASURED,
)  # fmt: skip
_LEFT = {"disturbance": theme.GROUND, "localization_noise": theme.CROSS}
_OTHERS = "other effects"


def render_causes(causes: Causes, sentences: Sequence[str]) -> str:
    """Render the complete page as HTML; sentences: the differences in words."""
    budgets, names, keys = causes.budgets, causes.names, causes.keys
    return render_figures(
        "report/templates/causes.html",
        [draw_causes(budgets, names)],
        title="Deployments compared by cause",
        facts=[
            f"{len(budgets)} dataset{'s' * (len(budgets) != 1)}",
            f"{len(keys)} run{'s' * (len(keys) != 1)}",
            f"slip {INPUT_WORDS[causes.input]}",
        ],
        sentence_list=sentences,
        budgets=_tabulate_budgets(budgets, names),
        differences=_tabulate_differences(causes.differences, names),
        notes=causes.notes,
        runs=keys,
    )


def draw_causes(budgets: Sequence[Budget], names: Mapping[str, str]) -> Picture:
    """Draw a bar per dataset with the length of its RMS slip, split into causes; the largest are coloured."""
    size: dict[str, float] = {}
    for budget in budgets:
        for part in budget.parts:
            if part.kind == "effect":
                size[part.name] = size.get(part.name, 0.0) + abs(part.share) * budget.total
    shown = sorted(size, key=lambda name: -size[name])[: len(_COLOURS)]
    rows = []
    labels = label_names([budget.dataset for budget in budgets])
    for budget in budgets:
        rms = math.sqrt(budget.total)
        for part in budget.parts:
            known = part.kind != "effect" or part.name in shown
            cause = names.get(part.name, part.name) if known else _OTHERS
            rows.append(
                (
                    labels[budget.dataset],
                    cause.replace("_noise", " noise"),
                    rms * part.share,
                    format_known_share(part.share),
                )
            )
    kinds = {"dataset": pl.String, "cause": pl.String, "slip": pl.Float64, "told": pl.String}
    order = [*(names.get(name, name) for name in shown), _OTHERS, "disturbance", "localization noise"]
    colours = [*_COLOURS[: len(shown)], theme.INK, *_LEFT.values()]
    chart = (
        Chart.of_rows("causes")
        .mark("bar")
        .encode(
            y=encode_column(
                "dataset:N",
                sort=list(labels.values()),
                axis={"title": None, "grid": False},
            ),
            x=encode_column(
                "sum(slip):Q", axis={"title": "rms slip over half a second [m/s]", "format": ",~r"}
            ),
            color=encode_column(
                "cause:N",
                scale={"domain": order, "range": colours},
                legend={"title": None, "columns": 3},
            ),
            tooltip=["dataset:N", "cause:N", encode_column("told:N", title="share")],
        )
        .properties(width=640, height={"step": 30}, usermeta={"gutter": 150})
    )
    frame = pl.DataFrame(rows, schema=kinds, orient="row")
    sentence = "; ".join(f"{one.dataset} {format_number(math.sqrt(one.total))} m/s" for one in budgets)
    note = "Cut by shares of the mean square. What makes held-out slip larger stands left of zero."
    return Picture(
        "causes",
        "Rms slip of each dataset by cause",
        Drawing(chart, {"causes": frame}, note, f"Rms slip: {sentence}."),
    )


def _tabulate_budgets(budgets: Sequence[Budget], names: Mapping[str, str]) -> Table:
    columns = (
        Column("dataset"), Column("runs", number=True), Column("cause"), Column("share", number=True),
        Column("95 % interval", number=True),
    )  # fmt: skip
    rows = [
        (
            one.dataset,
            str(one.runs),
            names.get(part.name, part.name),
            format_known_share(part.share),
            _format_cause_ends(part.low, part.high),
        )
        for one in budgets
        for part in one.parts
    ]
    return Table("Budgets: shares of the mean square slip, means over runs", columns, rows)


def _tabulate_differences(differences: Sequence[Difference], names: Mapping[str, str]) -> Table:
    columns = (
        Column("difference"), Column("cause"), Column("more slip", "m/s", number=True),
        Column("95 % interval", number=True), Column("p corrected", number=True), Column("unit"),
    )  # fmt: skip
    rows = [
        (f"{one.b} \u2212 {one.a}", names.get(part.name, part.name), format_number(part.difference),
         _format_cause_ends(part.low, part.high, format_number), format_number(part.p_adjusted), one.unit)
        for one in differences
        for part in one.parts
    ]  # fmt: skip
    return Table("Differences of rms slip by cause; p after Holm over the causes of a pair", columns, rows)


def _format_cause_ends(
    low: float, high: float, format_end: Callable[[float], str] = format_known_share
) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return MISSING
    return f"{format_end(low)} to {format_end(high)}"
