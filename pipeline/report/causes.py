"""The page of `slip compare --causes`."""

import math
from collections.abc import Callable, Mapping, Sequence

import polars as pl

from pipeline.fleet.causes import Budget, Causes, Difference
from pipeline.report import theme
from pipeline.report.elements import Column, Picture, Table
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.run import INPUT_WORDS
from pipeline.report.vega import Chart, encode_column
from pipeline.report.words import MISSING, say_number, say_share

_COLOURS = (
    theme.MODEL, theme.ON_COMMAND, theme.ON_MEASURED, theme.SLIP, theme.DRIVETRAIN, theme.MARK,
    theme.MEASURED,
)  # fmt: skip
_LEFT = {"disturbance": theme.GROUND, "localization_noise": theme.CROSS}
_OTHERS = "other effects"


def render_causes(causes: Causes, sentences: Sequence[str]) -> str:
    """The whole page as HTML; sentences: the differences in words."""
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
        sentences_told=sentences,
        budgets=_tabulate_budgets(budgets, names),
        differences=_tabulate_differences(causes.differences, names),
        notes=causes.notes,
        runs=keys,
    )


def draw_causes(budgets: Sequence[Budget], names: Mapping[str, str]) -> Picture:
    """A bar a dataset as long as its rms slip, cut into its causes; the largest effects have a colour."""
    size: dict[str, float] = {}
    for budget in budgets:
        for part in budget.parts:
            if part.kind == "effect":
                size[part.name] = size.get(part.name, 0.0) + abs(part.share) * budget.total
    shown = sorted(size, key=lambda name: -size[name])[: len(_COLOURS)]
    rows = []
    for budget in budgets:
        rms = math.sqrt(budget.total)
        for part in budget.parts:
            known = part.kind != "effect" or part.name in shown
            cause = names.get(part.name, part.name) if known else _OTHERS
            rows.append(
                (budget.dataset, cause.replace("_noise", " noise"), rms * part.share, say_share(part.share))
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
                sort=[budget.dataset for budget in budgets],
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
    told = "; ".join(f"{one.dataset} {say_number(math.sqrt(one.total))} m/s" for one in budgets)
    note = "Cut by shares of the mean square. What makes held-out slip larger stands left of zero."
    return Picture("causes", "Slip by cause", Drawing(chart, {"causes": frame}, note, f"Rms slip: {told}."))


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
            say_share(part.share),
            _say_ends(part.low, part.high),
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
        (f"{one.b} \u2212 {one.a}", names.get(part.name, part.name), say_number(part.difference),
         _say_ends(part.low, part.high, say_number), say_number(part.p_adjusted), one.unit)
        for one in differences
        for part in one.parts
    ]  # fmt: skip
    return Table("Differences of rms slip by cause; p after Holm over the causes of a pair", columns, rows)


def _say_ends(low: float, high: float, say: Callable[[float], str] = say_share) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return MISSING
    return f"{say(low)} to {say(high)}"
