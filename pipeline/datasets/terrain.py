"""Terrain map: expected slip by place over the runs that crossed it, and slip by number of passes.

A crossing is a stretch in which a run was in one cell of a square grid. A pass over a cell ends when the
vehicle is two cells away, so that a path along an edge counts once. Passes are counted within a run: changes
of the ground between two runs are unknown.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.core import CONFIDENCE, Flags, Floats, Ints, format_share, jackknife_deviation, student_quantile
from pipeline.run import MOVING_MPS

CELL_M = 2.0
"""Default side of a cell [m]: slip comes from velocities over 0.75 s, in which a vehicle at 2 m/s moves
1.5 m, and vehicles are 1 to 1.5 m long. Smaller cells would repeat their neighbours."""
SMALLEST_CELL_M, LARGEST_CELL_M = 0.25, 1000.0
"""Limits of the cell size [m]: poses do not resolve smaller cells; larger ones leave nothing to map."""
_FEWEST_SAMPLES = 5
"""Minimum samples of a crossing: a quarter of a second at 20 Hz; shorter ones cut a corner of a cell."""
_LEAST_SLIP = 1e-3
"""Lower limit of relative slip, which keeps its logarithm finite."""
_BLOCK_S = 30.0
"""Length of the stretches of the jackknife [s]. Neighbouring crossings are correlated by turns or speed for
seconds; `make bench NAME=terrain` counts false findings on drives over ground that does not change."""
_SHORT_S = 10.0
"""Length of the stretches for the comparison of single passes [s], which have few of the longer ones."""
_FEWEST_BLOCKS = 5
"""Minimum number of jackknife stretches: with fewer the quantile of Student's t is above 3."""
_FEWEST_REPEATED = 10
"""Minimum number of crossings of cells that were crossed before."""
SHARE_DIGITS = 3
"""Significant digits of a change per pass: with two, the bounds of a narrow interval look equal."""
_SECTORS = 4
"""Number of sectors of travel direction: uphill and downhill over one cell are two places."""
_COLLINEAR = 1e-6
"""Deviation within places below which speed, turning or time count as constant."""
_OWN_SHARE = 1e-3
"""Minimum share of the variance of the number of passes not explained by speed, turning and time: on laps of
equal length time is collinear with the passes, and the slope would be noise."""


@dataclass(frozen=True)
class Drive:
    """One run as input of the map, on its grid of times, shape (n,) each.

    Attributes:
        run, dataset, vehicle, terrain: names.
        frame: frame of the positions; runs of one frame share their cells.
        columns: ``t`` [s], ``x``, ``y`` [m] in the frame, ``heading`` [rad], ``ideal``, ``slip``, ``turn``
            [m/s]: magnitudes of the ideal velocity, of the slip and of the ideal turning at the rim;
            ``energy`` of the slip [J], ``lean`` [rad], ``power`` [W], NaN if unknown; ``transitory`` 0 or 1.
    """

    run: str
    dataset: str
    vehicle: str
    terrain: str
    frame: str
    columns: Mapping[str, Floats]


_LABELS = ("run", "dataset", "vehicle", "terrain", "frame")
_NUMBERS = ("t", "slip", "modulus", "speed", "turning", "transitory", "energy", "lean", "power")
_PLACE = ("run", "i", "j", "sector")
_CROSSING = {
    **dict.fromkeys(_LABELS, pl.String()),
    **dict.fromkeys(("i", "j", "sector", "passes"), pl.Int64()),
    **dict.fromkeys(_NUMBERS, pl.Float64()),
}


def list_crossings(drive: Drive, cell_m: float = CELL_M) -> pl.DataFrame:
    """List every pass of a run over every cell.

    Returns:
        One row per crossing: labels, cell ``i``, ``j``, ``sector`` of the direction of travel, previous
        ``passes`` over the cell, start time ``t`` [s], ``slip`` (median share of the ideal motion that did
        not become motion), medians of ``modulus`` [m/s], ``energy`` [J], ``lean`` [rad], ``power`` [W], and
        means of ``speed`` [m/s], ``turning`` (share of the ideal motion) and ``transitory``.
    """
    data = drive.columns
    indices = np.stack([np.floor(data[axis] / cell_m) for axis in "xy"], axis=1)
    known = np.isfinite(indices).all(axis=1) & (data["ideal"] > MOVING_MPS)
    rows = np.flatnonzero(known)
    indices = indices[rows].astype(np.int64)
    number = _number_passes(indices)
    labels = dict(
        zip(_LABELS, (drive.run, drive.dataset, drive.vehicle, drive.terrain, drive.frame), strict=True)
    )
    crossings: list[dict[str, object]] = []
    keys = np.column_stack((indices, number))
    unique, group = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    edges = np.flatnonzero(np.diff(group.ravel()[order], prepend=-1, append=-1))
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if last - first < _FEWEST_SAMPLES:
            continue
        i, j, passes = (int(value) for value in unique[group.ravel()[order[first]]])
        mine = {name: values[rows[order[first:last]]] for name, values in data.items()}
        crossings.append({**labels, "i": i, "j": j, "passes": passes, **_measure_crossing(mine)})
    table = pl.DataFrame(crossings, schema=_CROSSING, orient="row")
    # Corners of cells are no crossings: the remaining passes are renumbered.
    order_of = pl.col("passes").rank("ordinal").over("run", "i", "j").cast(pl.Int64) - 1
    return table.with_columns(order_of.alias("passes")).sort("run", "t", "i", "j")


def _number_passes(indices: Ints) -> Ints:
    """Number of passes over its cell before each sample, shape (n,)."""
    changes = np.flatnonzero(np.any(np.diff(indices, axis=0, prepend=indices[:1] + 1) != 0, axis=1))
    done: dict[tuple[int, int], int] = {}
    near: set[tuple[int, int]] = set()
    visits = np.zeros(changes.size, dtype=np.int64)
    for position, (i, j) in enumerate(indices[changes].tolist()):
        for other in [one for one in near if max(abs(one[0] - i), abs(one[1] - j)) > 1]:
            near.remove(other)
            done[other] += 1
        near.add((i, j))
        visits[position] = done.setdefault((i, j), 0)
    return np.repeat(visits, np.diff(changes, append=indices.shape[0]))


def _measure_crossing(mine: Mapping[str, Floats]) -> dict[str, object]:
    heading = math.atan2(float(np.sin(mine["heading"]).sum()), float(np.cos(mine["heading"]).sum()))
    return {
        "sector": int((heading / (2.0 * math.pi) + 0.5 / _SECTORS) * _SECTORS // 1) % _SECTORS,
        "t": float(mine["t"][0]),
        "slip": float(np.median(mine["slip"] / mine["ideal"])),
        "modulus": float(np.median(mine["slip"])),
        "speed": float(np.mean(mine["ideal"])),
        "turning": float(np.mean(mine["turn"] / mine["ideal"])),
        "transitory": float(np.mean(mine["transitory"])),
        **{name: _find_median(mine[name]) for name in ("energy", "lean", "power")},
    }


def _find_median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def sum_cells(crossings: pl.DataFrame, cell_m: float = CELL_M) -> pl.DataFrame:
    """Expected values in every cell that a vehicle crossed.

    Args:
        crossings: from `list_crossings`, of any number of runs.
        cell_m: side of a cell [m].

    Returns:
        One row per frame, vehicle and cell: its centre ``x``, ``y`` [m], ``passes``, ``runs``, medians over
        crossings of ``slip``, ``modulus``, ``energy``, ``lean`` and ``power``, quartiles ``slip_low`` and
        ``slip_high``, null for a single crossing.
    """
    several = pl.len() > 1
    label = [
        pl.when(pl.col(name).n_unique() == 1).then(pl.col(name).first()).otherwise(pl.lit("*")).alias(name)
        for name in ("dataset", "terrain")
    ]
    return (
        crossings.group_by("frame", "vehicle", "i", "j")
        .agg(
            *label,
            pl.len().cast(pl.Int64).alias("passes"),
            pl.col("run").n_unique().cast(pl.Int64).alias("runs"),
            *(pl.col(name).median() for name in ("slip", "modulus", "energy", "lean", "power")),
            pl.when(several).then(pl.col("slip").quantile(0.25, "linear")).alias("slip_low"),
            pl.when(several).then(pl.col("slip").quantile(0.75, "linear")).alias("slip_high"),
        )
        .with_columns(
            ((pl.col(index) + 0.5) * cell_m).alias(axis) for index, axis in (("i", "x"), ("j", "y"))
        )
        .sort("frame", "vehicle", "i", "j")
    )


@dataclass(frozen=True)
class PassEffect:
    """Dependence of slip on the number of passes over a place within a run.

    Attributes:
        dataset: dataset of the runs.
        change: relative change of slip per pass, negative for a decrease; NaN without an estimate.
        low, high: bounds of its interval.
        level: confidence level of the interval: 95 % jointly over all tested datasets.
        beside_time: interval of the change if a drift with the run's time is modelled as well; NaN
            if time and passes cannot be separated.
        crossings, repeated, places: crossings used, those of cells crossed before, and cells.
        most: maximum number of passes over a cell.
        reason: why there is no estimate; empty otherwise.
    """

    dataset: str
    change: float = math.nan
    low: float = math.nan
    high: float = math.nan
    level: float = CONFIDENCE
    beside_time: tuple[float, float] = (math.nan, math.nan)
    crossings: int = 0
    repeated: int = 0
    places: int = 0
    most: int = 0
    reason: str = ""

    @property
    def is_significant(self) -> bool:
        """Whether the interval excludes no change."""
        return self.low > 0.0 or self.high < 0.0

    def describe(self) -> str:
        """Describe the finding in one sentence."""
        if self.reason:
            return f"{self.dataset}: slip by number of passes is not estimated, {self.reason}"
        ends = f"[{format_share(self.low, SHARE_DIGITS)}, {format_share(self.high, SHARE_DIGITS)}]"
        counted = f"{self.repeated} repeated crossings of {self.places} places, up to {self.most} passes"
        if not self.is_significant:
            text = f"{self.dataset}: slip does not depend on the number of passes beyond chance"
            return f"{text} {ends} ({counted})"
        verb = "falls" if self.change < 0.0 else "grows"
        change = format_share(abs(self.change), SHARE_DIGITS)
        text = f"{self.dataset}: slip {verb} by {change} per pass {ends} ({counted})"
        low, high = self.beside_time
        if low > 0.0 or high < 0.0:
            return f"{text}, beside a drift with time, too"
        return f"{text}; a drift with time (battery, warmth) would look alike in these runs"


def measure_pass_effects(crossings: pl.DataFrame) -> list[PassEffect]:
    """Estimate the dependence of slip on the number of passes for every dataset.

    The model of a crossing's log slip has a level for each cell, direction of travel and run, and is linear
    in the previous passes, the logarithm of speed, the share of turning and of changes of command (fixed
    effects, within-group least squares). The interval is a delete-one jackknife over stretches of 30 s with
    Student's t; datasets share the probability of a false finding (Bonferroni).
    """
    groups = [(str(name), rows) for (name,), rows in crossings.group_by("dataset", maintain_order=True)]
    asked = [
        (name, rows.filter(pl.col("slip").is_finite(), pl.len().over(_PLACE) > 1))
        for name, rows in sorted(groups, key=lambda one: one[0])
    ]
    able = sum(not _find_lack(rows) for _, rows in asked)
    level = 1.0 - (1.0 - CONFIDENCE) / max(able, 1)
    return [_measure_passes(name, rows, level) for name, rows in asked]


def _find_lack(rows: pl.DataFrame) -> str:
    repeated = rows.height - rows.n_unique(_PLACE) if rows.height else 0
    if repeated < _FEWEST_REPEATED:
        return f"only {repeated} crossings repeat another one in place and direction"
    blocks = np.unique(_number_blocks(rows)).size
    return "" if blocks >= _FEWEST_BLOCKS else f"they lie within {blocks} stretches of {_BLOCK_S:g} s"


def _number_blocks(rows: pl.DataFrame, block_s: float = _BLOCK_S) -> Ints:
    runs = rows["run"].rank("dense").to_numpy().astype(np.int64)
    times = (rows["t"].to_numpy() / block_s).astype(np.int64)
    return np.unique(np.column_stack((runs, times)), axis=0, return_inverse=True)[1].ravel()


def _measure_passes(dataset: str, rows: pl.DataFrame, level: float) -> PassEffect:
    places = rows.n_unique(_PLACE) if rows.height else 0
    empty = PassEffect(dataset, crossings=rows.height, repeated=rows.height - places, places=places)
    lack = _find_lack(rows)
    if lack:
        return replace(empty, reason=lack)
    number = {
        name: rows[name].to_numpy().astype(np.float64)
        for name in ("passes", "speed", "turning", "transitory", "t", "slip")
    }
    group = rows.select(pl.struct(_PLACE).rank("dense")).to_series().to_numpy().astype(np.int64)
    beside = np.column_stack((np.log(number["speed"]), number["turning"], number["transitory"]))
    target = np.log(np.maximum(number["slip"], _LEAST_SLIP))
    blocks = _number_blocks(rows)
    slope = _bound_slope(group, number["passes"], beside, target, blocks, level)
    if math.isnan(slope[0]):
        return replace(empty, reason="passes go with speed or turning throughout")
    with_time = np.column_stack((beside, number["t"]))
    drifted = _bound_slope(group, number["passes"], with_time, target, blocks, level)
    change, low, high = map(math.expm1, slope)
    return replace(
        empty,
        change=change,
        low=low,
        high=high,
        level=level,
        beside_time=(math.expm1(drifted[1]), math.expm1(drifted[2])),
        most=int(number["passes"].max()) + 1,
    )


def _bound_slope(
    group: Ints, cause: Floats, beside: Floats, target: Floats, blocks: Ints, level: float
) -> tuple[float, float, float]:
    """Slope of a target over a cause within places, given other columns, and the bounds of its interval."""
    slope = _find_slope(group, cause, beside, target)
    masks: list[Flags] = [blocks != block for block in np.unique(blocks).tolist()]
    without = np.array([_find_slope(group[one], cause[one], beside[one], target[one]) for one in masks])
    if not (np.isfinite(slope) and np.isfinite(without).all()):
        return math.nan, math.nan, math.nan
    half = student_quantile(level, without.size - 1.0) * jackknife_deviation(without)
    return slope, slope - half, slope + half


def _find_slope(group: Ints, cause: Floats, beside: Floats, target: Floats) -> float:
    """Slope after partialling out the other columns (Frisch, Waugh and Lovell)."""
    numbers = np.unique(group, return_inverse=True)[1].ravel()
    counts = np.bincount(numbers)
    columns = np.column_stack((cause, target, beside))
    means = np.stack([np.bincount(numbers, column) / counts for column in columns.T], axis=1)
    within = columns - means[numbers]
    scale = np.sqrt((within**2).mean(axis=0))
    others = within[:, 2:][:, scale[2:] > _COLLINEAR]
    own = (
        within[:, :2] - others @ np.linalg.lstsq(others, within[:, :2], rcond=None)[0]
        if others.size
        else within[:, :2]
    )
    variance = float(own[:, 0] @ own[:, 0])
    if variance <= _OWN_SHARE * float(within[:, 0] @ within[:, 0]):
        return math.nan
    return float(own[:, 0] @ own[:, 1]) / variance


def compare_passes(crossings: pl.DataFrame) -> pl.DataFrame:
    """Slip of every further pass relative to the first one in the same place and direction.

    Returns:
        ``dataset``, previous ``passes``, ``ratio``, ``low``, ``high`` (95 %, jackknife over stretches of
        10 s; null with fewer than three), ``crossings``.
    """
    rows = crossings.with_columns(pl.col("slip").clip(lower_bound=_LEAST_SLIP).log().alias("log"))
    rows = rows.with_columns(pl.col("log").sort_by("passes").first().over(_PLACE).alias("first"))
    rows = rows.filter(pl.col("passes") > pl.col("passes").min().over(_PLACE))
    compared = []
    for (dataset, passes), mine in rows.group_by("dataset", "passes", maintain_order=True):
        apart = (mine["log"] - mine["first"]).to_numpy()
        blocks = np.unique(_number_blocks(mine, _SHORT_S), return_inverse=True)[1].ravel()
        counts = np.bincount(blocks).astype(np.float64)
        mean, half = float(apart.mean()), None
        if counts.size > 2:  # noqa: PLR2004 - two stretches hardly show a scatter
            without = (apart.sum() - np.bincount(blocks, apart)) / (apart.size - counts)
            half = student_quantile(CONFIDENCE, counts.size - 1.0) * jackknife_deviation(without)
        ends = (None, None) if half is None else (math.exp(mean - half), math.exp(mean + half))
        compared.append((dataset, passes, math.exp(mean), *ends, mine.height))
    schema = {
        "dataset": pl.String(),
        "passes": pl.Int64(),
        **dict.fromkeys(("ratio", "low", "high"), pl.Float64()),
        "crossings": pl.Int64(),
    }
    return pl.DataFrame(compared, schema=schema, orient="row").sort("dataset", "passes")


def name_frames(crossings: pl.DataFrame) -> Sequence[tuple[str, list[str]]]:
    """Frames with the runs in each, those with most runs first."""
    rows = crossings.group_by("frame").agg(pl.col("run").unique().sort())
    return sorted(rows.iter_rows(), key=lambda one: (-len(one[1]), one[0]))


@dataclass(frozen=True)
class TerrainMap:
    """Expected slip by place.

    Attributes:
        cell_table: table `cell_table` without its keys.
        effects: effects of the number of passes on slip, by dataset.
        passes: slip of every further pass relative to the first, see `compare_passes`.
        frames: runs of each frame, with the median distance between poses and fixes [m] of each run.
        origins: latitude and longitude [deg] of the origin of each frame that is on Earth.
        input: input of the ideal model.
        cell_m: side of a cell [m].
        crossings: number of crossings.
        keys: run/generation of every run included.
        notes: what was excluded, and what shares no frame.
    """

    cell_table: pl.DataFrame
    effects: tuple[PassEffect, ...]
    passes: pl.DataFrame
    frames: Mapping[str, Mapping[str, float]]
    origins: Mapping[str, tuple[float, float]]
    input: str
    cell_m: float
    crossings: int
    keys: tuple[str, ...]
    notes: tuple[str, ...]
