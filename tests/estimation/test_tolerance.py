"""From a tolerance to the highest speed: errors that grow as is known, and models wrong as is known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from few import few
from motion_runs import simulate, vehicle_of
from verbs import ask_verb, print_verb, run_verb

from pipeline.estimation.run_residuals import Input
from pipeline.estimation.tolerance import Answer, ErrorSamples, find_speed_limit, gather_samples, limit_speeds
from pipeline.models import Model, ModelFile, find_effect
from pipeline.run import MotionError
from pipeline.simulate import Disturbance, simulate_case
from pipeline.words.models import format_speed_limits

HUSKY = vehicle_of("husky_a200")
QUANTILE = math.sqrt(-2.0 * math.log(0.05))
"""95 % quantile of the length of a vector of two standard normal numbers (Rayleigh)."""


def draw(std: object, *, count: int = 1500, seed: int = 1) -> ErrorSamples:
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(0.2, 2.0, count // 5), 5) * rng.uniform(0.95, 1.05, count)
    x, y = rng.standard_normal((2, count)) * std(speed)  # type: ignore[operator]
    return ErrorSamples(speed, np.hypot(x, y), np.arange(count) // 5)


@pytest.mark.parametrize(
    ("std", "truth"),
    [
        (lambda v: 0.03 * v, 0.1 / (0.03 * QUANTILE)),
        (lambda v: 0.02 * v**2, math.sqrt(0.1 / (0.02 * QUANTILE))),
        (lambda v: np.hypot(0.015, 0.03 * v), math.sqrt((0.1 / QUANTILE) ** 2 - 0.015**2) / 0.03),
    ],
    ids=["as the speed", "as its square", "with noise of the localization"],
)
def test_the_speed_is_that_at_which_errors_of_known_growth_reach_the_tolerance(
    std: object, truth: float
) -> None:
    limits = [find_speed_limit(draw(std, seed=seed), 0.1) for seed in range(10)]
    assert {limit.answer for limit in limits} == {Answer.UP_TO}
    assert np.mean([limit.speed for limit in limits]) == pytest.approx(truth, rel=0.03)
    assert sum(limit.low <= truth <= limit.high for limit in limits) >= 8
    assert all(limit.within >= 0.93 for limit in limits)


def test_no_speed_is_given_where_none_meets_the_tolerance_or_all_do() -> None:
    none, every = (find_speed_limit(draw(lambda v, s=size: s + 0.0 * v), 0.1) for size in (0.1, 0.01))
    assert none.answer is Answer.NONE
    assert math.isnan(none.speed)
    assert none.error_slowest == pytest.approx(0.1 * QUANTILE, rel=0.1)
    assert every.answer is Answer.EVERY
    assert every.speed == every.fastest <= 2.1
    few = find_speed_limit(draw(lambda v: 0.03 * v, count=15), 0.1)
    assert (few.answer, few.predictions) == (Answer.TOO_FEW, 15)
    lines = format_speed_limits({"ice": none, "unknown": every, "sand": few}, 0.1, 2.0)
    assert lines[0].startswith(
        "within 10 cm at 2 s ahead: at no speed that was driven on ice: at the slowest"
    )
    assert "at every speed that was driven, up to 2 m/s" in lines[1]
    assert "unknown on sand: 15 predictions while driving, and 20 are needed" in lines[2]


@pytest.mark.parametrize("ahead_s", few([1.0, 2.0], 2))
def test_a_wrong_wheel_radius_gives_the_speed_of_its_share(ahead_s: float) -> None:
    """Nine tenths of the way are driven: the error is a tenth of it, so 10 cm are reached after 1 m."""
    run = simulate({"wheel_radius": 0.9}, duration_s=200.0, disturbance=Disturbance(0.0, 0.0))
    file = ModelFile(Model(HUSKY))
    tolerance = 0.05
    (limit,) = limit_speeds(file, [run], Input.COMMAND, tolerance, ahead_s).values()
    assert limit.answer is Answer.UP_TO
    # Noise of the poses takes a part of the tolerance, and who turns is nearer to where he was predicted.
    assert limit.speed == pytest.approx(tolerance / (0.1 * ahead_s), rel=0.15)
    right = ModelFile(Model(HUSKY, (find_effect("wheel_radius")(k=0.9),)))
    (limit,) = limit_speeds(right, [run], Input.COMMAND, tolerance, ahead_s).values()
    assert limit.answer is Answer.EVERY


def test_errors_on_a_run_of_the_fit_are_held_out() -> None:
    run = simulate({"wheel_radius": 0.9}, duration_s=120.0)
    model = Model(HUSKY, (find_effect("wheel_radius")(k=0.5),))
    kept = gather_samples(ModelFile(model), [run], Input.COMMAND)
    refitted = gather_samples(ModelFile(model, fit={"runs": [{"run": run.name}]}), [run], Input.COMMAND)
    assert np.median(refitted.error) < 0.2 * np.median(kept.error)


def test_a_tolerance_and_a_time_that_cannot_be_judged_are_refused() -> None:
    run = simulate({}, duration_s=60.0)
    with pytest.raises(MotionError, match="2 s ahead, not 3 s"):
        limit_speeds(ModelFile(Model(HUSKY)), [run], Input.COMMAND, 0.1, 3.0)
    with pytest.raises(MotionError, match="above zero"):
        limit_speeds(ModelFile(Model(HUSKY)), [run], Input.COMMAND, 0.0)


def test_the_verb_answers_for_each_terrain(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "run.mcap", duration_s=60.0)
    model = tmp_path / "ideal.toml"
    run_verb("model", "new", str(model), "--vehicle", "husky_a200")
    asked = ("model", "speed", str(model), "--on", str(log), "--results", str(tmp_path / "results"))
    assert "within 10 cm at 2 s ahead: up to 0." in print_verb(*asked, "--within", "10cm")
    content = ask_verb(*asked, "--within", "0.1m")
    (terrain,) = content["terrains"]
    assert (content["within_m"], content["ahead_s"], terrain["answer"]) == (0.1, 2.0, "up_to")
    assert terrain["slowest_mps"] <= terrain["low_mps"] <= terrain["speed_mps"] <= terrain["high_mps"]
    refused = run_verb(*asked, "--within", "10")
    assert refused.returncode == 1
    assert "Write 10cm or 0.1m" in refused.stderr
