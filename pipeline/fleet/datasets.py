"""Pooling of runs into datasets, and measures of their difficulty."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.fleet.confidence import Interval, bound_typical
from pipeline.fleet.rank_tests import LEVEL, kendall_p, kendall_tau


@dataclass(frozen=True)
class Measure:
    """A measure of difficulty.

    Attributes:
        column: column of the table `datasets`.
        name, unit, about: description in words; measures of unit 1 compare vehicles of any size.
    """

    column: str
    name: str
    unit: str
    about: str


MEASURES = {
    "slip": Measure("median_modulus", "slip speed", "m/s", "the published idea: fast vehicles look worse"),
    "relative": Measure(
        "relative_slip", "relative slip", "1", "slip speed over ideal speed, while the vehicle should move"
    ),
    "energy": Measure(
        "lost_energy",
        "lost energy",
        "1",
        "slip path over path driven: what friction takes per metre and mass, over its coefficient times g",
    ),
    "unpredictability": Measure(
        "relative_unpredictability",
        "unpredictability",
        "1",
        "rms slip that a fitted slip model leaves on unseen data, over the rms ideal speed",
    ),
    "transitory": Measure(
        "transitory_slip", "transitory slip", "m", "slip path that a change of command adds to the steady one"
    ),
}


@dataclass(frozen=True)
class Agreement:
    """Agreement of two vehicles on the order of the terrains that both were driven on.

    Attributes:
        measure: key of `MEASURES`.
        a, b: vehicles.
        terrains: common terrains, from easy to hard for `a`.
        tau: Kendall's tau-b; None with fewer than two terrains.
        p: two-sided probability of an order as strong if there were none.
        smallest_p: smallest p possible with this number of terrains.
        text: the result in words.
    """

    measure: str
    a: str
    b: str
    terrains: tuple[str, ...]
    tau: float | None
    p: float | None
    smallest_p: float | None
    text: str


def compare_orders(datasets: pl.DataFrame) -> list[Agreement]:
    """Compare every two vehicles by every measure that both have; a terrain has the median over its datasets.

    Args:
        datasets: table `datasets` of one input; rows over several vehicles or terrains are ignored.
    """
    known = datasets.filter(pl.col("vehicle") != "*", pl.col("terrain") != "*")
    comparisons = []
    for a, b in itertools.combinations(sorted(set(known["vehicle"])), 2):
        for key, measure in MEASURES.items():
            sides = [
                known.filter(pl.col("vehicle") == vehicle)
                .drop_nulls(measure.column)
                .group_by("terrain")
                .agg(pl.col(measure.column).median().alias(vehicle))
                for vehicle in (a, b)
            ]
            comparisons.append(_compare(key, a, b, sides[0].join(sides[1], on="terrain").sort(a, "terrain")))
    return comparisons


def _compare(key: str, a: str, b: str, both: pl.DataFrame) -> Agreement:
    terrains = tuple(both["terrain"].to_list())
    count = len(terrains)
    if count < 2:  # noqa: PLR2004 - an order takes two
        shared = f"share {terrains[0]} only" if terrains else "have no terrain in common"
        return Agreement(
            key, a, b, terrains, None, None, None, f"{a} and {b} {shared}: no order of terrains to compare"
        )
    tau = kendall_tau(both[a], both[b])
    p, smallest = kendall_p(tau, count)
    sure = (
        f"p = {p:.2g}"
        if smallest <= LEVEL
        else f"too few terrains for significance, p = {p:.2g}; at least 5 are needed"
    )
    text = f"{a} and {b} on {count} terrains by {MEASURES[key].name}: Kendall's tau {tau:.2f}, {sure}"
    return Agreement(key, a, b, terrains, tau, p, smallest, text)


OVER_RUNS = "over runs"
THIS_RUN = "this run only"

_MEDIANS = (
    "median_modulus", "median_window_norm", "published_norm", "transitory_median_modulus",
    "steady_median_modulus", "drivetrain_mean_square", "ground_mean_square", "cross_mean_square",
    "height_rate", "relative_slip", "slip_energy", "lost_energy", "unpredictability",
    "relative_unpredictability", "transitory_slip",
)  # fmt: skip
_REACH = 1.5
"""Maximum length of whiskers in box lengths (Tukey 1977); 0.7 % of normal values lie beyond."""
_SUMS = ("samples", "windows", "distance", "duration")
_NO_INTERVALS: Mapping[tuple[str, str], Interval] = {}


def pool_runs(
    runs: pl.DataFrame,
    by: Sequence[str],
    *,
    within: Mapping[tuple[str, str], Interval] = _NO_INTERVALS,
    norms_within: Mapping[tuple[str, str], Interval] = _NO_INTERVALS,
) -> pl.DataFrame:
    """Table `datasets`: medians over runs, with intervals over runs.

    Args:
        runs: one row per run and input, as from `gather_runs`; runs without a group are ignored.
        by: columns that define the groups.
        within: interval of the median slip speed of single runs by (run, input), for datasets of one run.
        norms_within: the same for the window norm.
    """
    known = runs.filter(pl.col("group").is_not_null()).with_columns(
        (pl.col("run") + "/" + pl.col("key")).alias("place")
    )
    grouped = known.group_by("group", "input").agg(
        pl.lit("*").alias("run"),
        *(
            pl.when(pl.col(name).n_unique() == 1)
            .then(pl.col(name).first())
            .otherwise(pl.lit("*"))
            .alias(name)
            for name in ("vehicle", "terrain")
        ),
        pl.lit(",".join(by)).alias("by"),
        pl.len().cast(pl.Int64).alias("runs"),
        *(pl.col(name).sum() for name in _SUMS),
        pl.col("length_scale").first(),
        *(pl.col(name).median() for name in _MEDIANS),
        pl.col("largest_kinetic_energy").max(),
        pl.col("place").sort().str.join(" ").alias("keys"),
        pl.col("median_modulus").drop_nulls().alias("moduli"),
        pl.col("median_window_norm").drop_nulls().alias("norms"),
        pl.col("run").first().alias("only"),
    )
    rows = [
        {
            **row,
            **_name_ends(row, "moduli", within, ("low", "high", "interval")),
            **_name_ends(row, "norms", norms_within, ("norm_low", "norm_high", "norm_interval")),
        }
        for row in grouped.iter_rows(named=True)
    ]
    ends = dict.fromkeys(("low", "high", "norm_low", "norm_high"), pl.Float64())
    schema = pl.Schema({**grouped.schema, **ends, "interval": pl.String(), "norm_interval": pl.String()})
    return (
        pl.DataFrame(rows, schema=schema)
        .rename({"group": "dataset"})
        .drop("moduli", "norms", "only", "norm_interval")
        .sort("dataset", "input")
    )


def _name_ends(
    row: Mapping[str, object],
    column: str,
    within: Mapping[tuple[str, str], Interval],
    names: tuple[str, str, str],
) -> dict[str, float | str | None]:
    """Bounds of a dataset's interval, and whether it is over runs or for this run."""
    medians = row[column]
    low, high, about = names
    if isinstance(medians, list) and len(medians) > 1:
        interval, about_which = bound_typical(medians), OVER_RUNS
    else:
        one = within.get((str(row["only"]), str(row["input"])))
        if one is None:
            return {low: None, high: None, about: ""}
        interval, about_which = one, THIS_RUN
    return {low: interval.low, high: interval.high, about: about_which}


_DAY = re.compile(r"(?<!\d)(20\d\d)[-_](\d{1,2})[-_](\d{1,2})(?!\d)")


def read_day(run: str) -> str | None:
    """Date in the name of a run (`2024_8_7` or `2024-08-07`) as `2024-08-07`; None without one."""
    match = _DAY.search(run)
    if match is None:
        return None
    year, month, day = (int(part) for part in match.groups())
    if not (1 <= month <= 12 and 1 <= day <= 31):  # noqa: PLR2004 - the calendar
        return None
    return f"{year:04d}-{month:02d}-{day:02d}"


def spread_windows(windows: pl.LazyFrame, groups: pl.DataFrame) -> pl.DataFrame:
    """Box plot statistics of the 2 s window norms of every group and input.

    Whiskers end at the last window within 1.5 interquartile ranges of the box (Tukey 1977).

    Args:
        windows: table `windows`; suspect ones are excluded.
        groups: ``run`` and ``group``.

    Returns:
        ``group``, ``input``, ``windows``, ``low``, ``q1``, ``median``, ``q3``, ``high`` [m/s].
    """
    norm = pl.col("window_norm")
    first, third = norm.quantile(0.25), norm.quantile(0.75)
    span = _REACH * (third - first)
    return (
        windows.filter(~pl.col("suspect"), norm.is_finite())
        .join(groups.lazy(), on="run")
        .group_by("group", "input")
        .agg(
            pl.len().alias("windows"),
            norm.filter(norm >= first - span).min().alias("low"),
            first.alias("q1"),
            norm.median().alias("median"),
            third.alias("q3"),
            norm.filter(norm <= third + span).max().alias("high"),
        )
        .sort("median", "group")
        .collect()
    )
