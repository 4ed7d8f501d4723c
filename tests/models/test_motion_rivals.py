import json
from pathlib import Path

import numpy as np
import pytest
from learners import Lesson, list_learners
from motion_runs import simulate, vehicle_of
from verbs import run_verb

from pipeline.estimation import EstimationData, HeldOut, Input, fit_model, hold_out
from pipeline.estimation.rivals import Contest, Rival, compare_errors, hold_contest, judge_rival
from pipeline.models import Model
from pipeline.models.literature import find_model
from pipeline.results import Errors
from pipeline.simulate import simulate_case

HUSKY = vehicle_of("husky_a200")
TRUTH = {"effective_track": {"k": 1.8}, "drive_lag": {"tau": 0.3}}
LEARNERS = ("learned_linear", "learned_process", "learned_trees")


@pytest.fixture(scope="module")
def data() -> EstimationData:
    return EstimationData([simulate(TRUTH, duration_s=120.0)], HUSKY, Input.MEASURED)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_case(
        "husky_tile", out=tmp_path_factory.mktemp("rivals") / "tile.mcap", seed=1, duration_s=90.0
    )


def make_rival(name: str, errors: np.ndarray) -> Rival:
    rms = float(np.sqrt(np.mean(errors**2)))
    pooled = Errors((rms,) * 3, (rms,) * 3, rms, rms, rms, rms, rms, rms, errors.size)
    return Rival(name, 1, HeldOut(np.zeros((1, 3)), (errors,), (errors,), pooled, (pooled,)), 0.0)


def test_errors_are_those_of_the_ladder(data: EstimationData) -> None:
    model = find_model("extended_differential_drive").make(HUSKY)
    rival = judge_rival(data, "track", model)
    laddered = hold_out(data, fit_model(data, model, exact=True)).pooled
    assert rival.held_out.pooled == laddered
    assert rival.numbers == 1
    assert rival.read("t_mrmse_m") == laddered.t_mrmse_m


def test_a_difference_is_chance_only_where_its_interval_holds_zero() -> None:
    generator = np.random.default_rng(3)
    stretches = np.repeat(np.arange(30), 20)
    common = np.abs(generator.normal(0.1, 0.02, stretches.size))
    by_stretch = generator.normal(0.0, 0.01, 30)[stretches]
    worse = compare_errors(common + 0.02, common, stretches)
    assert worse.value == pytest.approx(0.02, abs=2e-3)
    assert not worse.is_chance
    same = compare_errors(common + by_stretch, common, stretches)
    assert same.is_chance
    one = compare_errors(common[:20] + 0.02, common[:20], stretches[:20])
    assert one.value > 0.0
    assert one.is_chance, "one stretch says nothing of another"


def test_the_interval_of_a_difference_holds_the_truth_in_95_of_100_draws() -> None:
    generator = np.random.default_rng(5)
    stretches = np.repeat(np.arange(20), 15)
    held = 0
    for _ in range(400):
        # Neighbours are alike: each stretch has its own size.
        sizes = np.exp(generator.normal(0.0, 0.3, (2, 20)))[:, stretches]
        one, other = generator.normal(0.0, 1.0, (2, stretches.size)) * sizes
        found = compare_errors(one, other, stretches)
        held += found.low <= 0.0 <= found.high
    assert 0.91 <= held / 400 <= 0.98


def test_what_chance_put_behind_the_best_is_marked_and_no_more() -> None:
    generator = np.random.default_rng(7)
    stretches = np.repeat(np.arange(40), 10)
    errors = np.abs(generator.normal(0.1, 0.02, 400))
    tied = errors + 1e-3 * generator.normal(1.0, 30.0, 40)[stretches]
    rivals = (make_rival("far", errors + 0.05), make_rival("best", errors), make_rival("near", tied))
    contest = Contest(rivals, stretches)
    smallest = contest.find_best("t_mrmse_m")
    assert {smallest.name, *contest.ties["t_mrmse_m"]} == {"best", "near"}
    assert [contest.is_best(rival, "t_mrmse_m") for rival in rivals] == [False, True, True]


def test_the_right_model_wins_and_those_that_hold_it_are_not_told_apart(data: EstimationData) -> None:
    names = ("ideal", "extended_differential_drive", "icr_asymmetric", "full_linear")
    rivals = [judge_rival(data, name, find_model(name).make(HUSKY)) for name in names]
    contest = hold_contest(data, rivals)
    right = rivals[1]
    for metric in ("t_mrmse_m", "r_mrmse_rad"):
        assert contest.is_best(right, metric)
        behind = contest.measure(rivals[0], right, metric)
        assert behind.low > 0.0


@pytest.mark.long
@pytest.mark.parametrize("name", LEARNERS)
def test_a_learned_rival_sees_most_of_what_a_model_lacks_on_data_not_seen(
    data: EstimationData, name: str
) -> None:
    learner = next(one for one in list_learners() if one.name == name)
    ideal = judge_rival(data, "ideal", Model(HUSKY))
    fitted = fit_model(data, Model(HUSKY), exact=True)
    learned = Rival(name, None, hold_out(data, fitted, Lesson(data, learner).learn_fold), 0.0)
    assert learned.read("r_mrmse_rad") < 0.3 * ideal.read("r_mrmse_rad")
    assert learned.read("t_mrmse_m") < 0.6 * ideal.read("t_mrmse_m")


def test_a_fold_is_learned_without_its_stretches(data: EstimationData) -> None:
    """A learner that knows windows by heart is no better on those that it has not seen."""
    fitted = fit_model(data, Model(HUSKY), exact=True)
    lesson = Lesson(data, list_learners()[0])
    seen: list[np.ndarray] = []

    def watch(state: object, rows: np.ndarray) -> object:
        seen.append(rows)
        return lesson.learn_fold(state, rows)  # type: ignore[arg-type]

    hold_out(data, fitted, watch)  # type: ignore[arg-type]
    assert len(seen) == len(data.folds)
    for rows, fold in zip(seen, data.folds, strict=True):
        assert not (rows & fold.test).any()


def test_the_verb_compares_with_the_literature(log: Path, tmp_path: Path) -> None:
    model = tmp_path / "lagging.toml"
    made = run_verb("model", "new", model, "drive_lag", "effective_track", "--vehicle", "husky_a200")
    assert made.returncode == 0, made.stderr
    on = ("--on", log, "--results", tmp_path / "results")
    done = run_verb("model", "compare", model, "--against", "literature", *on, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    rows = {row["model"]: row for row in told["models"]}
    assert {str(model), "ideal", "drive", "friction_based", "seegmiller"} <= set(rows)
    assert rows[str(model)]["numbers"] == 2
    best = told["best"]["t_mrmse_m"]
    tied = {best["model"], *best["not_told_apart_from"]}
    assert str(model) in tied
    assert best["is_significant"] == (len(tied) == 1)
    behind = rows["ideal"]["behind_best"]["t_mrmse_m"]
    assert 0.0 < behind["low"] < behind["value"] < behind["high"]
    errors = {name: row["errors"]["t_mrmse_m"] for name, row in rows.items()}
    assert behind["value"] == pytest.approx(errors["ideal"] - min(errors.values()), abs=1e-5)

    shown = run_verb("model", "compare", "--against", "literature", *on).stdout
    assert "icr_asymmetric" in shown
    assert "* smallest; = not significantly larger" in shown
    assert "has the smallest error of heading" in shown
