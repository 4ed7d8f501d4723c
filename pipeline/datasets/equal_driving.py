"""Slip at equal driving: bins of what was commanded, and levels of runs over them.

A gentle run slips less on any ground. Samples are therefore sorted into bins of commanded speed and yaw
rate, and the logarithm of a bin's median slip modulus is the level of its run plus that of the bin. The
levels of runs then compare grounds as if all runs had driven all bins.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, Floats
from pipeline.run import STILL_MPS

SPEED_EDGES = (0.5, 1.0, 1.5, 2.0, 3.0, 6.0, 12.0, 24.0)
"""Edges of the classes of commanded speed [m/s]: half a metre per second where field robots drive, twice the
last above; the last class is open."""
TURN_EDGES = (0.3, 0.8, 1.5, 2.5, 6.0)
"""Edges of the classes of commanded yaw rate [rad/s]; the last class is open."""
LEAST_SAMPLES = 100
"""Fewest samples of a run in a bin: 5 s at 20 Hz, several correlation times of slip (1 to 2.5 s)."""


def measure_bins(slip: pl.LazyFrame) -> pl.DataFrame:
    """Median slip modulus of every run in every bin of commanded speed and yaw rate.

    Samples in which the vehicle is commanded to stand say nothing of the ground and are left out, and so are
    runs without commands.

    Args:
        slip: table `slip`; suspect rows are left out.

    Returns:
        ``run``, ``input``, ``speed`` and ``turn`` (numbers of the classes), ``samples``, ``modulus`` [m/s].
    """
    sound = slip.filter(
        ~pl.col("suspect"), pl.col("modulus").is_finite(), pl.col("modulus") > 0.0
    ).with_columns(pl.col("input").cast(pl.String))
    speed, turn = (pl.col("f_x") ** 2 + pl.col("f_y") ** 2).sqrt(), pl.col("f_w").abs()
    commands = (
        slip.filter(pl.col("input") == "command", (speed > STILL_MPS) | (turn > STILL_MPS))
        .select(
            "run",
            "t",
            _number_classes(speed, SPEED_EDGES).alias("speed"),
            _number_classes(turn, TURN_EDGES).alias("turn"),
        )
        .unique(["run", "t"])
    )
    return (
        sound.select("run", "t", "input", "modulus")
        .join(commands, on=["run", "t"])
        .group_by("run", "input", "speed", "turn")
        .agg(pl.len().cast(pl.Int64).alias("samples"), pl.col("modulus").median())
        .filter(pl.col("samples") >= LEAST_SAMPLES)
        .sort("run", "input", "speed", "turn")
        .collect()
    )


def _number_classes(value: pl.Expr, edges: tuple[float, ...]) -> pl.Expr:
    return pl.sum_horizontal(*(value >= edge for edge in edges)).cast(pl.Int64)


@dataclass(frozen=True)
class Levelled:
    """Runs at equal driving.

    Attributes:
        runs: ``run``, ``level`` [m/s]: the geometric mean slip modulus over all bins, as if the run had
            driven each; ``bins``: how many it did drive.
        bins: the bins that count, as from `measure_bins`.
        apart: runs that share no driving with the others, and have no level.
        errors: covariance of the errors of the logarithms of the levels, in the order of `runs`, shape (n,
            n).
    """

    runs: pl.DataFrame
    bins: pl.DataFrame
    apart: tuple[str, ...]
    errors: Floats

    def find_errors(self, runs: Sequence[str]) -> Floats:
        """Covariance of the errors of these runs, in their order."""
        own = self.runs["run"].to_list()
        chosen = [own.index(run) for run in runs]
        errors: Floats = self.errors[np.ix_(chosen, chosen)]
        return errors


def level_runs(bins: pl.DataFrame) -> Levelled:
    """Fit levels of runs and of bins to the logarithms of the bins' medians, by least squares.

    A bin counts if three runs drove it, and each counts alike, however long. Of runs that no chain of shared
    bins connects, the largest set has levels.

    Args:
        bins: as from `measure_bins`, of one input.
    """
    axes = ["speed", "turn"]
    counted = bins.filter(pl.len().over(axes) >= FEWEST_OF_SPREAD)
    counted = _keep_connected(counted)
    apart = tuple(sorted(set(bins["run"]) - set(counted["run"])))
    names = sorted(set(counted["run"]))
    combinations = counted.select(axes).unique().sort(axes)
    keyed = counted.join(combinations.with_row_index("column"), on=axes, maintain_order="left")
    design = np.zeros((keyed.height, len(names) + combinations.height))
    rows = np.arange(keyed.height)
    design[rows, [names.index(run) for run in keyed["run"]]] = 1.0
    design[rows, len(names) + keyed["column"].to_numpy().astype(np.int64)] = 1.0
    moduli = np.log(keyed["modulus"].to_numpy())
    # Where the effects of bins add up to nothing, the effect of a run is its level.
    sums = np.r_[np.zeros(len(names)), np.ones(combinations.height)]
    made_of = np.linalg.solve(design.T @ design + np.outer(sums, sums), design.T)
    effects = made_of @ moduli
    levels = made_of[: len(names)]
    runs = pl.DataFrame(
        {"run": names, "level": np.exp(effects[: len(names)])},
        schema={"run": pl.String, "level": pl.Float64},
    ).join(counted.group_by("run").agg(pl.len().cast(pl.Int64).alias("bins")), on="run")
    # Of connected runs and bins one effect follows from the others.
    freedom = max(keyed.height - (len(names) + combinations.height - 1), 0)
    variance = float(np.sum((moduli - design @ effects) ** 2)) / freedom if freedom else 0.0
    return Levelled(runs.sort("run"), counted, apart, variance * (levels @ levels.T))


def _keep_connected(bins: pl.DataFrame) -> pl.DataFrame:
    """Rows of the largest set of runs that shared bins connect."""
    rest, best = bins, bins.clear()
    while not rest.is_empty():
        part = rest.head(1)
        while True:
            grown = rest.join(rest.join(part, on="run", how="semi"), on=["speed", "turn"], how="semi")
            if grown.height == part.height:
                break
            part = grown
        if part["run"].n_unique() > (best["run"].n_unique() if best.height else 0):
            best = part
        rest = rest.join(part, on=["run", "speed", "turn"], how="anti")
    return best


@dataclass(frozen=True)
class Overlap:
    """Driving that two groups of runs have in common.

    Attributes:
        bins: number of bins that both drove.
        share: share of the samples in them, of the group that has less of its samples there.
    """

    bins: int
    share: float


def find_overlap(bins: pl.DataFrame, a: Collection[str], b: Collection[str]) -> Overlap:
    """The driving that two groups of runs have in common.

    Args:
        bins: bins of runs, of one input.
        a: runs of one group.
        b: runs of the other.
    """
    sides = [
        bins.filter(pl.col("run").is_in(list(runs))).group_by("speed", "turn").agg(pl.col("samples").sum())
        for runs in (a, b)
    ]
    both = sides[0].join(sides[1], on=["speed", "turn"], suffix="_b")
    if both.is_empty():
        return Overlap(0, 0.0)
    shares = [
        float(both[name].sum()) / float(side["samples"].sum())
        for name, side in zip(("samples", "samples_b"), sides, strict=True)
    ]
    return Overlap(both.height, min(shares))
