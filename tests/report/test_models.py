"""Figures of models: what they count, and what a diagnosis becomes."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.estimation import Comparison, Input, Problem, State
from pipeline.estimation.effect_signature import autocorrelate, cross_correlate
from pipeline.estimation.problem import predict_at_from
from pipeline.models import Model, Timing, find_effect
from pipeline.report.figures.residual_figures import choose_signal
from pipeline.report.figures.slip_figures import find_steps
from pipeline.report.motion_view import SIGNALS, MotionStage, MotionView
from pipeline.run import load_run
from pipeline.simulate import simulate_case
from pipeline.sources import Vehicle, find_preset


def vehicle() -> Vehicle:
    found = find_preset("husky_a200")
    assert found is not None
    return found


def view_of(**residuals: np.ndarray) -> MotionView:
    count = next(iter(residuals.values())).size
    columns = {"t": np.arange(count) * 0.25, **dict.fromkeys(SIGNALS, np.zeros(count)), **residuals}
    empty = pl.DataFrame()
    return MotionView("command", (), (), None, pl.DataFrame(columns), empty, empty, empty)


def test_the_signal_is_the_one_that_explains() -> None:
    rng = np.random.default_rng(5)
    signals = {name: rng.uniform(-1.0, 1.0, 800) for name in SIGNALS}
    noise = rng.normal(0.0, 0.05, 800)
    for name in ("f_w", "a_x", "pitch"):
        assert choose_signal(view_of(**signals, ideal_w=noise + 0.3 * signals[name]), "w") == name
    assert choose_signal(view_of(**signals, ideal_x=noise), "x") == "f_x"


def test_autocorrelation_tells_noise_from_structure_and_crosses_no_hole() -> None:
    rng = np.random.default_rng(7)
    t = np.arange(2000) * 0.25
    lags, noise, bound = autocorrelate(t, rng.normal(size=2000))
    assert lags == pytest.approx(np.arange(11) * 0.5), "windows that overlap are left out"
    assert bound == pytest.approx(1.96 / np.sqrt(1000.0), rel=1e-4)
    assert np.mean(np.abs(noise[1:]) < bound) >= 0.8
    lags, slow, _ = autocorrelate(t, np.sin(t))
    assert slow[0] == pytest.approx(1.0)
    assert slow[4] == pytest.approx(np.cos(lags[4]), abs=0.05)
    split = np.concatenate((t[:1000], t[1000:] + 1e6))
    assert np.allclose(autocorrelate(split, np.sin(t))[0], lags)


def test_no_correlation_exceeds_one_where_stretches_differ() -> None:
    # Single windows between holes are quiet, so that the pairs of the long stretch are larger than the mean.
    lone = np.arange(400) * 100.0
    t = np.concatenate((np.arange(400) * 0.5, 1000.0 + lone))
    given = np.concatenate((3.0 * np.sin(0.3 * t[:400]), np.full(400, 0.01)))
    assert np.abs(autocorrelate(t, given)[1]).max() <= 1.0 + 1e-9
    assert np.abs(cross_correlate(t, given, -given)[1]).max() <= 1.0 + 1e-9


def test_crosscorrelation_finds_how_late_a_residual_follows_its_input() -> None:
    rng = np.random.default_rng(8)
    t = np.arange(2000) * 0.25
    given = np.repeat(rng.normal(size=250), 8)
    lags, found, bound = cross_correlate(t, given, np.roll(given, 6) + 0.1 * rng.normal(size=2000))
    assert lags[np.argmax(found)] == pytest.approx(1.5), "the input was there first"
    assert found.max() > 0.9
    outside = [np.abs(cross_correlate(t, given, rng.normal(size=2000))[1]) > bound for _ in range(20)]
    assert np.mean(outside) < 0.1


def test_steps_are_those_of_a_command_that_rests_before_and_after() -> None:
    t = np.arange(0.0, 30.0, 0.05)
    asked = np.select([t < 5.0, t < 10.0, t < 11.0], [0.0, 1.0, 0.5], 0.2)
    starts, low, high = find_steps(t, asked, smallest=0.15)
    assert starts == pytest.approx([5.0, 11.0], abs=0.051)
    assert low == pytest.approx([0.0, 0.5])
    assert high == pytest.approx([1.0, 0.2])
    holed = np.concatenate((t[t < 6.0], t[t >= 7.0]))
    assert find_steps(holed, np.interp(holed, t, asked), smallest=0.15)[0] == pytest.approx([11.0], abs=0.051)


def test_a_view_shows_what_a_prediction_says(tmp_path_factory: pytest.TempPathFactory) -> None:
    from pipeline.job import Options  # noqa: PLC0415
    from pipeline.job.analyze import analyze_log  # noqa: PLC0415 - only this test needs a whole run

    folder = tmp_path_factory.mktemp("view")
    log = simulate_case("husky_tile", out=folder / "run.mcap", duration_s=40.0)
    manifest = analyze_log(log, Options(out=folder / "results", report=False)).manifest
    tables = {
        name: manifest.read(name) for name in ("poses", "alignments", "commands", "wheels", "imu", "slip")
    }
    run = load_run(tables, vehicle(), name="run")
    model = Model(vehicle(), (find_effect("effective_track")(k=1.7),))
    places = manifest.read("velocities").select("t", "x", "y")
    problem = Problem([run], vehicle(), Input.COMMAND)
    view = MotionStage(problem, places).view(State(model.effects, (Timing(),)), (), None)

    shown = view.velocity.sort("t")
    at = shown["t"].to_numpy()
    expected = predict_at_from(problem.comparisons[0], model.effects, Timing(), at)
    assert np.allclose(shown["v_w"], expected[:, 2], atol=1e-9)
    # The problem's run is anchored, see `MotionRun.anchored`.
    recorded = predict_at_from(Comparison(run, vehicle(), Input.COMMAND), model.effects, Timing(), at)
    assert np.allclose(expected, recorded, atol=1e-4, equal_nan=True)
    starts = view.arcs.group_by("piece", maintain_order=True).first()
    for axis in "xy":
        at = np.interp(starts["t"], places["t"], places[axis])
        assert np.allclose(starts[axis], at, atol=1e-6)
