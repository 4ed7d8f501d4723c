"""What is left of slip after the best static model: the part that nobody could have foreseen."""

import itertools

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats

_BLOCK_S = 10.0
_FOLDS = 5
_RIDGE = 1e-9
_DIGITS = 9

_X, _W = pl.col("f_x"), pl.col("f_w")
_FEATURES: dict[str, dict[str, pl.Expr]] = {
    "x": {"radius": _X, "turning": _X * _W.abs(), "speed": _X * _X.abs()},
    "y": {"icr": _W, "skid": _X * _W, "drift": _X},
    "w": {"track": _W, "asymmetry": _X, "coupling": _X * _W},
}


def measure_unpredictability(slip: pl.LazyFrame) -> pl.LazyFrame:
    """Root mean square slip that a fitted static slip model leaves, on data it has not seen [m/s].

    The model is linear in what the ideal model predicts: g_x in (f_x, f_x |f_w|, f_x |f_x|), g_y and g_w in
    (f_w, f_x f_w, f_x); it holds the slip laws of Seegmiller and Kelly (RSS 2014) and of DRIVE (Baril et al.
    2024) without memory. It is fitted to four fifths of a run and judged on the fifth, in blocks of 10 s, so
    delay, lag and inertia count as not foreseen: give it the measured wheels to leave the drivetrain out.

    Args:
        slip: table `slip` with ``length_scale`` [m] joined; one pass, only sums of products leave it.

    Returns:
        ``run``, ``input``, ``unpredictability``; null for runs of fewer than five blocks.
    """
    fold = ((pl.col("t") / _BLOCK_S).floor().cast(pl.Int64) % _FOLDS).alias("fold")
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
    whole = pl.col("fold").list.len() == _FOLDS
    judged = folds.filter(whole)
    if judged.is_empty():
        return judged.select("run", "input", pl.lit(None, pl.Float64).alias("unpredictability"))
    count = _stack(judged, "count")
    length = _stack(judged, "length_scale")[:, 0]
    total = np.zeros(judged.height)
    for channel, features in _FEATURES.items():
        scale = length**2 if channel == "w" else np.ones_like(length)
        total += scale * _leave_out(judged, channel, list(features)).sum(axis=1) / count.sum(axis=1)
    left = pl.Series("unpredictability", np.sqrt(np.maximum(total, 0.0)), dtype=pl.Float64)
    # Threads add their sums in no order: the last digits are theirs.
    return judged.select("run", "input", left.round_sig_figs(_DIGITS))


def _leave_out(folds: pl.DataFrame, channel: str, names: list[str]) -> Floats:
    """Squared error of every fold under the model of the others, shape (runs, folds)."""
    size = len(names)
    squares = _stack(folds, f"{channel}:")
    right = np.stack([_stack(folds, f"{channel}:{name}") for name in names], axis=-1)
    left = np.zeros((*squares.shape, size, size))
    for (i, one), (j, two) in itertools.combinations_with_replacement(enumerate(names), 2):
        left[..., i, j] = left[..., j, i] = _stack(folds, f"{channel}:{one}:{two}")
    others = left.sum(axis=1, keepdims=True) - left
    trace = np.trace(others, axis1=-2, axis2=-1)[..., None, None]
    others = others + (_RIDGE * trace + 1e-12) * np.eye(size)
    wanted = right.sum(axis=1, keepdims=True) - right
    weights = np.linalg.solve(others, wanted[..., None])[..., 0]
    explained = 2.0 * np.einsum("rfi,rfi->rf", weights, right)
    spent = np.einsum("rfi,rfij,rfj->rf", weights, left, weights)
    error: Floats = squares - explained + spent
    return error


def _stack(folds: pl.DataFrame, column: str) -> Floats:
    return np.array(folds[column].to_list(), dtype=np.float64)
