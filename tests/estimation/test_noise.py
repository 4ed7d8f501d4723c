"""Residuals are whitened by their own past, and nothing crosses a gap."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.estimation.evidence import ORDER, Tiles, learn_noise, tile_windows


def _tiles(count: int, *, gaps: tuple[int, ...] = ()) -> Tiles:
    places = np.arange(count)
    first = np.zeros(count, dtype=np.int64)
    for gap in gaps:
        first[gap:] = gap
    return Tiles(places, np.minimum(places - first, ORDER), places // 20)


def _filter(innovations: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    values = np.zeros_like(innovations)
    for place in range(innovations.size):
        past = [c * values[place - lag] for lag, c in enumerate(coefficients, start=1) if place >= lag]
        values[place] = innovations[place] + sum(past)
    return values


def test_innovations_of_an_autoregressive_residual_are_those_that_made_it() -> None:
    made = np.random.default_rng(1).normal(0.0, 0.3, (4000, 3))
    residual = np.column_stack([_filter(column, (0.9, -0.4, 0.2)) for column in made.T])
    noise = learn_noise(_tiles(4000), (0, 1, 2), residual)

    white = noise.whiten_residual(residual)
    assert white.std(axis=0) == pytest.approx(1.0, abs=0.05)
    for channel in range(3):
        assert np.corrcoef(white[50:, channel], made[50:, channel])[0, 1] > 0.995
        repeated = np.corrcoef(white[1:, channel], white[:-1, channel])[0, 1]
        assert abs(repeated) < 0.05


def test_nothing_is_predicted_across_a_gap() -> None:
    generator = np.random.default_rng(2)
    residual = np.column_stack([_filter(generator.normal(size=600), (0.95,)) for _ in range(3)])
    tiles = _tiles(600, gaps=(200, 400))
    noise = learn_noise(tiles, (0, 1, 2), residual)
    other = residual.copy()
    other[:200] += 100.0

    assert np.array_equal(noise.whiten_residual(residual)[200:], noise.whiten_residual(other)[200:])
    # What begins anew is as uncertain as all of it, not as little as what its past predicts.
    assert (noise.scale[:, 0] > 2.0 * noise.scale[:, ORDER]).all()


def test_columns_are_filtered_as_residuals_are() -> None:
    generator = np.random.default_rng(3)
    residual, column = generator.normal(size=(300, 3)), generator.normal(size=(300, 3))
    noise = learn_noise(_tiles(300), (0, 2), residual)

    both = noise.whiten((residual + 0.5 * column)[:, :, None])[:, :, 0]
    apart = noise.whiten(np.stack((residual, column), axis=2))
    assert np.allclose(both, apart[:, :, 0] + 0.5 * apart[:, :, 1])
    assert both.shape == (300, 2)


def test_outliers_do_not_make_the_noise() -> None:
    generator = np.random.default_rng(4)
    residual = generator.normal(0.0, 0.1, (1000, 3))
    spoiled = residual.copy()
    spoiled[::100] = 50.0
    clean, other = (learn_noise(_tiles(1000), (0, 1, 2), one) for one in (residual, spoiled))
    assert other.scale == pytest.approx(clean.scale, rel=0.35)


def test_tiles_cover_the_windows_of_all_runs_without_overlap() -> None:
    start = np.concatenate(
        (np.arange(0.0, 30.0, 0.25), np.arange(40.0, 60.0, 0.25), np.arange(0.0, 10.0, 0.1))
    )
    run = np.repeat([0, 1], [200, 100])
    part = SimpleNamespace(
        run=run, times=np.column_stack((start, start + 0.5)), unit=(start // 10).astype(int) + 100 * run
    )
    tiles = tile_windows(part)  # type: ignore[arg-type]
    times, runs = part.times[tiles.rows], run[tiles.rows]
    together = runs[1:] == runs[:-1]
    assert (times[1:, 0] - times[:-1, 1])[together].min() > -0.07
    assert tiles.rows.size == 60 + 40 + 20
    # The first after the hole of ten seconds, and the first of the second run, have no past.
    assert tiles.past[[0, 60, 100]].tolist() == [0, 0, 0]
    assert tiles.past[[1, 61, 101]].tolist() == [1, 1, 1]
    assert tiles.past.max() == ORDER
