"""Bad stretches: two seconds in which the localization reports something no vehicle does.

A heading that is off by a constant angle (the direction of travel is wrong while its length is right), or a
position that is frozen while the heading lives. Each stretch of a command step is tested against a robust
model of the whole run; what fails is marked, shown, and left out of medians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.stages.finding import Finding

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

STRETCH_S = 2.0
_LEAST_PATH = 0.5
_FROZEN = 0.1
_LONG_ENOUGH = 0.5
_OFF_ANGLE = np.radians(35.0)
_SPREADS = 6.0


def find_bad_stretches(
    velocities: pl.DataFrame, ideals: Mapping[str, Floats], step: NDArray[np.int32]
) -> tuple[Flags, list[Finding]]:
    """Mark samples in bad stretches.

    Args:
        velocities: table `velocities`.
        ideals: ideal velocities by input, shape (n, 3), NaN where unknown; measured wheels are preferred.
        step: number of the command step of each sample, shape (n,).

    Returns:
        Flags of shape (n,), and one finding when there are any.
    """
    times = velocities["t"].to_numpy()
    ideal = ideals.get("measured", ideals.get("command"))
    if ideal is None:
        return np.zeros(times.size, dtype=bool), []
    label = _label_stretches(times, step)
    summed = _sum_stretches(label, velocities, ideal, times)
    driven, moved = summed.driven, summed.moved
    tested = summed.whole & (np.abs(driven) > _LEAST_PATH)
    if tested.sum() < 8:  # noqa: PLR2004 - too few stretches to know what is usual
        return np.zeros(times.size, dtype=bool), []
    length = np.linalg.norm(moved, axis=1)
    gain = float(np.median(length[tested] / np.abs(driven[tested])))
    if gain < 0.2:  # noqa: PLR2004 - a vehicle that hardly moves on its wheels has no direction to test
        return np.zeros(times.size, dtype=bool), []
    # Lateral motion in turns is what slip is about: the direction is judged against what turning explains.
    turning = summed.turned
    angle = np.arctan2(moved[:, 1] * np.sign(driven), moved[:, 0] * np.sign(driven))
    usual = _fit_angle(turning[tested], angle[tested])
    spread = 1.4826 * float(np.median(np.abs(angle[tested] - usual(turning[tested]))))
    off = np.abs(_wrap(angle - usual(turning))) > max(_OFF_ANGLE, _SPREADS * spread)
    rotated = tested & off & (length > _LONG_ENOUGH * gain * np.abs(driven))
    frozen = tested & (length < _FROZEN * gain * np.abs(driven))
    lively = np.abs(turning) > 0.05  # noqa: PLR2004 - rad over the stretch: the heading is being updated
    bad = rotated | (frozen & lively)
    suspect: Flags = bad[label]
    if not bad.any():
        return suspect, []
    share = float(bad.sum() / max(int(tested.sum()), 1))
    first = float(times[np.flatnonzero(suspect)[0]])
    text = (
        f"{int(bad.sum())} stretches of 2 s ({share:.1%}) have a rotated heading ({int(rotated.sum())}) or a "
        f"frozen position ({int((bad & ~rotated).sum())}): marked and left out of medians"
    )
    return suspect, [
        Finding(
            "bad_stretch", "warning", text, where="pose", t_start=first, value=share, count=int(bad.sum())
        )
    ]


def _label_stretches(times: Floats, step: NDArray[np.int32]) -> NDArray[np.int64]:
    """Number of the 2 s stretch of each sample, counted from each step's start."""
    first = np.searchsorted(step, np.arange(int(step[-1]) + 1))
    place = np.floor((times - times[first][step]) / STRETCH_S + 1e-6).astype(np.int64)
    starts = np.concatenate(([True], (np.diff(step) != 0) | (np.diff(place) != 0)))
    return np.cumsum(starts) - 1


def _sum_stretches(label: NDArray[np.int64], velocities: pl.DataFrame, ideal: Floats, times: Floats) -> _Sums:
    """Displacement, turning and driven path of every stretch, in its own mean heading frame."""
    count = int(label[-1]) + 1
    period = float(np.median(np.diff(times))) if times.size > 1 else 0.0
    samples = np.bincount(label, minlength=count)
    yaw = velocities["yaw"].to_numpy()
    turned = _sum_by(label, velocities["v_w"].to_numpy() * period, count)
    start = yaw[np.searchsorted(label, np.arange(count))]
    relative = yaw - start[label] - turned[label] / 2.0
    v_x, v_y = velocities["v_x"].to_numpy(), velocities["v_y"].to_numpy()
    cosine, sine = np.cos(relative), np.sin(relative)
    moved = np.stack(
        (
            _sum_by(label, (cosine * v_x - sine * v_y) * period, count),
            _sum_by(label, (sine * v_x + cosine * v_y) * period, count),
        ),
        axis=-1,
    )
    known = np.isfinite(ideal).all(axis=1)
    # Driven along the chord that the measured turning makes of the path.
    driven = _sum_by(label, np.where(known, ideal[:, 0] * cosine, 0.0) * period, count)
    whole = (_sum_by(label, known.astype(float), count) == samples) & (samples * period > 0.9 * STRETCH_S)
    return _Sums(moved, driven, turned, whole)


@dataclass(frozen=True)
class _Sums:
    """Displacement [m], driven path [m], turning [rad] of every stretch, and whether it is whole."""

    moved: Floats
    driven: Floats
    turned: Floats
    whole: Flags


def _sum_by(label: NDArray[np.int64], values: Floats, count: int) -> Floats:
    """Sums of values with equal labels."""
    return np.bincount(label, values, count).astype(np.float64)


class _AngleLine:
    """Usual direction of travel as a line over the turning of a stretch."""

    def __init__(self, slope: float, offset: float) -> None:
        self.slope = slope
        self.offset = offset

    def __call__(self, turned: Floats) -> Floats:
        return self.slope * turned + self.offset


def _fit_angle(turned: Floats, angle: Floats) -> _AngleLine:
    """Robust line (iteratively reweighted, Cauchy weights)."""
    slope = offset = 0.0
    weight = np.ones(angle.size)
    design = np.column_stack((turned, np.ones(angle.size)))
    for _ in range(20):
        (slope, offset), *_ = np.linalg.lstsq(design * weight[:, None], angle * weight, rcond=None)
        residual = angle - design @ np.array([slope, offset])
        scale = max(1.4826 * float(np.median(np.abs(residual))), 0.02)
        weight = np.sqrt(1.0 / (1.0 + (residual / (2.0 * scale)) ** 2))
    return _AngleLine(float(slope), float(offset))


def _wrap(angle: Floats) -> Floats:
    wrapped: Floats = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    return wrapped
