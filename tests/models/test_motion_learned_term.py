"""A learned term beyond the named physics: kept where it helps, gone where its data end, and its bands."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of
from verbs import run_verb

from pipeline.estimation import EstimationData, Fitted, HeldOut, Input, RunResiduals, fit_model, hold_out
from pipeline.estimation.across_runs import Ratios, make_bands, measure_coverage
from pipeline.estimation.floor import estimate_floor
from pipeline.estimation.ladder import assess_model
from pipeline.estimation.learned_step import (
    ResidualData,
    learn_beyond,
    learn_fold,
    learn_where_it_helps,
    make_learned_step,
    regress,
    summarize_learned,
)
from pipeline.export import export_model
from pipeline.models import Model, ModelFile, Timing, find_effect, format_model
from pipeline.models.learned_term import INPUTS, Bands, LearnedInput, ResidualTerm
from pipeline.models.model_file import parse_model
from pipeline.run import MotionRun
from pipeline.simulate import simulate_case

HUSKY = vehicle_of("husky_a200")
HERE = Path("model.toml")
TRACK = {"effective_track": {"k": 1.8}}
SLOWED = {**TRACK, "turning_resistance": {"k": 0.25}}


def make_problem(truth: object, **more: object) -> EstimationData:
    return EstimationData([simulate(truth, duration_s=240.0, **more)], HUSKY, Input.MEASURED)  # type: ignore[arg-type]


def fit_track(data: EstimationData) -> tuple[Fitted, HeldOut]:
    fitted = fit_model(data, Model(HUSKY, (find_effect("effective_track")(),)), exact=True)
    return fitted, hold_out(data, fitted)


@pytest.fixture(scope="module")
def data() -> EstimationData:
    """A run of which the model lacks that turning slows the vehicle."""
    return make_problem(SLOWED)


@pytest.fixture(scope="module")
def complete() -> EstimationData:
    """A run that lacks nothing."""
    return make_problem(TRACK)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_case(
        "husky_tile", out=tmp_path_factory.mktemp("bare") / "tile.mcap", seed=1, duration_s=240.0
    )


def test_it_is_kept_where_the_physics_leaves_something_and_says_how_much(data: EstimationData) -> None:
    fitted, below = fit_track(data)
    rung = make_learned_step(data, fitted, below)
    assert rung.refusal == ""
    assert rung.held_out.pooled.t_mrmse_m < 0.7 * below.pooled.t_mrmse_m
    ideal = hold_out(data, fit_model(data, Model(HUSKY), exact=True)).pooled
    shares = rung.share_removed(ideal, estimate_floor(data))
    for share in shares.values():
        assert share is not None
        assert share[0] < share[1] + 0.02
    position = shares["t_mrmse_m"]
    assert position is not None
    assert position[1] > position[0] + 0.02
    assert rung.term.bands is not None
    assert rung.term.bands.of == "of this run only"


def test_where_nothing_is_left_it_is_refused_and_never_makes_worse(complete: EstimationData) -> None:
    fitted, below = fit_track(complete)
    rung = make_learned_step(complete, fitted, below)
    assert rung.refusal
    kept = hold_out(complete, fitted, learn_where_it_helps(complete)).pooled
    assert kept.t_mrmse_m <= 1.02 * below.pooled.t_mrmse_m
    assert kept.r_mrmse_rad <= 1.02 * below.pooled.r_mrmse_rad
    judged = assess_model(complete, fitted.model)
    step = learn_beyond(judged)
    assert step is not None
    told = summarize_learned(step, judged.ideal.errors, judged.floor)
    assert not told.helps
    assert told.reason == "the remaining error is at the noise floor"
    assert told.term is None


def test_a_fold_is_learned_without_its_stretches(
    data: EstimationData, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted, _ = fit_track(data)
    seen: list[np.ndarray] = []
    learn = ResidualData.learn

    def watch(data: ResidualData, rows: np.ndarray) -> ResidualTerm:
        seen.append(rows)
        return learn(data, rows)

    monkeypatch.setattr(ResidualData, "learn", watch)
    hold_out(data, fitted, learn_fold(data))
    for rows, fold in zip(seen, data.folds, strict=True):
        assert not (rows & fold.test).any()
    seen.clear()
    first = data.folds[0]
    ResidualData(data, fitted.state).cross_validate(first.train)
    assert seen
    for rows in seen:
        assert not (rows & ~first.train).any()


def test_it_fades_to_the_physics_where_an_input_leaves_its_data() -> None:
    one = LearnedInput("v_x", 0.5, -1.0, 1.0, (0.1, 0.0, -0.2))
    two = LearnedInput("v_w", 0.2, -0.4, 0.4, (0.0, 0.0, 0.3))
    term = ResidualTerm([one, two])
    inside = term.predict(np.array([[0.5, 0.2], [1.0, -0.4]]))
    np.testing.assert_allclose(inside, [[0.1, 0.0, 0.1], [0.2, 0.0, -1.0]])
    sizes = [abs(float(term.predict(np.array([[speed, 0.0]]))[0, 0])) for speed in (1.0, 1.5, 2.0, 4.0)]
    assert sizes[1] == pytest.approx(0.3 * math.exp(-0.5))
    assert sizes[0] > sizes[1] > sizes[2] > sizes[3]
    assert sizes[3] < 1e-6


def test_the_regression_shrinks_noise_and_finds_what_is_there() -> None:
    generator = np.random.default_rng(2)
    inputs = generator.normal(0.0, 1.0, (2000, 6))
    truth = np.array([0.5, 0.0, 0.0, -0.3, 0.0, 0.0])
    found = regress(inputs, inputs @ truth + generator.normal(0.0, 0.5, 2000))
    np.testing.assert_allclose(found, truth, atol=0.05)
    noise = regress(inputs[:60], generator.normal(0.0, 0.5, 60))
    plain = np.linalg.lstsq(inputs[:60], generator.normal(0.0, 0.5, 60), rcond=None)[0]
    assert np.linalg.norm(noise) < 0.5 * np.linalg.norm(plain)


def make_term() -> ResidualTerm:
    inputs = [
        LearnedInput(name, 0.5 + number, -1.5, 1.5, (number / 64.0, -0.02, 0.03))
        for number, name in enumerate(INPUTS)
    ]
    return ResidualTerm(inputs, Bands(0.4, 0.2, "of this run only"))


def test_a_model_file_holds_it_and_gives_it_back() -> None:
    model = Model(HUSKY, (find_effect("effective_track")(k=1.8), make_term()))
    text = format_model(ModelFile(model))
    assert 'name = "v_x |v_w|"' in text
    back = parse_model(text, HERE)
    assert back.model.effects == model.effects
    term = back.model.effect("learned_term")
    assert isinstance(term, ResidualTerm)
    assert term.bands == Bands(0.4, 0.2, "of this run only")
    assert format_model(back) == text
    assert json.loads(export_model(back, "json"))["effects"][-1]["learned"]["input"][0]["name"] == "v_x"
    assert format_model(ModelFile(model - "learned_term")) == format_model(
        replace(back, model=back.model - "learned_term")
    )


def test_the_exported_function_adds_what_the_model_adds(data: EstimationData) -> None:
    fitted, _ = fit_track(data)
    term = ResidualData(data, fitted.state).learn(np.ones(data.whole.run.size, dtype=bool))
    # It stands at the start, on even ground.
    known = [one for one in term.inputs if not one.name.startswith(("missed", "roll", "pitch"))]
    assert len(known) > 10
    models = fitted.model, fitted.model + ResidualTerm(known)
    series = data.runs[0].commands
    assert series is not None
    rows = list(zip(series.times.tolist(), series.left.tolist(), series.right.tolist(), strict=True))
    step_s, run_residuals = 0.005, RunResiduals(data.runs[0], HUSKY, Input.COMMAND, rate_hz=200.0)
    driven, wanted = [], []
    for model in models:
        space: dict[str, object] = {}
        exec(compile(export_model(ModelFile(model), "python"), "exported", "exec"), space)  # noqa: S102 - made here
        driven.append(np.array(space["predict"](rows, 15.0, step_s=step_s)))  # type: ignore[operator]
        wanted.append(run_residuals.predict_velocity(model.effects, Timing()))
    times = run_residuals.grid.times
    # Where a command changes within a cell, the model acts on its mean.
    kept = (times > 1.0) & (times < 14.0)
    kept[kept] &= np.abs(times[kept][:, None] - series.times).min(axis=1) > step_s
    for column, channel in ((4, "x"), (6, "w")):
        added = driven[1][:, column] - driven[0][:, column]
        seen = np.interp(times[kept], driven[0][:, 0] - 0.5 * step_s, added)
        told = (getattr(wanted[1], channel) - getattr(wanted[0], channel))[kept]
        # What slows it in turns is in v_x alone.
        size = float(np.sqrt(np.mean(told**2)))
        assert (size > 0.01) == (channel == "x")
        assert np.sqrt(np.mean((seen - told) ** 2)) <= 0.05 * size


def make_ratios(sizes: Sequence[float], group: str, *, seed: int = 0) -> Ratios:
    """Predictions of ten steps each; five lie in ten seconds."""
    generator = np.random.default_rng(seed)
    errors = np.repeat(np.array(sizes), 10) * generator.exponential(1.0, 10 * len(sizes))
    number = np.repeat(np.arange(len(sizes)), 10)
    return Ratios(group, errors, 2.0 * errors, number // 5, number)


@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_a_band_that_follows_holds_95_of_100_on_a_ground_it_does_not_know(size: float) -> None:
    bands = make_bands([make_ratios([1.0] * 500, "tile")], "")
    assert bands is not None
    found = measure_coverage(bands, [make_ratios([size] * 300, "ice", seed=4)])
    for one in found.values():
        assert 0.93 <= one.followed <= 0.97
        assert (0.93 <= one.as_it_is <= 0.97) == (size == 1.0)


@pytest.fixture(scope="module")
def grounds() -> list[MotionRun]:
    """Runs on two grounds alike, and on a third where what slows turns does not act."""
    return [
        replace(simulate(truth, seed=seed, duration_s=200.0), terrain=terrain)
        for truth, seed, terrain in ((SLOWED, 1, "tile"), (SLOWED, 2, "wood"), (TRACK, 3, "ice"))
    ]


@pytest.mark.long
def test_a_term_that_makes_a_ground_worse_that_it_has_not_seen_is_refused(grounds: list[MotionRun]) -> None:
    alike, unlike = (EstimationData(runs, HUSKY, Input.MEASURED) for runs in (grounds[:2], grounds[1:]))
    assert make_learned_step(alike, *fit_track(alike)).refusal == ""
    refusal = make_learned_step(unlike, *fit_track(unlike)).refusal
    assert "learned without ice, on seed 3 position error rises by" in refusal


@pytest.mark.long
def test_the_verbs_add_show_and_drop_it(log: Path, tmp_path: Path) -> None:
    model, on = tmp_path / "m.toml", ("--on", log, "--results", tmp_path / "results")
    # Without its lag the model leaves what changes of velocity tell of.
    assert run_verb("model", "new", model, "effective_track", "--vehicle", "husky_a200").returncode == 0
    assert run_verb("model", "fit", model, *on, "--quiet").returncode == 0
    done = run_verb("model", "add", model, "learned_term", *on, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["refused"] == {}
    assert told["ladder"][-1]["effects"][-1] == "learned_term"
    assert told["ladder"][-1]["t_mrmse_m"] < told["ladder"][-2]["t_mrmse_m"]
    shown = run_verb("model", "show", model).stdout
    assert "learned_term: names no cause; where an input leaves low to high, the effects alone" in shown
    assert "of this run only" in shown
    compared = run_verb("model", "compare", model, model.with_name("m.toml"), *on, "--json")
    assert compared.returncode == 0, compared.stderr
    (row,) = json.loads(compared.stdout)["compared"]
    assert 0.8 < row["bands_hold"]["position"]["followed"] <= 1.0
    again = run_verb("model", "fit", model, *on, "--json")
    assert json.loads(again.stdout)["ladder"][-1]["effects"][-1] == "learned_term"
    assert run_verb("model", "drop", model, "learned_term", *on, "--quiet").returncode == 0
    assert "learned" not in model.read_text("utf-8")
