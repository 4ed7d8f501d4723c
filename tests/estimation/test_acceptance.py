"""The test of significance keeps its promise where noise repeats itself, varies, or steers the vehicle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from test_diagnosis_search import _load

from pipeline.core.compute import Budget
from pipeline.estimation import Input
from pipeline.estimation.acceptance import LEAST_T, Improvement, compare, compare_rivals
from pipeline.estimation.evidence import ORDER, Noise, Tiles, learn_noise
from pipeline.estimation.search import simplify
from pipeline.estimation.selection import open_selection, prepare
from pipeline.estimation.state import Weights
from pipeline.models import find_effect
from pipeline.simulate import VEHICLES, Encoders, Imu, Program, Scenario

if TYPE_CHECKING:
    from pathlib import Path

COUNT = 480  # four minutes of half-second windows


def make_tiles(count: int) -> Tiles:
    return Tiles(np.arange(count), np.minimum(np.arange(count), ORDER), np.arange(count) // 20)


def make_weights(count: int) -> Weights:
    return Weights(np.ones((count, 3)), np.full((count, 3), 6.0))


TILES = make_tiles(COUNT)
PLAIN = make_weights(COUNT)


def make_noise(generator: np.random.Generator, repeat: float, size: np.ndarray | float = 1.0) -> np.ndarray:
    values = (size * generator.normal(size=(COUNT, 3))).T
    for place in range(1, COUNT):
        values[:, place] += repeat * values[:, place - 1]
    return values.T


def judge(residual: np.ndarray, column: np.ndarray, noise: Noise | None = None) -> Improvement:
    """A column fitted by least squares to the innovations, and compared with nothing."""
    count = len(residual)
    noise = noise or learn_noise(make_tiles(count), (0, 1, 2), residual)
    white, filtered = noise.whiten(residual[:, :, None]), noise.whiten(column[:, :, None])
    gain = float((white * filtered).sum() / (filtered**2).sum())
    return compare(noise, make_weights(count), residual, residual - gain * column)


@pytest.mark.parametrize("repeat", [0.0, 0.6, 0.9])
def test_chance_alone_stays_within_its_standard_errors(repeat: float) -> None:
    found = []
    for seed in range(150):
        generator = np.random.default_rng(seed)
        slow = np.repeat(generator.normal(size=(COUNT // 12, 3)), 12, axis=0)
        found.append(judge(make_noise(generator, repeat), slow).t)
    assert np.mean(np.square(found)) == pytest.approx(1.0, abs=0.35)
    assert max(found) < LEAST_T


def test_none_of_thirty_candidates_is_significant_where_there_is_only_noise() -> None:
    reached = []
    for seed in range(60):
        generator = np.random.default_rng(seed)
        residual = make_noise(generator, 0.6)
        columns = np.repeat(generator.normal(size=(30, COUNT // 12, 3)), 12, axis=1)
        noise = learn_noise(TILES, (0, 1, 2), residual)
        reached += [judge(residual, column, noise).share for column in columns]
    assert max(reached) < 1.0


def test_what_hardly_changes_a_prediction_is_not_significant_however_long_the_drive() -> None:
    generator = np.random.default_rng(8)
    count = 5 * COUNT
    noise, column = generator.normal(size=(2, count, 3))
    small, enough = (judge(noise + size * column, column) for size in (0.085, 0.12))
    assert small.gain < 0.01 < enough.gain
    assert small.share > 1.0, "it is evident"
    assert not small.is_significant
    assert enough.is_significant


def test_noise_that_is_larger_where_the_column_acts_is_no_evidence() -> None:
    plain, found = [], []
    for seed in range(150):
        generator = np.random.default_rng(seed)
        turning = np.repeat(generator.random(COUNT // 20) < 0.2, 20)[:, None]
        residual = make_noise(generator, 0.3, np.where(turning, 4.0, 1.0))
        column = turning * np.repeat(generator.normal(size=(COUNT // 4, 3)), 4, axis=0)
        found.append(judge(residual, column).t)
        noise = learn_noise(TILES, (0, 1, 2), residual)
        white, filtered = (noise.whiten(one[:, :, None]).ravel() for one in (residual, column))
        plain.append(float(white @ filtered) ** 2 / float(filtered @ filtered))
    assert max(found) < LEAST_T < math.sqrt(max(plain))


def test_commands_that_answer_random_motion_explain_none_of_it() -> None:
    """A driver steers against drift: commands follow residuals, which last for seconds."""
    whitened, plain = [], []
    for seed in range(60):
        residual = make_noise(np.random.default_rng(seed), 0.9)
        command = np.zeros_like(residual)
        command[1:] = -np.sign(residual[:-1])
        whitened.append(judge(residual, command).t)
        step = float((residual * command).sum() / (command**2).sum())
        plain.append(1.0 - PLAIN.loss(residual - step * command) / PLAIN.loss(residual))
    assert np.median(plain) > 0.3
    assert max(whitened) < LEAST_T


def test_what_one_event_shows_is_not_significant() -> None:
    generator = np.random.default_rng(5)
    residual, column = make_noise(generator, 0.0), np.zeros((COUNT, 3))
    column[100:110] = 1.0
    once = judge(residual + 3.0 * column, column)
    assert once.t > 2.0 * LEAST_T
    assert not once.is_significant
    column[300:310] = 1.0
    assert judge(residual + 3.0 * column, column).is_significant


def test_more_numbers_and_more_shapes_cost_evidence() -> None:
    generator = np.random.default_rng(6)
    column = generator.normal(size=(COUNT, 3))
    residual = make_noise(generator, 0.0) + 0.3 * column
    noise = learn_noise(TILES, (0, 1, 2), residual)
    one, three, many = (
        compare(noise, PLAIN, residual, residual - 0.3 * column, **more)  # type: ignore[arg-type]
        for more in ({}, {"numbers": 3}, {"shapes": 1000})
    )
    assert one.t**2 - three.t**2 == pytest.approx(2.0)
    assert one.t**2 - many.t**2 == pytest.approx(2.0 * math.log(1000))
    assert one.gain == three.gain == many.gain > 0.0


def test_rivals_that_do_the_same_are_not_told_apart_and_others_are() -> None:
    generator = np.random.default_rng(7)
    column = generator.normal(size=(COUNT, 3))
    residual = make_noise(generator, 0.5)
    noise = learn_noise(TILES, (0, 1, 2), residual)
    alike = compare_rivals(
        noise, residual + 0.02 * column, residual + 0.02 * generator.normal(size=(COUNT, 3))
    )
    assert abs(alike) < 2.0
    assert compare_rivals(noise, residual + column, residual) > 5.0
    assert compare_rivals(noise, residual, residual + column) < -5.0


def test_a_limit_beside_a_lag_is_none_where_a_delay_that_sampling_can_cause_does_its_work(
    tmp_path: Path,
) -> None:
    drive = {"drive_lag": 0.06, "transport_delay": 0.009}
    encoders = Encoders(rate_hz=50.0, noise_radps=0.003)
    scenario = Scenario(
        VEHICLES["husky"],
        effects=drive,
        program=Program("teleop"),
        duration_s=60.0,
        encoders=encoders,
        imu=Imu(),
    )
    run, vehicle = _load(scenario, tmp_path / "husky")
    context = prepare([run], vehicle, Input.COMMAND)
    part, begin = context.problem.parts[1], context.problem.start_state()
    selection, ideal = open_selection(part, begin, context.list_drivetrain(), context.conditions, Budget())
    limits = (find_effect("torque_limit")(tau=0.05, limit=limit) for limit in (10.0, 40.0, 80.0))
    limited = min((selection.enter(ideal.state.add(one)) for one in limits), key=selection.loss)
    lag = selection.enter(ideal.state.add(find_effect("drive_lag")(tau=0.05)))
    # The limit follows what the delay leaves.
    assert selection.loss(limited) < 0.95 * selection.loss(lag)
    excluded = set[str]()
    assert simplify(selection, limited, excluded).ids == ("drive_lag",)
    assert excluded == {"torque_limit"}
