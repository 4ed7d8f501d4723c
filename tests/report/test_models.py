"""Figures of models: what they count, and what a diagnosis becomes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from report_synthesis import make_report

from pipeline.core.untrusted import objects_in
from pipeline.estimation import Comparison, Input, Problem, State
from pipeline.estimation.effect_signature import autocorrelate, cross_correlate
from pipeline.estimation.ladder import format_rises
from pipeline.estimation.problem import predict_at_from
from pipeline.models import Model, ModelFile, Timing, find_effect, format_model
from pipeline.report.figures.model_figures import list_ladder_steps, list_parts
from pipeline.report.figures.residual_figures import choose_signal, draw_autocorrelation
from pipeline.report.figures.slip_figures import find_steps
from pipeline.report.motion_view import SIGNALS, MotionStage, MotionView, read_model_text
from pipeline.report.scene import RunReport, Scene
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


def test_a_signal_that_hardly_moves_explains_nothing() -> None:
    rng = np.random.default_rng(6)
    lone = np.zeros(400)
    lone[:3] = 5.0
    noise = rng.normal(0.0, 1.0, 400)
    noise[:3] += 40.0
    assert choose_signal(view_of(a_x=lone, ideal_x=noise, f_x=rng.uniform(-1, 1, 400)), "x") == "f_x"


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


@pytest.mark.parametrize("step", [0.25, 0.15, 0.35])
def test_the_words_below_the_autocorrelation_say_its_numbers(step: float) -> None:
    t = np.arange(800) * step
    view = view_of(**{f"{series}_{one}": np.sin(0.5 * t) for series in ("ideal", "model") for one in "xyw"})
    view = replace(view, residuals=view.residuals.with_columns(t=pl.Series(t)))
    drawing = draw_autocorrelation(Scene(RunReport({}, motion=view)))
    assert drawing is not None
    rows = drawing.rows["autocorrelation_x"].filter(pl.col("lag") > 0.0, series="ideal")
    lag, value = min(rows.select("lag", "value").iter_rows(), key=lambda row: abs(row[0] - 1.0))
    assert f"residuals {lag:.2g} s apart: forward {value:.2f} before, {value:.2f} after" in drawing.words
    assert value > 0.5


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


def test_the_staircase_names_what_each_rung_adds() -> None:
    rows = list_ladder_steps(Scene(make_report(duration_s=20.0)))
    assert rows["ladder"]["step"].to_list() == ["ideal", "+ effective_track", "+ drive_lag"]
    assert rows["ladder"]["t"].to_list() == [1.06, 0.44, 0.31]
    assert rows["ladder"]["told"][0] == "1.06 m \u00b7 55\u00b0", "degrees for people"
    assert rows["ladder_floor"]["t"].to_list() == [0.19]
    assert rows["ladder_ceiling"]["t"].to_list() == [1.06]
    assert rows["ladder_ceiling"]["label"].to_list() == ["ceiling 1.06 m"]


def test_a_rung_that_raises_an_error_says_so_in_the_words_of_the_verb() -> None:
    report = make_report(duration_s=20.0)
    ideal, rung, *_ = objects_in(report.diagnosis, "ladder")
    risen = {**rung, "t_mrmse_m": 1.59}
    diagnosis = {**report.diagnosis, "ladder": [ideal, risen]}
    rows = list_ladder_steps(Scene(RunReport(report.summary, report.tables, diagnosis)))
    said = format_rises(ideal, risen)
    assert said == "position error rises by 50 %"
    assert rows["ladder"]["step"][1] == f"+ effective_track ({said})"


def test_the_budget_is_one_bar_from_the_whole_down_to_nothing() -> None:
    rows = list_parts(Scene(make_report(duration_s=20.0)))
    assert rows["cause"].to_list() == ["effective_track", "drive_lag", "disturbance", "localization noise"]
    assert rows["from"].to_list() == pytest.approx([1.0, 0.15, 0.2, 0.05])
    assert rows["to"].to_list() == pytest.approx([0.15, 0.2, 0.05, 0.0], abs=1e-12)
    assert rows["high"].to_list() == [*map(pytest.approx, (0.18, 0.23, 0.08)), None]


def test_the_model_that_is_drawn_is_the_one_that_was_written() -> None:
    model = Model(vehicle(), (find_effect("effective_track")(k=1.79),))
    file = read_model_text({"model": format_model(ModelFile(model))})
    assert file is not None
    assert file.model == model
    for damaged in (None, 7, "", "[[effect", "[[effect]]\nid = 'no_longer_known'"):
        assert read_model_text({"model": damaged}) is None


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
