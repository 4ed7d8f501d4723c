"""Page of `slip compare`: published figure, and figure with intervals over runs."""

from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.core import INPUT_WORDS, format_duration, format_share
from pipeline.fleet import MEASURES
from pipeline.fleet.pairs import (
    DIFFERENT,
    OF_TWO_RUNS,
    TOO_FEW,
    Answer,
    compare_orders,
    count_pairs,
    judge_pair,
)
from pipeline.fleet.rank_tests import LEVEL, kendall_tau, list_swaps
from pipeline.report import (
    MISSING,
    Cell,
    Column,
    Picture,
    Table,
    format_distance,
    format_number,
    label_names,
    theme,
)
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.scene import format_ends
from pipeline.report.theme import Channel, Chart, encode_column, layer, make_axis

_ROW_HEIGHT = 34
_GUTTER = 210
_LABEL = 190
_LABEL_LIMIT = 280


def draw_boxes(boxes: pl.DataFrame, input_name: str, *, title: str) -> Drawing:
    """Box plot of the 2 s window norms of every dataset, sorted by the median: the published figure.

    Args:
        boxes: as from `spread_windows`, one input.
        input_name: input u; determines the colour.
        title: title of the axis, with its unit.
    """
    labels = label_names(boxes.sort("median")["group"].to_list())
    numbers = ("low", "q1", "median", "q3", "high", pl.col("windows").cast(pl.Float64))
    rows = boxes.select("group", _label(labels), *numbers)
    base = Chart.of_rows("boxes").encode(y=_names(labels))
    whiskers = base.mark("rule", color=theme.QUIET).encode(x=_axis("low", title), x2="high:Q")
    box = base.mark("bar", size=16, color=theme.INPUT_COLOURS[input_name], opacity=0.55).encode(
        x="q1:Q", x2="q3:Q"
    )
    middle = base.mark("tick", size=20, thickness=2.5, color=theme.MEASURED).encode(
        x="median:Q",
        tooltip=["group:N", encode_column("median:Q", format=".3"), "windows:Q"],
    )
    chart = _frame(layer(whiskers, box, middle), len(labels))
    note = (
        "All windows of a dataset in one box, as published: a long run counts more than a short one, and "
        "windows are correlated. The box shows the spread of slip, not the uncertainty of its median."
    )
    sentence = ", ".join(
        f"{name} {median:.3g}" for name, median in boxes.select("group", "median").iter_rows()
    )
    return Drawing(chart, {"boxes": rows}, note, f"Medians in m/s: {sentence}.")


def draw_runs(runs: pl.DataFrame, datasets: pl.DataFrame, *, value: str, title: str) -> Drawing:
    """Median of every run as a point, and the interval of the dataset: the statistically valid figure.

    Args:
        runs: ``group``, ``run`` and the column ``value``, one row per run.
        datasets: ``dataset``, ``value``, ``low``, ``high``, ``interval``.
        value: column with the medians.
        title: title of the axis, with its unit.
    """
    labels = label_names(datasets.sort("value")["dataset"].to_list())
    points = runs.filter(pl.col(value).is_not_null(), pl.col("group").is_in(list(labels)))
    points = points.select(_label(labels), "run", pl.col(value).alias("value"))
    highest = points["value"].max()
    end = 1.6 * float(highest) if isinstance(highest, float) else 1.0
    spans = datasets.select(
        _label(labels, of="dataset"),
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
            y=_names(labels),
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
        .encode(y=_names(labels), x="value:Q")
    )
    dots = (
        Chart.of_rows("run_medians")
        .mark("point", size=70, filled=True, fill=theme.SLIP, stroke=theme.PAPER, strokeWidth=1, opacity=1)
        .encode(
            y=_names(labels),
            x="value:Q",
            tooltip=["run:N", encode_column("value:Q", format=".3")],
        )
    )
    chart = _frame(layer(bars, dots, middles), len(labels))
    cut = datasets.filter(pl.col("high") > end).height
    note = "A point is a run; a tick the median over runs."
    if cut:
        note += (
            f" {cut} interval{'s are' if cut > 1 else ' is'} longer than the axis and cut: so few runs tell "
            "little of others."
        )
    sentence = ", ".join(
        f"{name} {value:.3g}" for name, value in datasets.select("dataset", "value").iter_rows()
    )
    return Drawing(chart, {"spans": spans, "run_medians": points}, note, f"In m/s: {sentence}.")


def _label(labels: Mapping[str, str], *, of: str = "group") -> pl.Expr:
    return pl.col(of).replace_strict(labels, return_dtype=pl.String).alias("label")


def _names(labels: Mapping[str, str]) -> Channel:
    axis = {
        "title": None, "labelLimit": _LABEL_LIMIT, "minExtent": _LABEL, "grid": False, "labelColor": theme.INK
    }  # fmt: skip
    order = list(labels.values())
    return encode_column("label:N", sort=order, axis=axis, scale={"domain": order})


def _axis(field: str, title: str, *, end: float | None = None) -> Channel:
    scale = {"zero": True, "nice": True} if end is None else {"domain": [0.0, end], "nice": True}
    return make_axis(field, title, scale=scale, tickCount=5)


def _frame(chart: Chart, rows: int) -> Chart:
    return chart.properties(width=640, height=_ROW_HEIGHT * max(rows, 1), usermeta={"gutter": _GUTTER})


_MOST_SWAPS = 4
_FEWEST = 2
_ABOUT_PAIRS = (
    "Whole runs are permuted where a side has several, blocks where each side is one run; p corrected over "
    "all pairs of the same unit"
)
_SHOWN = (
    "transitory_median_modulus", "steady_median_modulus", "median_window_norm", "published_norm",
    "drivetrain_mean_square", "ground_mean_square", "cross_mean_square", "height_rate",
    "largest_kinetic_energy",
)  # fmt: skip

_DATASETS = (
    Column("dataset"), Column("runs", number=True), Column("samples", number=True),
    Column("distance", number=True), Column("time compared", number=True),
    Column("median slip modulus", "m/s", number=True), Column("95 % interval", number=True),
    Column("transitory", number=True), Column("steady", number=True),
    Column("window norm", "m/s", number=True), Column("as published", number=True),
    Column("drivetrain", "m\u00b2/s\u00b2", number=True), Column("ground", number=True),
    Column("cross", number=True), Column("height rate", "m/s", number=True),
    Column("largest energy", "J", number=True),
)  # fmt: skip
_PAIRS = (
    Column("pair"), Column("shift b \u2212 a", "m/s", number=True), Column("95 % interval", number=True),
    Column("Cliff\u2019s delta"), Column("p corrected", number=True), Column("p of the pair", number=True),
    Column("smallest p", number=True), Column("verdict"), Column("unit"),
)  # fmt: skip


def render_comparison(answer: Answer, notes: Sequence[str]) -> str:
    """Render the complete page as HTML, with these of its notes."""
    shown = answer.datasets.filter(pl.col("input") == answer.input)
    facts = [
        f"{shown.height} datasets",
        f"{shown['runs'].sum()} runs",
        f"slip {INPUT_WORDS[answer.input]}",
        answer.measure,
    ]
    return render_figures(
        "report/templates/comparison.html",
        list_pictures(answer),
        title="Deployments compared",
        facts=facts,
        verdict=_format_verdict(answer.comparisons),
        datasets=_tabulate_datasets(shown, answer.input),
        pairs=_tabulate_pairs(answer.comparisons),
        difficulty=tabulate_difficulty(shown),
        swaps=list_contradictions(shown),
        measures=list(MEASURES.values()),
        orders=list(dict.fromkeys(one.text for one in compare_orders(shown))),
        notes=notes,
        counted=shown.select("dataset", "keys").to_dicts(),
    )


def list_pictures(answer: Answer) -> list[Picture]:
    """The published figure and the one with intervals over runs."""
    input_name = answer.input
    boxes = answer.windows.filter(pl.col("input") == input_name)
    own = answer.runs.filter(pl.col("input") == input_name)
    published = answer.quantity == "published_norm"
    pictures = []
    if not boxes.is_empty():
        words = "of the published chain" if published else INPUT_WORDS[input_name]
        drawing = draw_boxes(boxes, input_name, title=f"2 s window norm {words} [m/s]")
        pictures.append(Picture("window_norms_by_dataset", "The published figure", drawing))
    rated = answer.intervals.filter(pl.col("value").is_not_null()).sort("value")
    if not rated.is_empty():
        title = (
            "window norm of the published chain [m/s]"
            if published
            else f"{answer.measure} {INPUT_WORDS[input_name]} [m/s]"
        )
        drawing = draw_runs(own, rated, value=answer.quantity, title=title)
        pictures.append(Picture("run_medians_by_dataset", "Median over runs", drawing))
    return pictures


def _format_verdict(comparisons: pl.DataFrame) -> str:
    if comparisons.is_empty():
        return "No pair of datasets is tested."
    counts = count_pairs(comparisons.to_dicts())
    return f"{counts} Level {format_share(LEVEL)}, corrected for multiple comparisons."


def _tabulate_datasets(shown: pl.DataFrame, input_name: str) -> Table:
    rows: list[list[str | Cell]] = [
        [
            str(row["dataset"]),
            str(row["runs"]),
            f"{row['samples']:,}",
            format_distance(row["distance"]).replace(" ", "\u00a0"),
            MISSING if row["duration"] is None else format_duration(row["duration"]).replace(" ", "\u00a0"),
            format_number(row["median_modulus"]),
            Cell(_format_ends(row), small="this run" if row["interval"] == "this run only" else ""),
            *(format_number(row[name]) for name in _SHOWN),
        ]
        for row in shown.sort("median_modulus").iter_rows(named=True)
    ]
    caption = f"Medians over runs, slip {INPUT_WORDS[input_name]}; every run has the same weight"
    # Columns without any value, not computed or not in the logs, are omitted.
    columns = [
        i for i in range(len(_DATASETS)) if any(row[i] not in (MISSING, Cell(MISSING)) for row in rows)
    ]
    return Table(caption, [_DATASETS[i] for i in columns], [[row[i] for i in columns] for row in rows])


def _tabulate_pairs(comparisons: pl.DataFrame) -> Table | None:
    if comparisons.is_empty():
        return None
    rows = [
        [
            Cell(f"a {row['a']}", notes=[f"b {row['b']}", f"{row['runs_a']} + {row['runs_b']} runs"]),
            format_number(row["shift"]),
            _format_ends(row),
            f"{format_number(row['cliffs_delta'], digits=2)} {row['size']}",
            _format_p(row["p_adjusted"]),
            _format_p(row["p"]),
            _format_p(row["smallest_p"]),
            _format_pair(row),
            "runs" if row["unit_of_analysis"] == "runs" else "run\u00a0against\u00a0run",
        ]
        for row in comparisons.sort("p_adjusted", "p").iter_rows(named=True)
    ]
    return Table(_ABOUT_PAIRS, _PAIRS, rows)


def _format_pair(row: Mapping[str, object]) -> str | Cell:
    verdict = judge_pair(row)
    if verdict == DIFFERENT:
        return Cell("different", tag="b")
    if verdict == OF_TWO_RUNS:
        return "different as two single runs"
    return "too few runs for a test" if verdict == TOO_FEW else "no significant difference"


def _format_p(p: float) -> str:
    return f"{p:.4f}" if p >= 1e-4 else "< 0.0001"  # noqa: PLR2004 - as many digits as are shown


def _format_ends(row: Mapping[str, object]) -> str:
    return format_ends(row).replace(" ", "\u00a0") or MISSING


def tabulate_difficulty(shown: pl.DataFrame) -> Table:
    """Values and ranks of every measure, and their agreement with the modulus.

    Args:
        shown: table `datasets` of one input.
    """
    rated = _rate(shown)
    columns = [measure.column for measure in MEASURES.values()]
    ranks = {column: rated[column].rank("min") for column in columns}
    rows: list[list[str | Cell]] = [
        [
            str(row["dataset"]),
            *(
                Cell(
                    format_number(row[column]),
                    small=f"({int(ranks[column][i])})" if row[column] is not None else "",
                )
                for column in columns
            ),
        ]
        for i, row in enumerate(rated.iter_rows(named=True))
    ]
    both = {column: rated.drop_nulls(column) for column in columns}
    agreement = (
        MISSING
        if pair.height < _FEWEST
        else f"{kendall_tau(pair['median_modulus'].to_numpy(), pair[column].to_numpy()):.2f}"
        for column, pair in both.items()
    )
    rows.append([Cell("agreement with the slip modulus (Kendall)", tag="i"), *agreement])
    head = [Column("dataset"), *(Column(one.name, one.unit, number=True) for one in MEASURES.values())]
    return Table("Median over runs and, in brackets, the rank from easy to hard", head, rows)


def list_contradictions(shown: pl.DataFrame) -> list[str]:
    """Pairs of datasets that a measure and the modulus order differently, in words."""
    sentences = []
    for measure in MEASURES.values():
        both = _rate(shown).drop_nulls(measure.column)
        if both.height >= _FEWEST:
            swaps = list_swaps(both["median_modulus"].to_numpy(), both[measure.column].to_numpy())
            sentences += [
                f"{both['dataset'][i]} slips more than {both['dataset'][j]} by slip modulus, "
                f"but less by {measure.name}"
                for i, j in swaps[:_MOST_SWAPS]
            ]
    return sentences


def _rate(shown: pl.DataFrame) -> pl.DataFrame:
    return shown.drop_nulls("median_modulus").sort("median_modulus")


# Comparison of datasets on one offline page.
#
# The published figure (all windows of a dataset in one box), the statistically valid one beside it (runs as
# points, with an interval over runs), the pairs with their tests, and the measures of difficulty.
