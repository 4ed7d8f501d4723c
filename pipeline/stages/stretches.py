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
_FEWEST = 8
_LEAST_PATH = 0.5
_LEAST_GAIN = 0.2
_LEAST_TURN = 0.05
_FROZEN = 0.1
_SHORTEST, _LONGEST = 0.6, 1.5
_OFF_ANGLE = np.radians(35.0)
_STEADY = 0.93


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
    sums = _sum_stretches(label, velocities, ideal, times)
    length, driven = sums.length, sums.driven
    tested = sums.whole & (driven > _LEAST_PATH)
    if tested.sum() < _FEWEST:
        return np.zeros(times.size, dtype=bool), []
    gain = float(np.median(length[tested] / driven[tested]))
    if gain < _LEAST_GAIN:
        return np.zeros(times.size, dtype=bool), []
    # Lateral motion in turns is what slip is about: the direction is judged against what turning explains.
    usual = _fit_angle(sums.turned[tested], sums.direction[tested])
    off = np.abs(_wrap(sums.direction - usual(sums.turned)))
    right_length = (length > _SHORTEST * gain * driven) & (length < _LONGEST * gain * driven)
    # A sliding vehicle turns its direction of travel on the way; a wrong heading is wrong by one angle.
    rotated = tested & (off > _OFF_ANGLE) & (sums.steadiness > _STEADY) & right_length
    lively = np.abs(sums.turned) > _LEAST_TURN
    frozen = tested & lively & (length < _FROZEN * gain * driven)
    bad = rotated | frozen
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


@dataclass(frozen=True)
class _Sums:
    """Sums over every stretch.

    Attributes:
        length: path of the poses [m].
        driven: path that the ideal model drives [m].
        direction: mean direction of travel against the driven direction [rad].
        steadiness: 1 where that direction is the same throughout, 0 where it is any.
        turned: turning of the poses [rad].
        whole: the input is known throughout and the stretch is full.
    """

    length: Floats
    driven: Floats
    direction: Floats
    steadiness: Floats
    turned: Floats
    whole: Flags


def _sum_stretches(label: NDArray[np.int64], velocities: pl.DataFrame, ideal: Floats, times: Floats) -> _Sums:
    """Path, direction and turning of every stretch."""
    count = int(label[-1]) + 1
    period = float(np.median(np.diff(times))) if times.size > 1 else 0.0
    samples = np.bincount(label, minlength=count)
    known = np.isfinite(ideal).all(axis=1)
    forward = np.where(known, ideal[:, 0], 0.0)
    speed = velocities["v_x"].to_numpy() + 1j * velocities["v_y"].to_numpy()
    # Weighed by the way travelled: at a stop or a reversal the direction is that of noise.
    travelled = speed * np.sign(forward) * period
    length = _sum_by(label, np.abs(speed) * period, count)
    mean = _sum_by(label, travelled.real, count) + 1j * _sum_by(label, travelled.imag, count)
    whole = (_sum_by(label, known.astype(float), count) == samples) & (samples * period > 0.9 * STRETCH_S)
    return _Sums(
        length=length,
        driven=_sum_by(label, np.abs(forward) * period, count),
        direction=np.angle(mean),
        steadiness=np.abs(mean) / np.maximum(length, 1e-9),
        turned=_sum_by(label, velocities["v_w"].to_numpy() * period, count),
        whole=whole,
    )


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
