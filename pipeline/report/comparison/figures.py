"""The published figure, and the honest one beside it."""

from collections.abc import Sequence

import polars as pl

from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import Drawing
from pipeline.report.vega import Channel, Chart, encode_column, layer

_ROW_HEIGHT = 34
_GUTTER = 210
_LABEL = 190


def draw_boxes(boxes: pl.DataFrame, input_name: str, *, title: str) -> Drawing:
    """Box plot of the 2 s window norms of every dataset, sorted by the median: the published figure.

    Args:
        boxes: as of `spread_windows`, one input.
        input_name: what u was; gives the colour.
        title: of the axis, with its unit.
    """
    order = boxes.sort("median")["group"].to_list()
    rows = boxes.select("group", "low", "q1", "median", "q3", "high", pl.col("windows").cast(pl.Float64))
    base = Chart.of_rows("boxes").encode(y=_names(order))
    whiskers = base.mark("rule", color=theme.QUIET).encode(x=_axis("low", title), x2="high:Q")
    box = base.mark("bar", size=16, color=theme.INPUT_COLOURS[input_name], opacity=0.55).encode(
        x="q1:Q", x2="q3:Q"
    )
    middle = base.mark("tick", size=20, thickness=2.5, color=theme.MEASURED).encode(
        x="median:Q",
        tooltip=["group:N", encode_column("median:Q", format=".3"), "windows:Q"],
    )
    chart = _frame(layer(whiskers, box, middle), len(order))
    note = (
        "All windows of a dataset in one box, as published: a long run counts more than a short one, and "
        "windows are correlated. The box says how slip is spread, not how sure its median is."
    )
    told = ", ".join(f"{name} {median:.3g}" for name, median in boxes.select("group", "median").iter_rows())
    return Drawing(chart, {"boxes": rows}, note, f"Medians in m/s: {told}.")


def draw_runs(runs: pl.DataFrame, datasets: pl.DataFrame, *, value: str, title: str) -> Drawing:
    """Every run's median as a point, and the interval of the dataset's: the honest figure.

    Args:
        runs: ``group``, ``run`` and the column ``value``, one row a run.
        datasets: ``dataset``, ``value``, ``low``, ``high``, ``interval``.
        value: column with the medians.
        title: of the axis, with its unit.
    """
    order = datasets.sort("value")["dataset"].to_list()
    points = runs.filter(pl.col(value).is_not_null()).select("group", "run", pl.col(value).alias("value"))
    highest = points["value"].max()
    end = 1.6 * float(highest) if isinstance(highest, float) else 1.0
    spans = datasets.select(
        pl.col("dataset").alias("group"),
        "value",
        pl.col("low").clip(0.0, end),
        pl.col("high").clip(0.0, end),
        pl.when(pl.col("interval") == "over runs")
        .then(pl.lit("95 % interval over runs"))
        .otherwise(pl.lit("of this run only"))
        .alias("kind"),
    )
    kinds = ["95 % interval over runs", "of this run only"]
    bars = (
        Chart.of_rows("spans")
        .mark("rule", strokeWidth=5, opacity=0.75)
        .encode(
            y=_names(order),
            x=_axis("low", title, end=end),
            x2="high:Q",
            color=encode_column(
                "kind:N",
                scale={"domain": kinds, "range": [theme.ON_COMMAND, theme.CROSS]},
                legend={"title": None, "symbolType": "stroke", "symbolSize": 220},
            ),
        )
    )
    middles = (
        Chart.of_rows("spans")
        .mark("tick", size=18, thickness=2.5, color=theme.MEASURED)
        .encode(y=_names(order), x="value:Q")
    )
    dots = (
        Chart.of_rows("run_medians")
        .mark("point", size=70, filled=True, fill=theme.SLIP, stroke=theme.PAPER, strokeWidth=1, opacity=1)
        .encode(
            y=_names(order),
            x="value:Q",
            tooltip=["run:N", encode_column("value:Q", format=".3")],
        )
    )
    chart = _frame(layer(bars, dots, middles), len(order))
    cut = datasets.filter(pl.col("high") > end).height
    note = "A point is a run; a tick the median over runs."
    if cut:
        note += f" Intervals that end beyond the axis: {cut}; too few runs to say more."
    told = ", ".join(f"{name} {value:.3g}" for name, value in datasets.select("dataset", "value").iter_rows())
    return Drawing(chart, {"spans": spans, "run_medians": points}, note, f"In m/s: {told}.")


def _names(order: Sequence[str]) -> Channel:
    axis = {"title": None, "labelLimit": _LABEL, "minExtent": _LABEL, "grid": False, "labelColor": theme.INK}
    return encode_column("group:N", sort=list(order), axis=axis, scale={"domain": list(order)})


def _axis(field: str, title: str, *, end: float | None = None) -> Channel:
    scale = {"zero": True, "nice": True} if end is None else {"domain": [0.0, end], "nice": True}
    return make_axis(field, title, scale=scale, tickCount=7)


def _frame(chart: Chart, rows: int) -> Chart:
    return chart.properties(width=640, height=_ROW_HEIGHT * max(rows, 1), usermeta={"gutter": _GUTTER})
