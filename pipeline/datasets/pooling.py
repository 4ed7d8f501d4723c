"""Data of each run (labels, medians, measures of difficulty), and the datasets into which runs are pooled."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import FOLDS, STRETCH_S, Floats, SlipError, group_by
from pipeline.datasets.pairs import THIS_RUN, bound_groups, name_interval
from pipeline.run import MOVING_MPS
from pipeline.stages import find_fastest
from schemas.run_tables import COUNTED


class ComparisonError(SlipError):
    """Results, or a table of deployments, that cannot be compared."""


_RIDGE = 1e-9
"""Ridge as a share of the trace, which makes normal equations solvable: as small as the last digit."""
_DIGITS = 9
"""Significant digits: the last ones of a double depend on the order of summation."""

_X, _W = pl.col("f_x"), pl.col("f_w")
_FEATURES: dict[str, dict[str, pl.Expr]] = {
    "x": {"radius": _X, "turning": _X * _W.abs(), "speed": _X * _X.abs()},
    "y": {"icr": _W, "skid": _X * _W, "drift": _X},
    "w": {"track": _W, "asymmetry": _X, "coupling": _X * _W},
}


def measure_unpredictability(slip: pl.LazyFrame) -> pl.LazyFrame:
    """Root mean square residual of a fitted static slip model on held-out data [m/s].

    The model is linear in the prediction of the ideal model: g_x in (f_x, f_x |f_w|, f_x |f_x|), g_y and g_w
    in (f_w, f_x f_w, f_x). It contains the slip laws of Seegmiller and Kelly (RSS 2014) and of DRIVE (Baril
    et al. 2024) without memory. It is fitted to four fifths of a run and evaluated on the fifth, in blocks of
    10 s. Delay, lag and inertia count as residual: use the measured wheels to exclude the drivetrain.

    Args:
        slip: table `slip` with ``length_scale`` [m] joined; it is read once and reduced to sums of products.

    Returns:
        ``run``, ``input``, ``unpredictability``; null for runs with fewer than five blocks.
    """
    fold = ((pl.col("t") / STRETCH_S).floor().cast(pl.Int64) % FOLDS).alias("fold")
    sums = [pl.len().alias("count"), pl.col("length_scale").first()]
    for channel, features in _FEATURES.items():
        target = pl.col(f"g_{channel}")
        sums.append((target**2).sum().alias(f"{channel}:"))
        sums += [(value * target).sum().alias(f"{channel}:{name}") for name, value in features.items()]
        sums += [
            (features[one] * features[two]).sum().alias(f"{channel}:{one}:{two}")
            for one, two in itertools.combinations_with_replacement(features, 2)
        ]
    return (
        slip.group_by("run", "input", fold)
        .agg(sums)
        .group_by("run", "input")
        .agg(pl.all().sort_by("fold"))
        .map_batches(_judge_runs, schema=None, validate_output_schema=False)
    )


def _judge_runs(folds: pl.DataFrame) -> pl.DataFrame:
    whole = pl.col("fold").list.len() == FOLDS
    judged = folds.filter(whole)
    if judged.is_empty():
        return judged.select("run", "input", pl.lit(None, pl.Float64).alias("unpredictability"))
    count = _stack(judged, "count")
    length = _stack(judged, "length_scale")[:, 0]
    total = np.zeros(judged.height)
    for channel, features in _FEATURES.items():
        scale = length**2 if channel == "w" else np.ones_like(length)
        total += scale * _leave_out(judged, channel, list(features)).sum(axis=1) / count.sum(axis=1)
    residual = pl.Series("unpredictability", np.sqrt(np.maximum(total, 0.0)), dtype=pl.Float64)
    # Threads sum in undefined order, which changes the last digits.
    return judged.select("run", "input", residual.round_sig_figs(_DIGITS))


def _leave_out(folds: pl.DataFrame, channel: str, names: list[str]) -> Floats:
    """Squared error of every fold under the model of the others, shape (runs, folds)."""
    size = len(names)
    squares = _stack(folds, f"{channel}:")
    right = np.stack([_stack(folds, f"{channel}:{name}") for name in names], axis=-1)
    held_out = np.zeros((*squares.shape, size, size))
    for (i, one), (j, two) in itertools.combinations_with_replacement(enumerate(names), 2):
        held_out[..., i, j] = held_out[..., j, i] = _stack(folds, f"{channel}:{one}:{two}")
    others = held_out.sum(axis=1, keepdims=True) - held_out
    trace = np.trace(others, axis1=-2, axis2=-1)[..., None, None]
    others = others + (_RIDGE * trace + 1e-12) * np.eye(size)
    wanted = right.sum(axis=1, keepdims=True) - right
    weights = np.linalg.solve(others, wanted[..., None])[..., 0]
    explained = 2.0 * np.einsum("rfi,rfi->rf", weights, right)
    spent = np.einsum("rfi,rfij,rfj->rf", weights, held_out, weights)
    error: Floats = squares - explained + spent
    return error


def _stack(folds: pl.DataFrame, column: str) -> Floats:
    return np.array(folds[column].to_list(), dtype=np.float64)


LABELS = ("dataset", "vehicle", "terrain", "run", "day", "month", "year")
UNKNOWN = "unknown"
_FEWEST = 10
"""Minimum samples of a command step, transitory and steady each: half a second at 20 Hz."""

_MEASURES = {
    "relative_slip": pl.Float64,
    "slip_energy": pl.Float64,
    "lost_energy": pl.Float64,
    "unpredictability": pl.Float64,
    "relative_unpredictability": pl.Float64,
    "transitory_slip": pl.Float64,
    "published_norm": pl.Float64,
    "equal_modulus": pl.Float64,
}


def label_runs(runs: pl.DataFrame, by: Sequence[str]) -> pl.DataFrame:
    """Assign every run to its group.

    Args:
        runs: one row per run with the columns `LABELS`.
        by: columns that define a group.

    Returns:
        The runs with ``group``: the labels joined by ` / `, null if one of them is unknown.

    Raises:
        ComparisonError: ``no_such_column``.
    """
    unknown = [name for name in by if name not in LABELS]
    if unknown or not by:
        what = f"runs cannot be grouped by {', '.join(unknown) or 'nothing'}"
        hint = f"Use one or several of {', '.join(LABELS)}, with commas between them"
        raise ComparisonError("no_such_column", what, hint=hint)
    known = [pl.col(name).is_not_null() & (pl.col(name) != UNKNOWN) for name in by]
    if "dataset" in by:
        known.append(pl.col("terrain") != UNKNOWN)
    label = pl.concat_str(*by, separator=" / ")
    return runs.with_columns(pl.when(pl.all_horizontal(known)).then(label).alias("group"))


def find_unrelated(labels: pl.DataFrame) -> frozenset[frozenset[str]]:
    """Pairs of groups of different vehicles, whose difference may be due to the vehicle.

    Where no pair has a vehicle in common, as where groups are vehicles, those of a common terrain are not
    unrelated.

    Args:
        labels: one row per run: ``group``, ``vehicle``, ``terrain``.
    """
    groups = [
        (str(name), {column: set(rows[column]) - {UNKNOWN} for column in ("vehicle", "terrain")})
        for (name,), rows in labels.partition_by("group", as_dict=True).items()
    ]
    pairs = list(itertools.combinations(groups, 2))
    unrelated: frozenset[frozenset[str]] = frozenset()
    for column in ("vehicle", "terrain"):
        unrelated = frozenset(
            frozenset((one, other))
            for (one, own), (other, theirs) in pairs
            if own[column].isdisjoint(theirs[column])
        )
        if len(unrelated) < len(pairs):
            break
    return unrelated


def gather_runs(aggregates: pl.DataFrame, labels: pl.DataFrame) -> pl.DataFrame:
    """One row per run and input from the tables `aggregates`; measures that need other tables are null.

    Args:
        aggregates: table `aggregates`.
        labels: one row per run: `LABELS`, ``key``, ``group``.
    """
    halves = [
        aggregates.filter(pl.col("subset") == name).select(
            "run", "input", pl.col("median_modulus").alias(f"{name}_median_modulus")
        )
        for name in ("transitory", "steady")
    ]
    whole = aggregates.filter(pl.col("subset") == "all").drop("subset", "dataset", "vehicle", "terrain")
    # A constant height was not measured.
    whole = whole.with_columns(pl.col("height_rate").replace(0.0, None))
    for half in halves:
        whole = whole.join(half, on=["run", "input"], how="left")
    return (
        whole.join(labels, on="run")
        .with_columns(pl.lit(None, kind).alias(name) for name, kind in _MEASURES.items())
        .sort("run", "input")
    )


def measure_difficulty(slip: pl.LazyFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Measures of difficulty that are comparable between vehicles, one row per run and input.

    - ``relative_slip`` [1]: median of modulus / ||(f_x, f_y, L f_w)||, over steps whose ideal speed is above
      0.1 m/s: the share of the ideal motion that did not become motion.
    - ``slip_energy`` [J]: median of 1/2 m |g_xy|^2 + 1/2 I g_w^2, the kinetic energy of the slip velocity.
      I is that of a plate as wide as the track and as long as the wheelbase, m (b^2 + l^2) / 12.
      Null without the mass.
    - ``lost_energy`` [1]: slip path over path driven, of the vehicle's plate: root mean square over its mass
      of the velocities at its points, both integrated. With Coulomb friction mu the energy loss per metre and
      mass is mu g times this; mu is unknown, and cancels in comparisons. Null where track and wheelbase are
      unknown, or where nothing moved.
    - ``transitory_slip`` [m]: median over command steps of the integral of modulus minus the step's steady
      median over its transitory span: the slip path of a command change in excess of steady driving.
    - ``largest_kinetic_energy`` [J]: 1/2 m v^2 of the 99th percentile of the speed's running median over one
      second, which removes the jitter of held poses and single jumps; as in table `aggregates`.
    - ``unpredictability`` [m/s]: see `measure_unpredictability`; ``relative_unpredictability`` [1]: over the
      root mean square ideal speed ||(f_x, f_y, L f_w)||.

    Args:
        slip: table `slip` of all runs; only the columns needed are read, and only the rows of medians.
        vehicles: one row per run: ``run``, ``mass`` [kg], ``squared_gyration`` (I / m) [m^2] (null if
            unknown), ``length_scale`` [m].

    Returns:
        ``run``, ``input`` and the measures.
    """
    sound = slip.filter(COUNTED).join(vehicles.lazy(), on="run")
    squared_yaw = (pl.col("length_scale") * pl.col("f_w")) ** 2
    ideal = (pl.col("f_x") ** 2 + pl.col("f_y") ** 2 + squared_yaw).sqrt()
    moved = pl.col("g_x") ** 2 + pl.col("g_y") ** 2
    energy = 0.5 * pl.col("mass") * (moved + pl.col("squared_gyration") * pl.col("g_w") ** 2)
    simple = sound.group_by("run", "input").agg(
        (pl.col("modulus") / ideal).filter(ideal > MOVING_MPS).median().alias("relative_slip"),
        energy.median().alias("slip_energy"),
        (_plate("g").sum() / _plate("v").sum()).alias("lost_energy"),
        (ideal**2).mean().sqrt().alias("ideal"),
        (0.5 * pl.col("mass").first() * find_fastest() ** 2).alias("largest_kinetic_energy"),
    )
    fresh, late = pl.col("transitory"), ~pl.col("transitory")
    level = pl.col("modulus").filter(late).median()
    period = (pl.col("t").last() - pl.col("t").first()) / (pl.len() - 1)
    steps = (
        sound.group_by("run", "input", "step")
        .agg(
            ((pl.col("modulus").filter(fresh) - level).sum() * period).alias("excess"),
            pl.min_horizontal(fresh.sum(), late.sum()).alias("samples"),
        )
        .filter(pl.col("samples") >= _FEWEST)
        .group_by("run", "input")
        .agg(pl.col("excess").median().alias("transitory_slip"))
    )
    joined, residual = pl.collect_all(
        [simple.join(steps, on=["run", "input"], how="left"), measure_unpredictability(sound)]
    )
    whole = joined.join(residual, on=["run", "input"], how="left").sort("run", "input")
    ratios = {
        "lost_energy": pl.col("lost_energy"),
        "relative_unpredictability": pl.col("unpredictability") / pl.col("ideal"),
    }
    # Sums of nulls are zero, and so are paths of a standing vehicle.
    return whole.with_columns(
        pl.when(ratio.is_finite()).then(ratio).alias(name) for name, ratio in ratios.items()
    ).drop("ideal")


def _plate(of: str) -> pl.Expr:
    """Root mean square velocity of the points of the vehicle's plate."""
    turning = pl.col("squared_gyration") * pl.col(f"{of}_w") ** 2
    return (pl.col(f"{of}_x") ** 2 + pl.col(f"{of}_y") ** 2 + turning).sqrt()


def add_measures(runs: pl.DataFrame, measures: pl.DataFrame) -> pl.DataFrame:
    """Return the runs with the computed measures inserted."""
    return runs.update(measures.with_columns(pl.col("input").cast(runs.schema["input"])), on=["run", "input"])


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
    "slip": Measure(
        "median_modulus", "slip modulus", "m/s", "the published measure; fast vehicles look worse"
    ),
    "relative": Measure(
        "relative_slip", "relative slip", "1", "slip modulus over ideal speed, while the vehicle should move"
    ),
    "energy": Measure(
        "lost_energy",
        "lost energy",
        "1",
        "slip path over path driven: energy lost to friction per metre and mass, over mu g",
    ),
    "unpredictability": Measure(
        "relative_unpredictability",
        "unpredictability",
        "1",
        "held-out RMS residual of a fitted slip model over the RMS ideal speed",
    ),
    "transitory": Measure(
        "transitory_slip",
        "transitory slip",
        "m",
        "slip path that a change of command adds to the steady slip path",
    ),
}

_MEDIANS = (
    "median_modulus", "median_window_norm", "published_norm", "transitory_median_modulus",
    "steady_median_modulus", "drivetrain_mean_square", "ground_mean_square", "cross_mean_square",
    "height_rate", "relative_slip", "slip_energy", "lost_energy", "unpredictability",
    "relative_unpredictability", "transitory_slip",
)  # fmt: skip
_SUMS = ("samples", "windows", "distance", "duration")
_NO_INTERVALS: Mapping[tuple[str, str], tuple[float, float]] = {}


def pool_runs(
    runs: pl.DataFrame,
    by: Sequence[str],
    *,
    within: Mapping[tuple[str, str], tuple[float, float]] = _NO_INTERVALS,
    norms_within: Mapping[tuple[str, str], tuple[float, float]] = _NO_INTERVALS,
) -> pl.DataFrame:
    """Table `datasets`: medians over runs, with intervals over runs.

    Args:
        runs: one row per run and input, as from `gather_runs`; runs without a group are ignored.
        by: columns that define the groups.
        within: interval of the median slip modulus of single runs by (run, input), for datasets of one run.
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
        *(pl.lit(None, pl.Float64).alias(name) for name in ("equal_modulus", "equal_low", "equal_high")),
        pl.col("run").first().alias("only"),
    )
    ends = {
        **_bound_groups(grouped, "moduli", within, ("low", "high", "interval")),
        **_bound_groups(grouped, "norms", norms_within, ("norm_low", "norm_high", "norm_interval")),
    }
    return (
        grouped.with_columns(**ends)
        .rename({"group": "dataset"})
        .drop("moduli", "norms", "only", "norm_interval")
        .sort("dataset", "input")
    )


def _bound_groups(
    grouped: pl.DataFrame,
    column: str,
    within: Mapping[tuple[str, str], tuple[float, float]],
    names: tuple[str, str, str],
) -> dict[str, pl.Series]:
    """Bounds of the groups' intervals, and whether they are over runs or for this run.

    The spread between runs is pooled over the groups of a vehicle.
    """
    low, high, about = names
    bounds: list[tuple[float | None, float | None, str]] = [(None, None, "")] * grouped.height
    rows = grouped.select("vehicle", pl.col("input").cast(pl.String), "only", column).rows(named=True)
    families = group_by(
        ((row["vehicle"], row["input"]), index) for index, row in enumerate(rows) if row[column]
    )
    for indices in families.values():
        over_runs = bound_groups([np.array(rows[index][column]) for index in indices])
        for index, interval in zip(indices, over_runs, strict=True):
            one = within.get((rows[index]["only"], rows[index]["input"]))
            if interval is not None:
                bounds[index] = (*interval, name_interval(len(rows[index][column])))
            elif one is not None:
                bounds[index] = (*one, THIS_RUN)
    return {
        name: pl.Series([one[k] for one in bounds], dtype=kind)
        for k, (name, kind) in enumerate(((low, pl.Float64), (high, pl.Float64), (about, pl.String)))
    }
