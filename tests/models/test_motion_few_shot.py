"""Few seconds of driving and what the fleet knows before: fits with a prior, and the verbs."""

import json
from pathlib import Path

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of
from verbs import run_slip, run_verb

from pipeline.estimation import EstimationData, Fitted, Input, estimate_intervals, fit_model, score
from pipeline.models import Model, find_effect, read_model
from pipeline.run import MotionError, MotionRun
from pipeline.run.windows import cut_run, find_driven

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": {"k": 1.8}, "lateral_skid": {"c": 0.08}}
KNOWN = {"effective_track.k": (1.75, 0.1), "lateral_skid.c": (0.07, 0.03)}
MODEL = Model(
    HUSKY, (find_effect("effective_track")().change(k=1.75), find_effect("lateral_skid")().change(c=0.07))
)


@pytest.fixture(scope="module")
def run() -> MotionRun:
    return simulate(TRUTH, seed=4, duration_s=90.0)


def problem_of(run: MotionRun) -> EstimationData:
    return EstimationData([run], HUSKY, Input.MEASURED)


def fit_with_prior(data: EstimationData, model: Model, numbers: dict[str, tuple[float, float]]) -> Fitted:
    return fit_model(data.with_prior(numbers), model, exact=True)


def test_a_run_is_cut_by_how_long_it_was_driven(run: MotionRun) -> None:
    at = find_driven(run, 20.0)
    first, rest = cut_run(run, end_s=at), cut_run(run, at)
    assert 20.0 <= at < 60.0
    assert first.wheels.times[-1] <= at
    times = [problem_of(side).whole.times for side in (first, rest)]
    assert times[0].max() <= at <= times[1].min()
    with pytest.raises(MotionError, match="not for 500 s"):
        find_driven(run, 500.0)


def test_what_is_known_counts_while_little_was_driven_and_the_run_afterwards(run: MotionRun) -> None:
    wrong = {"effective_track.k": (1.4, 0.05)}
    model = MODEL.keep(["effective_track"])
    found = {
        seconds: fit_with_prior(problem_of(cut_run(run, end_s=find_driven(run, seconds))), model, wrong)
        for seconds in (6.0, 60.0)
    }
    ks = {seconds: fitted.model.effect("effective_track").values["k"] for seconds, fitted in found.items()}
    assert ks[6.0] < ks[60.0] < 1.8 + 0.02
    assert ks[60.0] > 1.75


def test_a_sure_prior_holds_and_a_vague_one_changes_nothing(run: MotionRun) -> None:
    data = problem_of(cut_run(run, end_s=find_driven(run, 20.0)))
    alone = fit_model(data, MODEL, exact=True)
    held = fit_with_prior(data, MODEL, {label: (mean, 1e-6) for label, (mean, _) in KNOWN.items()})
    free = fit_with_prior(data, MODEL, {label: (mean, 1e4) for label, (mean, _) in KNOWN.items()})
    for effect in MODEL:
        for name, value in effect.values.items():
            assert held.model.effect(effect.id).values[name] == pytest.approx(value, abs=1e-4)
            own = alone.model.effect(effect.id).values[name]
            assert free.model.effect(effect.id).values[name] == pytest.approx(own, rel=1e-3)


def test_the_posterior_is_narrower_than_the_prior_and_holds_the_truth(run: MotionRun) -> None:
    data = problem_of(cut_run(run, end_s=find_driven(run, 8.0))).with_prior(KNOWN)
    fitted = fit_model(data, MODEL, exact=True)
    estimates = estimate_intervals(fitted)
    for label, truth in (("effective_track.k", 1.8), ("lateral_skid.c", 0.08)):
        item = estimates.find(label)
        assert 0.0 < item.deviation < KNOWN[label][1]
        assert item.low < truth < item.high


def test_with_a_prior_a_few_seconds_predict_the_rest_no_worse() -> None:
    fresh = Model(HUSKY, tuple(find_effect(effect.id)() for effect in MODEL))
    errors = []
    for seed in range(1, 5):
        run = simulate(TRUTH, seed=seed, duration_s=90.0)
        at = find_driven(run, 5.0)
        first, rest = problem_of(cut_run(run, end_s=at)), problem_of(cut_run(run, at))
        fits = (fit_with_prior(first, MODEL, KNOWN), fit_model(first, fresh, exact=True))
        states = (*(fitted.state for fitted in fits), rest.start_state())
        errors.append([score(rest, state).pooled.t_mrmse_m for state in states])
    few, alone, ideal = np.mean(errors, axis=0)
    assert few <= alone
    assert few < 0.2 * ideal


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with diagnosed results of three runs on tile, and the log of a fourth one."""
    folder = tmp_path_factory.mktemp("fleet")
    for number, k in enumerate((1.74, 1.8, 1.86, 1.8)):
        log = folder / f"run_{number}.mcap"
        drive = ("--effect", f"effective_track={k}", "--seed", number, "--duration", 40)
        run_verb("simulate", *drive, "--file", log)
        if number < 3:
            told = ("--terrain", "tile", "--no-report", "--quiet", "--input", "measured")
            run_verb("analyze", log, *told, "--results", folder / "results")
    return folder


def test_a_few_seconds_are_fitted_with_the_fleet_before(
    fleet: Path,
) -> None:
    log, file = fleet / "run_3.mcap", fleet / "few.toml"
    on = ("--on", str(log), "--results", str(fleet / "results"), "--input", "measured", "--json")
    code, out, error = run_slip("model", "fit", str(file), *on, "--first", "6s", "--prior", "fleet")
    assert code == 0, error
    told = json.loads(out)
    k, before = told["parameters"]["effective_track.k"], told["prior"]["effective_track.k"]
    assert k["low"] < 1.8 < k["high"]
    assert before["low"] < k["low"] < k["high"] < before["high"]
    written = read_model(file)
    assert (written.fit["first_s"], written.fit["prior"]) == (6.0, "fleet")
    # The run is among the results now; asked again, it is no witness for itself.
    again = json.loads(run_slip("model", "fit", *on, "--first", "6s", "--prior", "fleet")[1])
    assert again["prior"]["effective_track.k"]["value"] != 1.0
    assert again["model"] is None
