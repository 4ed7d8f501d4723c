"""How large an effect must be to be seen: out of the noise, and worth a name."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from pipeline.core.arrays import Floats
from pipeline.estimation.acceptance import (
    LEAST_GAIN,
    LEAST_T,
    find_innovations,
    measure_evidence,
    scale_evidence,
)
from pipeline.estimation.ambiguity import DETECTED, DETECTED_SHARE, _find_detectable
from pipeline.estimation.evidence import Noise, Tiles
from pipeline.models import find_effect


@pytest.mark.parametrize(
    ("standard_errors", "share", "size"),
    [
        (10.0 * DETECTED, 1.0, 0.01),
        (2.0 * DETECTED, 1.0, 0.05),
        (10.0 * DETECTED, 4.0 * LEAST_GAIN, 0.05),
        (10.0 * DETECTED, 0.25 * LEAST_GAIN, 0.2),
    ],
)
def test_what_takes_less_of_the_loss_than_a_name_must_is_not_said_to_be_seen(
    standard_errors: float, share: float, size: float
) -> None:
    usual = find_effect("lateral_skid")(c=0.1)
    (found,) = _find_detectable(usual, standard_errors, share)
    least = usual.parameters[0].least
    assert found.size == pytest.approx(max(size, least.size if least else 0.0))


def test_the_stated_share_is_that_of_logs_in_which_the_size_is_named() -> None:
    """An estimate of unit error about that size is significant in so many of a hundred logs."""
    assert round(100.0 * NormalDist().cdf(DETECTED - LEAST_T)) == DETECTED_SHARE


def _make_noise(count: int) -> Noise:
    """White noise of unit size, of tiles that are all windows."""
    rows = np.arange(count)
    tiles = Tiles(rows, np.zeros(count, dtype=np.int64), rows // 20)
    return Noise(tiles, (0, 1, 2), ((np.zeros(0),),) * 3, np.ones((3, 1)))


@pytest.mark.parametrize("alike", [1, 4])
def test_a_size_counts_in_the_standard_errors_that_a_name_is_asked_in(alike: int) -> None:
    """Where the innovations that answer an effect come in fours, both see half as much."""
    draw, count, sizes = np.random.default_rng(2), 800, list[tuple[float, float]]()
    for _ in range(20):
        residual: Floats = np.repeat(draw.normal(size=(count // alike, 3)), alike, axis=0)
        column: Floats = np.repeat(draw.normal(0.0, 0.3, (count // alike, 3)), alike, axis=0)
        # What the residual holds of it is no part of the size.
        residual -= column * np.sum(residual * column) / np.sum(column**2)
        noise = _make_noise(count)
        asked = float(measure_evidence(noise, residual + column, residual).sum())
        scaled = scale_evidence(*find_innovations(noise, residual), column)
        sizes.append((asked, float((scaled**2).sum())))
    asked_of, told = np.mean(sizes, axis=0).tolist()
    assert told == pytest.approx(asked_of, rel=0.05)
    assert told == pytest.approx(3.0 * count * 0.3**2 / alike, rel=0.2)
