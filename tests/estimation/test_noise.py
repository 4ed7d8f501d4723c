"""Noise of increments: a disturbance and white pose noise, of which innovations are free, also at gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.estimation.noise import Noise, Steps, huber_cost, learn_noise

CHANNELS = (0, 1, 2)
STEP_S = 0.2
CORRELATION, SHARE = np.array([0.3, 0.6, 0.85]), np.array([0.7, 0.4, 0.15])
SCALE = np.array([0.02, 0.01, 0.005])


def make_steps(count: int, *, gaps: tuple[int, ...] = (), runs: int = 1, uneven: bool = False) -> Steps:
    """Steps of a fifth of a second, of equal runs; uneven ones vary by a factor of four."""
    draw = np.random.default_rng(17)
    spans = STEP_S * (draw.uniform(0.5, 2.0, count) if uneven else np.ones(count))
    run = np.repeat(np.arange(runs), count // runs)
    fresh = np.append(True, run[1:] != run[:-1])
    fresh[list(gaps)] = True
    return Steps(spans, fresh, run)


def draw_increments(noise: Noise, steps: Steps, seed: int) -> np.ndarray:
    """d_k = a_k + n_k - n_(k-1) as the module has it, drawn anew after a gap, shape (n, 3)."""
    draw, count = np.random.default_rng(seed), steps.spans.size
    spread = np.sqrt([noise.share, 1.0 - noise.share])
    lasting, white = draw.normal(size=(2, count, 3)) * spread[:, None, :]
    before = np.empty((count, 3))
    before[0], before[1:] = spread[1] * draw.normal(size=3), white[:-1]
    before[steps.fresh] = spread[1] * draw.normal(size=(int(steps.fresh.sum()), 3))
    for step in np.flatnonzero(~steps.fresh).tolist():
        # Disturbance from the middle of the step before: with the time that it took.
        keep = noise.correlation ** (steps.spans[step - 1] / noise.step_s)
        lasting[step] = keep * lasting[step - 1] + np.sqrt(1.0 - keep**2) * lasting[step]
    return (lasting + white - before) * noise.scale[steps.run]


def make_noise(runs: int = 1) -> Noise:
    return Noise(STEP_S, CORRELATION, SHARE, np.tile(SCALE, (runs, 1)))


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
def test_innovations_are_white_and_of_variance_one_also_across_gaps_and_uneven_steps(*, uneven: bool) -> None:
    count, noise = 6000, make_noise()
    gaps = tuple(range(40, count, 40))
    steps = make_steps(count, gaps=gaps, uneven=uneven)
    white = noise.whiten(draw_increments(noise, steps, 1)[:, :, None], steps)[:, :, 0]
    assert white.var(axis=0) == pytest.approx(1.0, abs=0.07)
    for lag in (1, 2, 5):
        assert np.abs(np.mean(white[lag:] * white[:-lag], axis=0)).max() < 4.5 / np.sqrt(count)
    # Those after a gap, of which there are 150, are no exception.
    assert white[steps.fresh].var(axis=0) == pytest.approx(1.0, abs=0.4)
    assert white[1:][steps.fresh[:-1]].var(axis=0) == pytest.approx(1.0, abs=0.4)


def test_the_numbers_are_those_that_were_drawn() -> None:
    noise, steps = make_noise(), make_steps(8000, gaps=tuple(range(100, 8000, 100)))
    learned = learn_noise(draw_increments(noise, steps, 2), steps, CHANNELS)
    assert learned.step_s == STEP_S
    assert learned.correlation == pytest.approx(CORRELATION, abs=0.06)
    assert learned.share == pytest.approx(SHARE, abs=0.06)
    assert learned.scale[0] == pytest.approx(SCALE, rel=0.04)
    # A start near by ends at the same.
    again = learn_noise(draw_increments(noise, steps, 2), steps, CHANNELS, learned)
    assert again.share == pytest.approx(learned.share, abs=0.02)


def test_columns_and_residual_pass_through_one_filter() -> None:
    noise, steps = make_noise(), make_steps(300, gaps=(70, 200), uneven=True)
    residual, column = np.random.default_rng(3).normal(size=(2, 300, 3))
    both = noise.whiten((residual + 0.5 * column)[:, :, None], steps)[:, :, 0]
    apart = noise.whiten(np.stack((residual, column), axis=2), steps)
    assert np.allclose(both, apart @ [1.0, 0.5])


def test_nothing_is_predicted_across_a_gap() -> None:
    noise, steps = make_noise(), make_steps(300, gaps=(100,))
    residual = np.random.default_rng(4).normal(size=(300, 3, 1))
    other = residual.copy()
    other[:100] += 100.0
    one, two = (noise.whiten(values, steps) for values in (residual, other))
    assert np.array_equal(one[100:], two[100:])
    assert not np.allclose(one[:100], two[:100])


def test_a_fast_run_has_a_scale_of_its_own() -> None:
    noise, steps = make_noise(2), make_steps(4000, runs=2)
    noise = replace(noise, scale=noise.scale * [[1.0], [4.0]])
    residual = draw_increments(noise, steps, 5)
    learned = learn_noise(residual, steps, CHANNELS)
    assert learned.scale[1] / learned.scale[0] == pytest.approx(4.0, rel=0.1)
    white = learned.whiten(residual[:, :, None], steps)[:, :, 0]
    for run in (0, 1):
        assert white[steps.run == run].var(axis=0) == pytest.approx(1.0, abs=0.1)


def test_a_channel_that_says_nothing_counts_nothing() -> None:
    noise, steps = make_noise(), make_steps(600)
    residual = draw_increments(noise, steps, 6)
    residual[:, 1] = 0.0
    for channels in ((0, 2), CHANNELS):
        learned = learn_noise(residual, steps, channels)
        assert learned.known == [0, 2]
        assert not learned.whiten(residual[:, :, None], steps)[:, 1].any()
        assert np.isfinite(learned.log_variance(steps))
        assert learned.spread[1] == 0.0


def test_outliers_weigh_by_their_size_and_not_by_its_square() -> None:
    noise, steps = make_noise(), make_steps(2000)
    residual = draw_increments(noise, steps, 7)
    spoiled = residual.copy()
    spoiled[::100] += 20.0 * SCALE
    clean, other = (learn_noise(one, steps, CHANNELS) for one in (residual, spoiled))
    grown, as_squares = other.scale / clean.scale - 1.0, spoiled.std(axis=0) / residual.std(axis=0) - 1.0
    assert (as_squares > 0.75).all()
    assert (grown < 0.6 * as_squares).all()
    # Beyond three standard deviations a cost grows linearly.
    sizes = np.array([1.0, -3.0, 10.0, 20.0])
    assert huber_cost(sizes).tolist() == [1.0, 9.0, 51.0, 111.0]


def test_no_disturbance_lasts_longer_than_noise_does() -> None:
    """What drifts for a minute is an effect or the ground, and would be hidden by noise that explains it."""
    steps = make_steps(3000)
    drift = np.sin(np.arange(3000) * STEP_S / 20.0)[:, None] * SCALE
    learned = learn_noise(
        drift + 0.1 * SCALE * np.random.default_rng(8).normal(size=(3000, 3)), steps, CHANNELS
    )
    times = -STEP_S / np.log(learned.correlation)
    assert times.max() <= 2.0 * (1.0 + 1e-6)


def test_noise_of_one_kind_alone_is_found_at_its_bound_and_left_again() -> None:
    steps = make_steps(4000)
    lasting = Noise(STEP_S, np.full(3, 0.4), np.ones(3), SCALE[None])
    white = Noise(STEP_S, np.full(3, 0.4), np.zeros(3), SCALE[None])
    draws = {1.0: draw_increments(lasting, steps, 5), 0.0: draw_increments(white, steps, 6)}
    learned = {share: learn_noise(drawn, steps, CHANNELS) for share, drawn in draws.items()}
    for share, noise in learned.items():
        assert noise.share == pytest.approx(share, abs=0.03)
        # From the other bound, where the likelihood is level, too.
        again = learn_noise(draws[share], steps, CHANNELS, learned[1.0 - share])
        assert again.share == pytest.approx(noise.share, abs=0.02)
