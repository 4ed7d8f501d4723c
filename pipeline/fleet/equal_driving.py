"""Slip at equal driving: cells of what was commanded, and levels of runs over them.

A gentle run slips less on any ground. Samples are therefore sorted into cells of commanded speed and yaw
rate, and the logarithm of a cell's median slip modulus is the level of its run plus that of the cell. The
levels of runs then compare grounds as if all runs had driven all cells.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD
from pipeline.run.signals import MOVING_MPS

SPEED_EDGES = (0.5, 1.0, 1.5, 2.0, 3.0, 6.0, 12.0, 24.0)
"""Edges of the classes of commanded speed [m/s]: half a metre per second where field robots drive, twice the
last above; the last class is open."""
TURN_EDGES = (0.3, 0.8, 1.5, 2.5, 6.0)
"""Edges of the classes of commanded yaw rate [rad/s]; the last class is open."""
LEAST_SAMPLES = 100
"""Fewest samples of a run in a cell: 5 s at 20 Hz, several correlation times of slip (1 to 2.5 s)."""


def measure_cells(slip: pl.LazyFrame) -> pl.DataFrame:
    """Median slip modulus of every run in every cell of commanded speed and yaw rate.

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
        slip.filter(pl.col("input") == "command", (speed > MOVING_MPS) | (turn > MOVING_MPS))
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
        runs: ``run``, ``level`` [m/s]: the geometric mean slip modulus over all cells, as if the run had
            driven each; ``cells``: how many it did drive.
        cells: the cells that count, as from `measure_cells`.
        apart: runs that share no driving with the others, and have no level.
    """

    runs: pl.DataFrame
    cells: pl.DataFrame
    apart: tuple[str, ...]


def level_runs(cells: pl.DataFrame) -> Levelled:
    """Fit levels of runs and of cells to the logarithms of the cells' medians, by least squares.

    A cell counts if three runs drove it, and each counts alike, however long. Of runs that no chain of shared
    cells connects, the largest set has levels.

    Args:
        cells: as from `measure_cells`, of one input.
    """
    place = ["speed", "turn"]
    counted = cells.filter(pl.len().over(place) >= FEWEST_OF_SPREAD)
    counted = _keep_connected(counted)
    apart = tuple(sorted(set(cells["run"]) - set(counted["run"])))
    names = sorted(set(counted["run"]))
    places = counted.select(place).unique().sort(place)
    keyed = counted.join(places.with_row_index("place"), on=place, maintain_order="left")
    design = np.zeros((keyed.height, len(names) + places.height))
    rows = np.arange(keyed.height)
    design[rows, [names.index(run) for run in keyed["run"]]] = 1.0
    design[rows, len(names) + keyed["place"].to_numpy().astype(np.int64)] = 1.0
    effects = np.linalg.lstsq(design, np.log(keyed["modulus"].to_numpy()), rcond=None)[0]
    usual = effects[len(names) :].mean() if names else 0.0
    runs = pl.DataFrame(
        {"run": names, "level": np.exp(effects[: len(names)] + usual)},
        schema={"run": pl.String, "level": pl.Float64},
    ).join(counted.group_by("run").agg(pl.len().cast(pl.Int64).alias("cells")), on="run")
    return Levelled(runs.sort("run"), counted, apart)


def _keep_connected(cells: pl.DataFrame) -> pl.DataFrame:
    """Rows of the largest set of runs that shared cells connect."""
    left, best = cells, cells.clear()
    while not left.is_empty():
        part = left.head(1)
        while True:
            more = left.join(left.join(part, on="run", how="semi"), on=["speed", "turn"], how="semi")
            if more.height == part.height:
                break
            part = more
        if part["run"].n_unique() > (best["run"].n_unique() if best.height else 0):
            best = part
        left = left.join(part, on=["run", "speed", "turn"], how="anti")
    return best


@dataclass(frozen=True)
class Overlap:
    """Driving that two groups of runs have in common.

    Attributes:
        cells: number of cells that both drove.
        share: share of the samples in them, of the group that has less of its samples there.
    """

    cells: int
    share: float


def find_overlap(cells: pl.DataFrame, a: Collection[str], b: Collection[str]) -> Overlap:
    """The driving that two groups of runs have in common.

    Args:
        cells: cells of runs, of one input.
        a: runs of one group.
        b: runs of the other.
    """
    sides = [
        cells.filter(pl.col("run").is_in(list(runs))).group_by("speed", "turn").agg(pl.col("samples").sum())
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
