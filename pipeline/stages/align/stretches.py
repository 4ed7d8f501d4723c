"""Bad stretches: a second or two in which the localization reports something no vehicle does.

A heading that is off by a constant angle (the direction of travel is wrong while its length is right), a
position that is frozen while the heading lives, or a way that is far too long although the drive has been
steady: a localization that had lost the vehicle and catches up (far too short it may be: wheels do spin).
Stretches of two seconds from each command step's start, and of one second throughout, are tested against a
robust model of the whole run; what fails is marked, shown, and left out of medians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Complex, Flags, Floats, Ints
from pipeline.stages.finding import Finding

if TYPE_CHECKING:
    from collections.abc import Mapping

    import polars as pl


_FEWEST = 8
_LEAST_PATH = 0.5
_LEAST_GAIN = 0.2
_LEAST_TURN = 0.05
_FROZEN = 0.1
_SHORTEST, _LONGEST = 0.6, 1.5
_FAR_LONGER = 1.7
_SPREADS = 6.0
_STEADY_DRIVE = 0.15
_STEADY = 0.93


@dataclass(frozen=True)
class _Cut:
    """How a run is cut into stretches: length [s], beginning, and how far off a heading is wrong."""

    span: float
    phase: float | None
    off_angle: float


# Two seconds are the windows in which recordings are known to turn; shorter stretches must be further off.
_CUTS = (
    _Cut(2.0, None, np.radians(35.0)),
    _Cut(1.0, 0.0, np.radians(50.0)),
    _Cut(1.0, 0.5, np.radians(50.0)),
)


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
    faults = {name: np.zeros(times.size, dtype=bool) for name in ("rotated", "frozen", "lost")}
    if ideal is None:
        return faults["rotated"], []
    tested = np.zeros(times.size, dtype=bool)
    for cut in _CUTS:
        label = _label_stretches(times, velocities["segment"].to_numpy(), step, cut)
        judged = _judge(label, velocities, ideal, times, cut)
        if judged is None:
            continue
        tested |= judged.pop("tested")
        for name, flags in judged.items():
            faults[name] |= flags
    suspect = faults["rotated"] | faults["frozen"] | faults["lost"]
    if not suspect.any():
        return suspect, []
    return suspect, [_describe(times, faults, suspect, tested)]


def _describe(times: Floats, faults: Mapping[str, Flags], suspect: Flags, tested: Flags) -> Finding:
    share = float(suspect.sum() / max(int(tested.sum()), 1))
    period = float(np.median(np.diff(times)))
    seconds = {name: float(flags.sum()) * period for name, flags in faults.items()}
    text = (
        f"{suspect.sum() * period:.3g} s ({share:.1%}) have a rotated heading ({seconds['rotated']:.3g} s), "
        f"a frozen position ({seconds['frozen']:.3g} s) or one that catches up ({seconds['lost']:.3g} s): "
        "left out of medians"
    )
    count = int((np.diff(suspect.astype(np.int8), prepend=0) > 0).sum())
    first = float(times[np.flatnonzero(suspect)[0]])
    return Finding("bad_stretch", "warning", text, where="pose", t_start=first, value=share, count=count)


def _judge(
    label: Ints, velocities: pl.DataFrame, ideal: Floats, times: Floats, cut: _Cut
) -> dict[str, Flags] | None:
    """Faults of the samples of every stretch; None where too few stretches tell what is usual."""
    sums = _sum_stretches(label, velocities, ideal, times, cut.span)
    length, driven = sums.length, sums.driven
    tested = sums.whole & (driven > _LEAST_PATH)
    if tested.sum() < _FEWEST:
        return None
    gain = float(np.median(length[tested] / driven[tested]))
    if gain < _LEAST_GAIN:
        return None
    # Lateral motion in turns is what slip is about: the direction is judged against what turning explains.
    slope, offset = _fit_angle(sums.turned[tested], sums.direction[tested])
    off = np.abs(_wrap(sums.direction - (slope * sums.turned + offset)))
    ratio = length / np.maximum(gain * driven, 1e-9)
    right_length = (ratio > _SHORTEST) & (ratio < _LONGEST)
    # A sliding vehicle turns its direction of travel on the way; a wrong heading is wrong by one angle.
    rotated = tested & (off > cut.off_angle) & (sums.steadiness > _STEADY) & right_length
    frozen = tested & (np.abs(sums.turned) > _LEAST_TURN) & (ratio < _FROZEN)
    settled = tested & sums.settled
    size = np.abs(np.log(np.maximum(ratio, 1e-6)))
    spread = 1.4826 * float(np.median(size[settled])) if settled.sum() >= _FEWEST else np.inf
    lost = settled & (ratio > _FAR_LONGER) & (size > _SPREADS * spread)
    found = {"rotated": rotated, "frozen": frozen, "lost": lost & ~frozen & ~rotated, "tested": tested}
    return {name: flags[label] for name, flags in found.items()}


def _label_stretches(times: Floats, segment: NDArray[np.int32], step: NDArray[np.int32], cut: _Cut) -> Ints:
    """Number of the stretch of each sample, counted from its step's start, or through its segment."""
    whole = step if cut.phase is None else segment
    starts = np.concatenate(([True], np.diff(whole) != 0))
    first = times[starts][np.cumsum(starts) - 1]
    place = np.floor((times - first + (cut.phase or 0.0)) / cut.span + 1e-6).astype(np.int64)
    edges = starts | np.concatenate(([True], np.diff(place) != 0))
    return np.cumsum(edges) - 1


@dataclass(frozen=True)
class _Sums:
    """Sums over every stretch.

    Attributes:
        length: path of the poses [m].
        driven: path that the ideal model drives [m].
        direction: mean direction of travel against the driven direction [rad].
        steadiness: 1 where that direction is the same throughout, 0 where it is any.
        turned: turning of the poses [rad].
        settled: the drive was steady in this stretch and in the one before.
        whole: the input is known throughout and the stretch is full.
    """

    length: Floats
    driven: Floats
    direction: Floats
    steadiness: Floats
    turned: Floats
    settled: Flags
    whole: Flags


def _sum_stretches(label: Ints, velocities: pl.DataFrame, ideal: Floats, times: Floats, span: float) -> _Sums:
    """Path, direction and turning of every stretch."""
    count = int(label[-1]) + 1
    period = float(np.median(np.diff(times))) if times.size > 1 else 0.0
    samples = np.bincount(label, minlength=count)
    known = np.isfinite(ideal).all(axis=1)
    asked = np.where(known, ideal[:, 0] + 1j * ideal[:, 1], 0.0)
    speed = velocities["v_x"].to_numpy() + 1j * velocities["v_y"].to_numpy()
    # Weighed by the way travelled: at a stop or a reversal the direction is that of noise.
    travelled = speed * _find_direction(asked).conj() * period
    length = _sum_by(label, np.abs(speed) * period, count)
    mean = _sum_vectors_by(label, travelled, count)
    whole = (_sum_by(label, known.astype(float), count) == samples) & (samples * period > 0.9 * span)
    return _Sums(
        length=length,
        driven=_sum_by(label, np.abs(asked) * period, count),
        direction=np.angle(mean),
        steadiness=np.abs(mean) / np.maximum(length, 1e-9),
        turned=_sum_by(label, velocities["v_w"].to_numpy() * period, count),
        settled=_is_settled(label, asked, samples, times),
        whole=whole,
    )


def _find_direction(asked: Complex) -> Complex:
    """Unit vectors along some vectors, zero where they are."""
    size = np.abs(asked)
    return asked / np.where(size > 0.0, size, 1.0)


def _is_settled(label: Ints, asked: Complex, samples: Ints, times: Floats) -> Flags:
    """Whether the drive hardly changed in a stretch and in the one right before it."""
    count = samples.size
    mean = _sum_vectors_by(label, asked, count) / np.maximum(samples, 1)
    square = _sum_by(label, np.abs(asked) ** 2, count) / np.maximum(samples, 1)
    even = np.sqrt(np.maximum(square - np.abs(mean) ** 2, 0.0)) < _STEADY_DRIVE * np.abs(mean)
    first = np.searchsorted(label, np.arange(count))
    last = np.append(first[1:], times.size) - 1
    joined = np.concatenate(([False], times[first[1:]] - times[last[:-1]] < 0.2))  # noqa: PLR2004 - no hole
    alike = np.concatenate(([False], np.abs(np.diff(mean)) < _STEADY_DRIVE * np.abs(mean[1:])))
    before = np.concatenate(([False], even[:-1]))
    settled: Flags = even & before & joined & alike
    return settled


def _sum_by(label: Ints, values: Floats, count: int) -> Floats:
    """Sums of values with equal labels."""
    return np.bincount(label, values, count).astype(np.float64)


def _sum_vectors_by(label: Ints, values: Complex, count: int) -> Complex:
    """Sums of vectors with equal labels."""
    return _sum_by(label, values.real, count) + 1j * _sum_by(label, values.imag, count)


def _fit_angle(turned: Floats, angle: Floats) -> tuple[float, float]:
    """Slope and offset of the usual direction of travel over the turning of a stretch.

    A robust line (iteratively reweighted, Cauchy weights).
    """
    slope = offset = 0.0
    weight = np.ones(angle.size)
    design = np.column_stack((turned, np.ones(angle.size)))
    for _ in range(20):
        (slope, offset), *_ = np.linalg.lstsq(design * weight[:, None], angle * weight, rcond=None)
        residual = angle - design @ np.array([slope, offset])
        scale = max(1.4826 * float(np.median(np.abs(residual))), 0.02)
        weight = np.sqrt(1.0 / (1.0 + (residual / (2.0 * scale)) ** 2))
    return float(slope), float(offset)


def _wrap(angle: Floats) -> Floats:
    return np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
