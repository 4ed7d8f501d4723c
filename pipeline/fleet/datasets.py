"""Runs pooled into datasets: the run is the unit, however long it is."""

import re
from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.fleet.statistics.intervals import Interval, bound_typical

OVER_RUNS = "over runs"
THIS_RUN = "this run only"

_MEDIANS = (
    "median_modulus", "median_window_norm", "published_norm", "transitory_median_modulus",
    "steady_median_modulus", "drivetrain_mean_square", "ground_mean_square", "cross_mean_square",
    "height_rate", "relative_slip", "slip_energy", "lost_energy", "unpredictability",
    "relative_unpredictability", "transitory_slip",
)  # fmt: skip
_REACH = 1.5
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
        runs: one row a run and input, as of `gather_runs`; runs without a group are left out.
        by: the columns that made the groups.
        within: interval of the median modulus of single runs by (run, input), for datasets of one run.
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
    """Ends of a dataset's interval, and what it speaks of."""
    medians = row[column]
    low, high, about = names
    if isinstance(medians, list) and len(medians) > 1:
        found, says = bound_typical(medians), OVER_RUNS
    else:
        one = within.get((str(row["only"]), str(row["input"])))
        if one is None:
            return {low: None, high: None, about: ""}
        found, says = one, THIS_RUN
    return {low: found.low, high: found.high, about: says}


_DAY = re.compile(r"(?<!\d)(20\d\d)[-_](\d{1,2})[-_](\d{1,2})(?!\d)")


def read_day(run: str) -> str | None:
    """A date in the name of a run (`2024_8_7` or `2024-08-07`) as `2024-08-07`; None where there is none."""
    found = _DAY.search(run)
    if found is None:
        return None
    year, month, day = (int(part) for part in found.groups())
    if not (1 <= month <= 12 and 1 <= day <= 31):  # noqa: PLR2004 - the calendar
        return None
    return f"{year:04d}-{month:02d}-{day:02d}"


def spread_windows(windows: pl.LazyFrame, groups: pl.DataFrame) -> pl.DataFrame:
    """Box plot numbers of the 2 s window norms of every group and input.

    Whiskers end at the last window within 1.5 quartile distances of the box (Tukey 1977).

    Args:
        windows: table `windows`; suspect ones are left out.
        groups: ``run`` and ``group``.

    Returns:
        ``group``, ``input``, ``windows``, ``low``, ``q1``, ``median``, ``q3``, ``high`` [m/s].
    """
    norm = pl.col("window_norm")
    first, third = norm.quantile(0.25), norm.quantile(0.75)
    reach = _REACH * (third - first)
    return (
        windows.filter(~pl.col("suspect"), norm.is_finite())
        .join(groups.lazy(), on="run")
        .group_by("group", "input")
        .agg(
            pl.len().alias("windows"),
            norm.filter(norm >= first - reach).min().alias("low"),
            first.alias("q1"),
            norm.median().alias("median"),
            third.alias("q3"),
            norm.filter(norm <= third + reach).max().alias("high"),
        )
        .sort("median", "group")
        .collect()
    )
