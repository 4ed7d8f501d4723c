"""Few seconds of driving and what the fleet knows before: fits with a prior, and the verbs."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.cli import main
from pipeline.estimation import Input, Problem, estimate_intervals, fit_model, score
from pipeline.estimation.across_runs import fit_with_prior, tie_to_prior
from pipeline.estimation.state import Prior
from pipeline.job.prediction import weigh_runs
from pipeline.models import Model, find_effect, read_model
from pipeline.run import MotionError
from pipeline.run.windows import cut_run, find_driven
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.run import MotionRun

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": {"k": 1.8}, "lateral_skid": {"c": 0.08}}
KNOWN = {"effective_track.k": (1.75, 0.1), "lateral_skid.c": (0.07, 0.03)}
MODEL = Model(
    HUSKY, (find_effect("effective_track")().change(k=1.75), find_effect("lateral_skid")().change(c=0.07))
)


@pytest.fixture(scope="module")
def run() -> MotionRun:
    return simulate(TRUTH, seed=4, duration_s=90.0)


def problem_of(run: MotionRun) -> Problem:
    return Problem([run], HUSKY, Input.MEASURED)


def test_a_run_is_cut_by_how_long_it_was_driven(run: MotionRun) -> None:
    at = find_driven(run, 20.0)
    first, rest = cut_run(run, end_s=at), cut_run(run, at)
    assert 20.0 <= at < 60.0
    assert first.wheels is not None
    assert first.wheels.times[-1] <= at
    times = [problem_of(side).whole.times for side in (first, rest)]
    assert times[0].max() <= at <= times[1].min()
    with pytest.raises(MotionError, match="not for 500 s"):
        find_driven(run, 500.0)


def test_standing_is_not_driving(run: MotionRun) -> None:
    assert run.commands is not None
    waits = run.commands.times < run.commands.times[0] + 30.0
    still = {name: np.where(waits, 0.0, getattr(run.commands, name)) for name in ("left", "right")}
    commands = type(run.commands)(run.commands.times, still["left"], still["right"], run.commands.steering)
    waiting = type(run)(**{**vars(run), "commands": commands})
    assert find_driven(waiting, 5.0) > find_driven(run, 5.0) + 20.0


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
    problem = problem_of(cut_run(run, end_s=find_driven(run, 20.0)))
    alone = fit_model(problem, MODEL, exact=True)
    held = fit_with_prior(problem, MODEL, {label: (mean, 1e-6) for label, (mean, _) in KNOWN.items()})
    free = fit_with_prior(problem, MODEL, {label: (mean, 1e4) for label, (mean, _) in KNOWN.items()})
    for effect in MODEL:
        for name, value in effect.values.items():
            assert held.model.effect(effect.id).values[name] == pytest.approx(value, abs=1e-4)
            own = alone.model.effect(effect.id).values[name]
            assert free.model.effect(effect.id).values[name] == pytest.approx(own, rel=1e-3)


def test_the_posterior_is_narrower_than_the_prior_and_holds_the_truth(run: MotionRun) -> None:
    problem = tie_to_prior(problem_of(cut_run(run, end_s=find_driven(run, 8.0))), MODEL, KNOWN)
    fitted = fit_model(problem, MODEL, exact=True)
    estimates = estimate_intervals(problem, fitted)
    for label, truth in (("effective_track.k", 1.8), ("lateral_skid.c", 0.08)):
        item = estimates.find(label)
        assert 0.0 < item.deviation < KNOWN[label][1]
        assert item.low < truth < item.high


def test_the_whole_problem_is_as_it_was(run: MotionRun) -> None:
    problem = problem_of(run)
    before = fit_model(problem, MODEL, exact=True).model
    tied = tie_to_prior(problem, MODEL, KNOWN)
    assert fit_model(problem, MODEL, exact=True).model == before
    assert not problem.parts[0].prior.numbers
    assert tied.parts[0].prior.excess >= 1.0


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


def test_a_run_that_is_unlike_the_others_in_one_number_is_held_less_in_all(run: MotionRun) -> None:
    problem = problem_of(run)
    prior = Prior(KNOWN, excess=3.0)
    held = []
    for k in (1.75, 2.4):
        state = problem.start_state(MODEL.swap(find_effect("effective_track")().change(k=k)).effects)
        free = [number for number in state.list_free((), ()) if number.label in KNOWN]
        held.append(prior.weigh(state, free)[1])
        for place, number in enumerate(free):
            costs = [prior.cost(state.set(number, state.get(number) + step), free) for step in (-1e-5, 1e-5)]
            assert prior.pull(state, free)[place] == pytest.approx((costs[0] - costs[1]) / 4e-5, abs=1e-3)
    assert held[1] < 0.2 * held[0]


def run_slip(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    told = capsys.readouterr()
    return int(ended.value.code or 0), told.out, told.err


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with diagnosed results of three runs on tile, and the log of a fourth one."""
    folder = tmp_path_factory.mktemp("fleet")
    for number, k in enumerate((1.74, 1.8, 1.86, 1.8)):
        log = folder / f"run_{number}.mcap"
        for arguments in (
            ["simulate", "--effect", f"effective_track={k}", "--seed", str(number), "--duration", "40"],
            ["analyze", str(log), "--terrain", "tile", "--no-report", "--quiet", "--input", "measured"],
        ):
            if arguments[0] == "analyze" and number == 3:
                continue
            out = log if arguments[0] == "simulate" else folder / "results"
            with pytest.raises(SystemExit):
                main([*arguments, "--out", str(out)])
    return folder


def test_a_deployment_is_predicted_and_written(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = str(fleet / "results")
    file = fleet / "tile.toml"
    chosen = ("fleet", "predict", "--vehicle", "husky_a200", "--results", known, "--input", "measured")
    code, out, _ = run_slip(capsys, *chosen, "--terrain", "tile", "--file", str(file), "--json")
    told = json.loads(out)
    assert code == 0
    (effect,) = told["effects"]
    k = effect["parameters"]["k"]
    assert effect["id"] == "effective_track"
    assert k["low"] < 1.74 < k["value"] < 1.86 < k["high"]
    assert told["runs_on_terrain"] == len(told["runs_used"]) == 3
    for key in ("t_mrmse_m", "ideal_t_mrmse_m", "median_modulus"):
        assert 0.0 < told[key]["low"] < told[key]["value"] < told[key]["high"]
    assert told["t_mrmse_m"]["value"] < 0.5 * told["ideal_t_mrmse_m"]["value"]
    written = read_model(file)
    assert written.model.effect("effective_track").values["k"] == pytest.approx(k["value"], rel=1e-5)
    assert written.intervals["effective_track.k"] == pytest.approx((k["low"], k["high"]), rel=1e-4)

    elsewhere = json.loads(run_slip(capsys, *chosen, "--terrain", "ice", "--json")[1])
    other = elsewhere["effects"][0]["parameters"]["k"]
    assert other["high"] - other["low"] > k["high"] - k["low"]
    assert (elsewhere["runs_on_terrain"], elsewhere["runs_elsewhere"]) == (0, 3)
    assert elsewhere["notes"] == [
        ("no run is on ice: the prediction is for another terrain, from runs on tile. Known: tile")
    ]
    assert told["notes"] == []
    typo = run_slip(capsys, *chosen, "--terrain", "tille")[1].splitlines()
    assert typo[0] == "husky_a200 on tille: 0 runs there, 3 elsewhere"
    assert typo[1].startswith("! no run is on tille: the prediction is for another terrain")
    assert "Did you mean tile?" in typo[1]
    text = run_slip(capsys, *chosen, "--terrain", "tile")[1]
    assert "position error over 2 s" in text
    assert "that of the ideal model" in text
    assert "husky_a200 on tile: 3 runs there, 0 elsewhere" in text
    assert "effective_track.k" in text

    code, _, error = run_slip(
        capsys, "fleet", "predict", "--vehicle", "jackal", "--terrain", "tile", "--results", known
    )
    assert (code, error.count("\n")) == (1, 1)
    assert "husky_a200" in error


def test_a_run_with_a_damaged_table_is_left_out_and_named_by_all_of_the_fleet(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = tmp_path / "results"
    shutil.copytree(fleet / "results", known)
    damaged = Store(known).manifests()[1]
    path = damaged.path("poses")
    path.write_bytes(path.read_bytes()[:1000])
    why = "the table poses cannot be read: it has changed since it was written"
    note = f"left out, {why}; analyze the log again with --force: {damaged.run}"
    there = ("--vehicle", "husky_a200", "--terrain", "tile", "--input", "measured")
    for words in (("fit",), ("predict", *there), ("trend",)):
        code, out, error = run_slip(capsys, "fleet", *words, "--results", str(known), "--json")
        assert (code, error) == (0, "")
        assert note in json.loads(out)["notes"]
        assert f"! {note}" in run_slip(capsys, "fleet", *words, "--results", str(known))[1]
    asked = ("export", damaged.run, "--to", "csv", "--file", str(tmp_path / "csv"))
    code, out, error = run_slip(capsys, *asked, "--results", str(known))
    assert (code, out) == (1, "")
    assert error.endswith(f"/poses.parquet: {why}. Analyze the log again with --force.\n")
    assert [one.name for one in tmp_path.iterdir()] == ["results"]
    path.unlink()
    code, out, error = run_slip(capsys, "fleet", "predict", *there, "--results", str(known), "--json")
    assert (code, error) == (0, "")
    gone = "left out, the file poses.parquet of the results is gone; slip results verify"
    assert [note for note in json.loads(out)["notes"] if note.startswith(gone)]


def test_a_few_seconds_are_fitted_with_the_fleet_before(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, file = fleet / "run_3.mcap", fleet / "few.toml"
    on = ("--on", str(log), "--out", str(fleet / "results"), "--input", "measured", "--json")
    code, out, error = run_slip(capsys, "model", "fit", str(file), *on, "--first", "6s", "--prior", "fleet")
    assert code == 0, error
    told = json.loads(out)
    k, before = told["parameters"]["effective_track.k"], told["prior"]["effective_track.k"]
    assert k["low"] < 1.8 < k["high"]
    assert before["low"] < k["low"] < k["high"] < before["high"]
    written = read_model(file)
    assert (written.fit["first_s"], written.fit["prior"]) == (6.0, "fleet")
    # The run is among the results now; asked again, it is no witness for itself.
    again = json.loads(run_slip(capsys, "model", "fit", *on, "--first", "6s", "--prior", "fleet")[1])
    assert again["prior"]["effective_track.k"]["value"] != 1.0
    assert again["model"] is None


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--first", "soon"), "is not a duration"),
        ((), "no model file was given"),
        (("--first", "900s", "--prior", "fleet"), "not for 900 s"),
    ],
)
def test_what_cannot_be_fitted_is_said_in_one_line(
    fleet: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], words: str
) -> None:
    on = ("--on", str(fleet / "run_0.mcap"), "--out", str(fleet / "results"), "--quiet")
    code, _, error = run_slip(capsys, "model", "fit", *on, *more)
    assert code == 1
    assert words in error.splitlines()[-1]


def test_few_runs_on_a_terrain_leave_it_open_how_it_will_be_driven() -> None:
    one, five = weigh_runs(np.array([True, False, False])), weigh_runs(np.array([True] * 5 + [False]))
    assert one.tolist() == pytest.approx([0.5, 0.25, 0.25])
    assert five.tolist() == pytest.approx([1 / 6] * 6)
    for alike in (np.ones(4, dtype=bool), np.zeros(4, dtype=bool)):
        assert weigh_runs(alike).tolist() == [0.25] * 4
