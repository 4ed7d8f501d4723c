"""The page of `slip compare`."""

from collections.abc import Mapping

import polars as pl

from pipeline.core.durations import say_duration
from pipeline.fleet.measures import MEASURES, compare_orders
from pipeline.fleet.statistics.ranks import kendall_tau, list_swaps
from pipeline.fleet.tables import Answer
from pipeline.report.comparison.figures import draw_boxes, draw_runs
from pipeline.report.elements import Cell, Column, Picture, Table
from pipeline.report.page import render_figures
from pipeline.report.run import INPUT_WORDS, say_ends
from pipeline.report.words import MISSING, say_distance, say_number

_LEVEL = 0.05
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
    Column("median modulus", "m/s", number=True), Column("95 % interval", number=True),
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
    Column("plain p,", "not valid", number=True),
)  # fmt: skip


def render_comparison(answer: Answer) -> str:
    """The whole page as HTML."""
    shown = answer.datasets.filter(pl.col("input") == answer.input)
    facts = [
        f"{shown.height} datasets",
        f"{shown['runs'].sum()} runs",
        f"slip {INPUT_WORDS[answer.input]}",
        "as published" if answer.quantity == "published_norm" else "median modulus",
    ]
    return render_figures(
        "report/templates/comparison.html",
        list_pictures(answer),
        title="Deployments compared",
        facts=facts,
        verdict=_say_verdict(answer.comparisons),
        datasets=_tabulate_datasets(shown, answer.input),
        pairs=_tabulate_pairs(answer.comparisons),
        difficulty=tabulate_difficulty(shown),
        swaps=list_contradictions(shown),
        measures=list(MEASURES.values()),
        orders=list(dict.fromkeys(one.text for one in compare_orders(shown))),
        notes=answer.notes,
        counted=shown.select("dataset", "keys").to_dicts(),
    )


def list_pictures(answer: Answer) -> list[Picture]:
    """The published figure and the honest one."""
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
            else f"median slip modulus {INPUT_WORDS[input_name]} [m/s]"
        )
        drawing = draw_runs(own, rated, value=answer.quantity, title=title)
        pictures.append(Picture("run_medians_by_dataset", "The honest figure", drawing))
    return pictures


def _say_verdict(comparisons: pl.DataFrame) -> str:
    if comparisons.is_empty():
        return "There is one dataset only: nothing to compare it with."
    different = comparisons.filter(pl.col("p_adjusted") <= _LEVEL)
    over_runs = different.filter(pl.col("unit_of_analysis") == "runs").height
    hopeless = comparisons.filter(pl.col("smallest_p") > _LEVEL).height
    verdict = (
        f"Of {comparisons.height} pairs {over_runs} differ as terrains (runs permuted) and "
        f"{different.height - over_runs} as single runs only"
    )
    if hopeless:
        verdict += f"; {hopeless} have too few runs to differ whatever the numbers"
    return f"{verdict}. Corrected for asking often, 5 %."


def _tabulate_datasets(shown: pl.DataFrame, input_name: str) -> Table:
    rows: list[list[str | Cell]] = [
        [
            str(row["dataset"]),
            str(row["runs"]),
            f"{row['samples']:,}",
            say_distance(row["distance"]).replace(" ", "\u00a0"),
            MISSING if row["duration"] is None else say_duration(row["duration"]).replace(" ", "\u00a0"),
            say_number(row["median_modulus"]),
            Cell(_say_ends(row), small="this run" if row["interval"] == "this run only" else ""),
            *(say_number(row[name]) for name in _SHOWN),
        ]
        for row in shown.sort("median_modulus").iter_rows(named=True)
    ]
    caption = f"Medians over runs, slip {INPUT_WORDS[input_name]}; a run counts once, whatever its length"
    # What nobody has worked out, or the logs do not show, is no column.
    kept = [i for i in range(len(_DATASETS)) if any(row[i] not in (MISSING, Cell(MISSING)) for row in rows)]
    return Table(caption, [_DATASETS[i] for i in kept], [[row[i] for i in kept] for row in rows])


def _tabulate_pairs(comparisons: pl.DataFrame) -> Table | None:
    if comparisons.is_empty():
        return None
    rows = [
        [
            Cell(f"{row['a']} | {row['b']}", small=f"{row['runs_a']} + {row['runs_b']}"),
            say_number(row["shift"]),
            _say_ends(row),
            f"{say_number(row['cliffs_delta'], digits=2)} {row['size']}",
            _say_p(row["p_adjusted"]),
            _say_p(row["p"]),
            _say_p(row["smallest_p"]),
            _say_pair(row),
            "runs" if row["unit_of_analysis"] == "runs" else "run\u00a0against\u00a0run",
            Cell(small=_say_p(row["p_uncorrected"])),
        ]
        for row in comparisons.sort("p_adjusted", "p").iter_rows(named=True)
    ]
    return Table(_ABOUT_PAIRS, _PAIRS, rows)


def _say_pair(row: Mapping[str, object]) -> str | Cell:
    if _number(row["p_adjusted"]) <= _LEVEL:
        return Cell("different", tag="b")
    if _number(row["smallest_p"]) > _LEVEL:
        return "too few runs to tell"
    return "not shown to differ"


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else 1.0


def _say_p(p: float) -> str:
    return f"{p:.4f}" if p >= 1e-4 else "< 0.0001"  # noqa: PLR2004 - as many digits as are shown


def _say_ends(row: Mapping[str, object]) -> str:
    return say_ends(row).replace(" ", "\u00a0") or MISSING


def tabulate_difficulty(shown: pl.DataFrame) -> Table:
    """Values and ranks of every measure, and how far each agrees with the modulus.

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
                    say_number(row[column]),
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
    rows.append([Cell("agreement with the modulus (Kendall)", tag="i"), *agreement])
    head = [Column("dataset"), *(Column(one.name, one.unit, number=True) for one in MEASURES.values())]
    return Table("Median over runs and, in brackets, the rank from easy to hard", head, rows)


def list_contradictions(shown: pl.DataFrame) -> list[str]:
    """Pairs of datasets that a measure orders otherwise than the modulus does, in words."""
    told = []
    for measure in MEASURES.values():
        both = _rate(shown).drop_nulls(measure.column)
        if both.height >= _FEWEST:
            swaps = list_swaps(both["median_modulus"].to_numpy(), both[measure.column].to_numpy())
            told += [
                f"{both['dataset'][i]} slips more than {both['dataset'][j]} by modulus, "
                f"but less by {measure.name}"
                for i, j in swaps[:_MOST_SWAPS]
            ]
    return told


def _rate(shown: pl.DataFrame) -> pl.DataFrame:
    return shown.drop_nulls("median_modulus").sort("median_modulus")
