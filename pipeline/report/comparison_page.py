"""Page of `slip compare`: the answer, its figures, the pairs, the published figure."""

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from pipeline.core import INPUT_WORDS, FigureFormat, format_csv, format_duration, group_by, number_in
from pipeline.datasets import (
    ABOUT_BLOCKS,
    ABOUT_UNIT,
    AS_DRIVEN,
    AS_PUBLISHED,
    DIFFERENT,
    EQUAL_DRIVING,
    LEAST_SAMPLES,
    MEASURES,
    OF_TWO_RUNS,
    SPEED_EDGES,
    THIS_RUN,
    TURN_EDGES,
    Answer,
    View,
    compare_orders,
    judge_pair,
    kendall_tau,
    list_swaps,
)
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
    write_page,
)
from pipeline.report.page import add_figures, render_figures
from pipeline.report.theme import Channel, Chart, Drawing, encode_column, layer, make_axis, stack
from pipeline.store import Store
from pipeline.words import PairLine, list_pairs, list_shown_notes, title_line
from pipeline.words.comparison import list_lines

_ROW_HEIGHT = 34
_GUTTER = 210
_LABEL = 190
_LABEL_LIMIT = 280


Families = Mapping[str, Sequence[str]]
"""Datasets that are compared with each other, by their vehicles."""


def _label_datasets(names: Sequence[str], families: Families) -> dict[str, str]:
    """Labels of datasets in their order, vehicle by vehicle; of several vehicles each has its own in it."""
    vehicles = {name: vehicle for vehicle, datasets in families.items() for name in datasets}
    labels = label_names(names)
    if len({vehicles.get(name) for name in names}) < 2:  # noqa: PLR2004 - several
        return labels
    order = {vehicle: number for number, vehicle in enumerate(families)}
    return {
        name: labels[name]
        if not (vehicle := vehicles.get(name)) or name.startswith(vehicle)
        else f"{labels[name]} ({vehicle})"
        for name in sorted(names, key=lambda name: order.get(vehicles.get(name, ""), len(order)))
    }


def draw_boxes(boxes: pl.DataFrame, input_name: str, families: Families, *, title: str) -> Drawing:
    """Box plot of the 2 s window norms of every dataset, sorted by the median: the published figure.

    Args:
        boxes: as from `spread_windows`, one input.
        input_name: input u; determines the colour.
        families: as in `Answer`.
        title: title of the axis, with its unit.
    """
    labels = _label_datasets(boxes.sort("median")["group"].to_list(), families)
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


def draw_levels(
    runs: pl.DataFrame, levels: pl.DataFrame, families: Families, *, name: str, title: str
) -> Drawing:
    """Value of every run as a point, and of its dataset with an interval over runs.

    Args:
        runs: ``group``, ``run`` and ``value``, one row per run.
        levels: as in `View`.
        families: as in `Answer`.
        name: name of the rows, unlike that of other drawings of the page.
        title: title of the axis, with its unit.
    """
    labels = _label_datasets(levels.sort("value", "dataset")["dataset"].to_list(), families)
    points = runs.filter(pl.col("value").is_not_null(), pl.col("group").is_in(list(labels)))
    points = points.select(_label(labels), "run", "value")
    highest = points["value"].max()
    end = 1.6 * float(highest) if isinstance(highest, float) else 1.0
    kinds = ["95 % interval over runs", "of this run only"]
    spans = levels.select(
        _label(labels, of="dataset"),
        "value",
        pl.col("low").clip(0.0, end),
        pl.col("high").clip(0.0, end),
        pl.when(pl.col("interval") == THIS_RUN)
        .then(pl.lit(kinds[1]))
        .otherwise(pl.lit(kinds[0]))
        .alias("kind"),
    )
    bars = (
        Chart.of_rows(f"{name}_spans")
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
        Chart.of_rows(f"{name}_spans")
        .mark("tick", size=18, thickness=2.5, color=theme.MEASURED)
        .encode(y=_names(labels), x="value:Q")
    )
    dots = (
        Chart.of_rows(f"{name}_runs")
        .mark("point", size=70, filled=True, fill=theme.SLIP, stroke=theme.PAPER, strokeWidth=1, opacity=1)
        .encode(
            y=_names(labels),
            x="value:Q",
            tooltip=["run:N", encode_column("value:Q", format=".3")],
        )
    )
    chart = _frame(layer(bars, dots, middles), len(labels))
    cut = levels.filter(pl.col("high") > end).height
    notes = ["Compare within a vehicle only: the vehicles drove differently."] * (len(families) > 1)
    if cut:
        notes.append(
            f"{cut} interval{'s are' if cut > 1 else ' is'} longer than the axis and cut: so few runs tell "
            "little of others."
        )
    sentence = ", ".join(
        f"{dataset} {value:.3g}" for dataset, value in levels.select("dataset", "value").iter_rows()
    )
    return Drawing(
        chart, {f"{name}_spans": spans, f"{name}_runs": points}, " ".join(notes), f"In m/s: {sentence}."
    )


def draw_driving(bins: pl.DataFrame, input_name: str, families: Families) -> Drawing:
    """How hard each dataset was in each cell of commanded speed and yaw rate: a column is equal driving.

    Args:
        bins: as in `Answer`.
        input_name: input u.
        families: as in `Answer`; in their order.
    """
    axes = ["speed", "turn"]
    own = (
        bins.filter(pl.col("input") == input_name)
        .group_by("group", *axes)
        .agg(
            (pl.col("modulus").log() * pl.col("samples")).sum().truediv(pl.col("samples").sum()).exp(),
            pl.col("samples").sum(),
        )
        .with_columns(
            _name_classes("speed", SPEED_EDGES).alias("speed_class"),
            _name_classes("turn", TURN_EDGES).alias("turn_class"),
        )
        .sort("group", *axes)
    )
    order = [
        name for (name,) in own.sort("speed").select("speed_class").unique(maintain_order=True).iter_rows()
    ]
    turns = [
        name for (name,) in own.sort("turn").select("turn_class").unique(maintain_order=True).iter_rows()
    ]
    there = set(own["group"])
    datasets = [name for family in families.values() for name in family if name in there]
    labels = _label_datasets(datasets, families)
    rows = own.select(
        _label(labels), "speed_class", "turn_class", "modulus", pl.col("samples").cast(pl.Float64)
    )
    panels = []
    for label in labels.values():
        heat = (
            Chart.of_rows("driving")
            .filter(f"datum.label === {json.dumps(label)}")
            .mark("rect")
            .encode(
                x=encode_column(
                    "speed_class:N",
                    sort=order,
                    title=None,
                    scale={"domain": order},
                    axis={"labelAngle": 0, "grid": False},
                ),
                y=encode_column(
                    "turn_class:N",
                    sort=turns[::-1],
                    title=None,
                    scale={"domain": turns[::-1]},
                    axis={"minExtent": 44, "grid": False},
                ),
                color=encode_column(
                    "modulus:Q",
                    scale={"type": "log", "range": list(theme.SLIP_RAMP)},
                    legend={"title": "slip modulus [m/s]"},
                ),
                tooltip=[
                    "label:N",
                    "speed_class:N",
                    "turn_class:N",
                    encode_column("modulus:Q", format=".3"),
                    encode_column("samples:Q", format=","),
                ],
            )
            .properties(width=520, height=15 * len(turns), title={"text": label, "anchor": "start"})
        )
        panels.append(heat)
    chart = stack(*panels)
    note = (
        "Across: commanded speed [m/s]; up: commanded yaw rate [rad/s]. Empty: fewer than "
        f"{LEAST_SAMPLES} samples of a run."
    )
    words = (
        f"Median slip modulus by commanded speed and yaw rate, one panel for each of {len(labels)} datasets."
    )
    return Drawing(chart, {"driving": rows}, note, words)


def _name_classes(column: str, edges: Sequence[float]) -> pl.Expr:
    ends = (0.0, *edges)
    words = [f"{low:g}\u2013{high:g}" for low, high in itertools.pairwise(ends)] + [f"> {ends[-1]:g}"]
    return pl.col(column).replace_strict(dict(enumerate(words)), return_dtype=pl.String)


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
_ABOUT_PAIRS = "A run is the unit; where every dataset is one run, blocks of it are"
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
_RATIOS = (
    Column("pair"), Column("as driven"), Column("equal driving"), Column("of it driving", number=True),
    Column("in common"), Column("carried by"),
)  # fmt: skip
_PAIRS = (
    Column("pair"), Column("shift b \u2212 a", "m/s", number=True), Column("95 % interval", number=True),
    Column("Cliff\u2019s delta"), Column("p corrected", number=True), Column("p of the pair", number=True),
    Column("spread", number=True), Column("method"),
)  # fmt: skip


def render_comparison(answer: Answer, notes: Sequence[str]) -> str:
    """Render the complete page as HTML, with these of its notes."""
    shown = answer.datasets.filter(pl.col("input") == answer.input)
    facts = [f"{shown.height} datasets", f"{shown['runs'].sum()} runs", answer.measure]
    pictures = list_pictures(answer)
    published, driving = ([one for one in pictures if one.id == name] for name in (_PUBLISHED, _DRIVING))
    answers = _list_answers(answer)
    inputs = [
        {
            "words": INPUT_WORDS[name],
            "answers": [one for one in answers if one["input"] == name],
            "pictures": [one for one in pictures if one.id.endswith(f"_{name}") and one.id != _PUBLISHED],
            "pairs": _tabulate_ratios(answer, name),
        }
        for name in answer.inputs
    ]
    return render_figures(
        "report/templates/comparison.html",
        pictures,
        title="Deployments compared",
        facts=facts,
        inputs=inputs,
        driving=driving,
        published=published,
        unit=ABOUT_UNIT,
        datasets=_tabulate_datasets(shown, answer.input),
        pairs=[table for view in answer.views if (table := _tabulate_pairs(view))],
        difficulty=tabulate_difficulty(shown),
        swaps=list_contradictions(shown),
        measures=list(MEASURES.values()),
        orders=list(dict.fromkeys(one.text for one in compare_orders(shown))),
        notes=notes,
        counted=shown.select("dataset", "keys").to_dicts(),
    )


def _list_answers(answer: Answer) -> list[dict[str, object]]:
    """The answer's lines under what they are about."""
    answers = group_by((title_line(line), line) for line in list_lines(answer))
    return [{"title": title, "input": lines[0].input, "lines": lines} for title, lines in answers.items()]


_PUBLISHED = "window_norms_by_dataset"
_DRIVING = "driving"
_TITLES = {
    AS_DRIVEN: "How hard it was, as driven",
    EQUAL_DRIVING: "How hard the ground is, at equal driving",
    AS_PUBLISHED: "Median over runs, as published",
}


def list_pictures(answer: Answer) -> list[Picture]:
    """Levels of every comparison, the driving, and the published figure."""
    pictures = []
    for view in answer.views:
        own = answer.runs.filter(pl.col("input") == view.input).with_columns(
            pl.col(view.quantity).alias("value")
        )
        if view.levels.is_empty():
            continue
        words = INPUT_WORDS[view.input]
        title = f"{answer.measure if view.quantity != EQUAL_DRIVING else 'slip modulus'} {words} [m/s]"
        name = f"{view.quantity}_{view.input}"
        drawing = draw_levels(own, view.levels, answer.families, name=name, title=title)
        pictures.append(Picture(name, f"{_TITLES[view.quantity]}, {words}", drawing, width="half"))
    if not answer.bins.is_empty():
        title = f"Equal driving: the same place in every panel, {INPUT_WORDS[answer.input]}"
        pictures.append(Picture(_DRIVING, title, draw_driving(answer.bins, answer.input, answer.families)))
    boxes = answer.windows.filter(pl.col("input") == answer.input)
    if not boxes.is_empty():
        published = answer.quantity == AS_PUBLISHED
        words = "of the published chain" if published else INPUT_WORDS[answer.input]
        drawing = draw_boxes(boxes, answer.input, answer.families, title=f"2 s window norm {words} [m/s]")
        pictures.append(Picture(_PUBLISHED, "The published figure", drawing))
    return pictures


def _tabulate_ratios(answer: Answer, input_name: str) -> list[Table]:
    """One line a pair: ratios as driven and at equal driving; first the pairs that differ."""
    pairs = list_pairs(answer, input_name)
    sure = [pair for pair in pairs if pair.is_driven_sure or pair.is_equal_sure]
    groups = (sure, [pair for pair in pairs if pair not in sure])
    counts = (
        f"{len(sure)} of {len(pairs)} pairs differ significantly (bold)",
        f"{len(groups[1])} pairs of which none differs significantly",
    )
    return [
        _tabulate_pair_ratios(rows, f"{count}: times as much slip, {INPUT_WORDS[input_name]}")
        for rows, count in zip(groups, counts, strict=True)
        if rows
    ]


def _tabulate_pair_ratios(pairs: Sequence[PairLine], caption: str) -> Table:
    rows: list[list[str | Cell]] = [
        [
            f"{pair.hard} / {pair.easy}",
            Cell(pair.driven or MISSING, tag="b" if pair.is_driven_sure else ""),
            Cell(pair.equal or MISSING, tag="b" if pair.is_equal_sure else ""),
            f"{pair.driving} \u00d7" if pair.driving else MISSING,
            pair.common or MISSING,
            pair.carrier or MISSING,
        ]
        for pair in pairs
    ]
    return Table(caption, _RATIOS, rows).drop_empty()


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
    return Table(caption, _DATASETS, rows).drop_empty()


def _tabulate_pairs(view: View) -> Table | None:
    """Tests of the pairs of a comparison, in full."""
    rows: list[list[str | Cell]] = [
        [
            Cell(f"a {row['a']}", notes=[f"b {row['b']}", f"{row['runs_a']} + {row['runs_b']} runs"]),
            format_number(row["shift"]),
            _format_ends(row),
            f"{format_number(row['cliffs_delta'], digits=2)} {row['size']}",
            Cell(_format_p(row["p_adjusted"]), tag="b" if judge_pair(row) == DIFFERENT else ""),
            _format_p(row["p"]),
            MISSING if row["spread"] is None else f"{row['spread']:.2g} ({row['freedom']})",
            Cell(
                row["method"] or row["note"] or MISSING, small=ABOUT_BLOCKS * (judge_pair(row) == OF_TWO_RUNS)
            ),
        ]
        for row in view.comparisons.sort("p_adjusted", "p", "a", "b", nulls_last=True).iter_rows(named=True)
    ]
    if not rows:
        return None
    caption = f"{_TITLES[view.quantity]}, {INPUT_WORDS[view.input]}. {_ABOUT_PAIRS}"
    return Table(caption, _PAIRS, rows)


def _format_p(p: float | None) -> str:
    if p is None:
        return MISSING
    return f"{p:.4f}" if p >= 1e-4 else "< 0.0001"  # noqa: PLR2004 - as many digits as are shown


def _format_ends(row: Mapping[str, object]) -> str:
    low, high = number_in(row, "low"), number_in(row, "high")
    return MISSING if low is None else f"{format_number(low)}\u00a0to\u00a0{format_number(high)}"


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


def write_answer(store: Store, answer: Answer, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `datasets`, `comparisons` and `features`, their CSV and LaTeX tables, and `comparison.html`.

    Where figures cannot be drawn, the page is left out.

    Args:
        store: the results.
        answer: result of `compare_results`.
        figures: also write the two figures to `figures/` in this format.

    Returns:
        The files by name.

    Raises:
        SlipError: figures were asked for, and what draws them is not installed.
    """
    store.write_results_table("datasets", answer.datasets)
    store.write_results_table("features", answer.features)
    comparisons = pl.concat([view.comparisons for view in answer.views])
    store.write_results_table("comparisons", comparisons)
    written: dict[str, Path] = {}
    for name, frame, shown in (
        ("datasets", answer.datasets, answer.datasets.filter(pl.col("input") == answer.input)),
        ("comparisons", comparisons, answer.comparisons),
    ):
        written |= write_tables(store, name, frame, shown)
    if theme.can_draw():
        page = render_comparison(answer, list_shown_notes(answer))
        written["comparison.html"] = write_page(store, "comparison.html", page)
    return written | add_figures(store, lambda: list_pictures(answer), figures)


def write_tables(store: Store, name: str, frame: pl.DataFrame, shown: pl.DataFrame) -> dict[str, Path]:
    """Write a table as CSV and the rows for a paper as LaTeX; return the files by name."""
    texts = {f"{name}.csv": write_csv(frame), f"{name}.tex": write_latex(name, shown)}
    return {file: store.write_results_text(file, text) for file, text in texts.items()}


def write_csv(frame: pl.DataFrame) -> str:
    """Format a table as CSV with a header line; six decimal places."""
    return format_csv(frame, digits=6)


def write_latex(name: str, frame: pl.DataFrame) -> str:
    """Format the columns of a table that a paper shows as a LaTeX tabular (booktabs).

    Columns without values are omitted.

    Args:
        name: `datasets`, `comparisons`, `causes` or `cause_differences`.
        frame: the table.
    """
    columns = [
        column for column in _LATEX[name] if frame.is_empty() or frame[column[0]].null_count() < frame.height
    ]
    kinds = "".join("l" if frame.schema[column] in (pl.String, pl.Enum) else "r" for column, _, _ in columns)
    lines = [
        f"\\begin{{tabular}}{{{kinds}}}",
        "\\toprule",
        " & ".join(title for _, title, _ in columns) + " \\\\",
        "\\midrule",
        *(
            " & ".join(_write_cell(row[column], digits) for column, _, digits in columns) + " \\\\"
            for row in frame.iter_rows(named=True)
        ),
        "\\bottomrule",
        "\\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


_LATEX: dict[str, tuple[tuple[str, str, int], ...]] = {
    "datasets": (
        ("dataset", "dataset", 0),
        ("runs", "runs", 0),
        ("samples", "samples", 0),
        ("distance", "distance [m]", 0),
        ("median_modulus", "median $\\|g\\|$ [m/s]", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("equal_modulus", "at equal driving [m/s]", 3),
        ("median_window_norm", "window norm [m/s]", 2),
        ("published_norm", "as published", 2),
    ),
    "comparisons": (
        ("a", "a", 0),
        ("b", "b", 0),
        ("unit_of_analysis", "unit", 0),
        ("ratio", "$b/a$", 2),
        ("ratio_low", "low", 2),
        ("ratio_high", "high", 2),
        ("shift", "shift [m/s]", 3),
        ("cliffs_delta", "$\\delta$", 2),
        ("p", "$p$", 4),
        ("p_adjusted", "$p$ corrected", 4),
        ("smallest_p", "smallest $p$", 4),
    ),
    "causes": (
        ("dataset", "dataset", 0),
        ("runs", "runs", 0),
        ("cause", "cause", 0),
        ("share", "share", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("rms", "slip [m/s]", 3),
    ),
    "cause_differences": (
        ("a", "a", 0),
        ("b", "b", 0),
        ("cause", "cause", 0),
        ("difference", "difference [m/s]", 3),
        ("low", "low", 3),
        ("high", "high", 3),
        ("p_adjusted", "$p$ corrected", 4),
    ),
}


def _write_cell(value: object, digits: int) -> str:
    if value is None:
        return "--"
    if isinstance(value, float):
        return f"{value:.{digits}f}"
    return "".join(_SPECIAL.get(mark, mark) for mark in str(value))


_SPECIAL = {mark: rf"\{mark}" for mark in "&%$#_{}"} | {
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
}
