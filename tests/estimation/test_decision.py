"""The one decision: what is named is there, and is more than chance, an event or a trifle."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from few import few
from game.closed_loop import close_loop
from motion_runs import as_run, make_scenario, simulate, vehicle_of

from pipeline.estimation import Input
from pipeline.estimation.ambiguity import find_undecided
from pipeline.estimation.decision import LEAST_T, Judged, Search, judge, measure_t
from pipeline.estimation.estimation_data import prepare_data
from pipeline.estimation.fit import fit_path, make_folds
from pipeline.estimation.intervals import estimate_path
from pipeline.estimation.matrix import Matrix, Move
from pipeline.estimation.model_state import ModelState
from pipeline.estimation.unexplained import search_formula
from pipeline.models import Timing, find_effect
from pipeline.simulate import Disturbance, Encoders, Program, simulate_run
from pipeline.simulate.scenario import Commands
from pipeline.words.effects import describe_separation

if TYPE_CHECKING:
    from collections.abc import Collection

    from pipeline.estimation.decision import SearchResult
    from pipeline.estimation.fit import PathFit
    from pipeline.estimation.path_residuals import PathResiduals
    from pipeline.models import Effect
    from pipeline.run import MotionRun
    from pipeline.simulate import ModelState as Moment

HUSKY = vehicle_of("husky_a200")
USUAL = Disturbance(0.03, 0.05)
BY_HAND = Program("teleop")


def drive(effects: object, **more: object) -> MotionRun:
    """A minute of driving by hand, or as is asked."""
    usual = {"duration_s": 60.0, "program": BY_HAND, "disturbance": USUAL}
    return simulate(effects, **{**usual, **more})  # type: ignore[arg-type]


def search(*runs: MotionRun, names: Collection[str] = ()) -> tuple[Search, SearchResult, ModelState]:
    """The ground searched from the wheels, with candidates of these names or with all; and its start."""
    data = prepare_data(runs, HUSKY, Input.MEASURED)
    candidates = [one for one in data.list_candidates(Input.MEASURED) if not names or one.id in names]
    made = Search(data.paths[0], tuple(candidates), data.conditions)
    start = data.start_state()
    return made, made.run(start), start


def _start_track(path: PathResiduals) -> ModelState:
    return ModelState((find_effect("effective_track")(k=1.1),), (Timing(),) * len(path.residuals_by_run))


def judge_alone(run: MotionRun, effect: Effect) -> Judged:
    """How one effect beside nothing is judged."""
    made, _, start = search(run, names=(effect.id,))
    fit = fit_path(made.path, start.add(effect))
    return judge(fit, fit.state.effects[0], Matrix(fit, (), made.conditions.largest), made.conditions)


@pytest.mark.parametrize("seed", few(range(20), 7))
def test_nothing_is_named_where_only_noise_was_drawn(seed: int) -> None:
    """A third in closed loop: a driver who steers against drift makes commands that follow residuals."""
    scenario = make_scenario({}, seed=seed, duration_s=60.0, program=BY_HAND, disturbance=USUAL)
    if seed % 3 == 0:
        scenario = close_loop(scenario, np.random.default_rng(seed))
    _, found, _ = search(as_run(simulate_run(scenario)))
    assert found.new == ()


def test_a_hidden_track_is_named_with_an_interval_that_holds_it() -> None:
    _, found, _ = search(drive({"effective_track": 1.6}))
    assert found.new == ("effective_track",)
    number = estimate_path(found.final).find("effective_track.k")
    assert number.low < 1.6 < number.high
    assert number.high - number.low < 0.2
    judged = found.judged["effective_track"]
    assert judged.gain > 0.0
    assert judged.frequency > 0.95


@pytest.mark.parametrize(("turns", "is_named"), [(1, False), (2, True)])
def test_what_ten_seconds_bring_is_refused(turns: int, *, is_named: bool) -> None:
    times = np.arange(0.0, 90.0, 0.05)
    turn = np.zeros(times.size)
    for number in range(turns):
        turn[(times > 20.0 + 30.0 * number) & (times < 27.0 + 30.0 * number)] = 0.6
    speed = np.where((times > 2.0) & (times < 88.0), 0.8, 0.0)
    run = drive({"effective_track": 1.6}, duration_s=90.0, played=Commands(times, speed, turn))
    judged = judge_alone(run, find_effect("effective_track")(k=1.5))
    assert measure_t(judged.fit, judged.fit.state.effects[0], judged.base) > 1.5 * LEAST_T
    assert judged.is_proven == is_named
    assert ("resampled recordings" in judged.refusal) != is_named


def test_what_nobody_would_notice_has_no_name_however_evident_it_is() -> None:
    run = drive({"effective_track": 1.006}, disturbance=Disturbance())
    judged = judge_alone(run, find_effect("effective_track")(k=1.1))
    assert measure_t(judged.fit, judged.fit.state.effects[0], judged.base) > 2.0 * LEAST_T
    assert judged.refusal
    _, found, _ = search(run, names=("effective_track",))
    assert found.new == ()
    # It explains all the same what others would only imitate.
    assert found.final.ids == ("effective_track",)


def test_a_lag_that_sampling_makes_is_the_delay_of_the_encoders() -> None:
    run = drive({"drive_lag": 0.02}, encoders=Encoders(rate_hz=20.0, noise_radps=0.003))
    data = prepare_data([run], HUSKY, Input.COMMAND)
    path, start = data.paths[1], data.start_state()
    found = Search(path, data.list_drivetrain(), data.conditions).run(start)
    assert found.new == ()
    assert "acceleration_limit" not in found.final.ids


@pytest.mark.parametrize("seed", few(range(1, 7), 2))
def test_a_lag_stays_beside_a_delay_that_promises_to_do_the_same(seed: int) -> None:
    """Poses came 10 ms late: by its derivative a dead time was as good as the lag, which went."""
    hidden = {"effective_track": 1.3, "drive_lag": 0.25, "clock_offset": {"d": 0.01}}
    run = drive(
        hidden, seed=seed, duration_s=90.0, disturbance=Disturbance(0.01, 0.01), encoders=None, imu=None
    )
    data = prepare_data([run], HUSKY, Input.COMMAND)
    search = Search(data.paths[0], data.list_candidates(Input.COMMAND), data.conditions)
    assert {"drive_lag", "effective_track"} == set(search.run(data.start_state()).new)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_wheels_that_do_something_else_than_they_are_told_nothing_is_named(seed: int) -> None:
    """By chance a gain or a limit made of another command what comes nearest."""
    encoders = Encoders(rate_hz=20.0, noise_radps=0.003)
    told, done = (drive({}, seed=one, encoders=encoders) for one in (seed, seed + 10))
    data = prepare_data([replace(done, commands=told.commands)], HUSKY, Input.COMMAND)
    found = Search(data.paths[1], data.list_drivetrain(), data.conditions).run(data.start_state())
    assert found.new == ()
    assert found.final.ids == ()


def test_a_delay_too_small_for_a_name_keeps_none_from_what_comes_with_it() -> None:
    """Contact friction, which follows late, was as good as the track alone."""
    encoders = Encoders(rate_hz=20.0, noise_radps=0.003)
    run = drive(
        {"effective_track": 1.3, "clock_offset": {"d": 0.025}, "drive_lag": 0.25},
        seed=1, duration_s=100.0, disturbance=Disturbance(0.01, 0.01), encoders=encoders, imu=None,
    )  # fmt: skip
    _, found, _ = search(run)
    assert found.new == ("effective_track",)
    assert found.final.ids == ("effective_track", "clock_offset")
    assert not found.rivals


def test_the_ground_changes_beside_the_track_that_both_grounds_share() -> None:
    """A track was taken for a special case of a change, and the ground was said to wear out over the run."""
    hidden = {"effective_track": 1.6, "terrain_change": {"k_v": 0.83, "k_w": 0.79, "at_s": 120.0}}
    _, found, _ = search(drive(hidden, duration_s=240.0))
    assert set(found.new) == {"effective_track", "terrain_change"}
    change = estimate_path(found.final)
    for label, value in (("k_v", 0.83), ("k_w", 0.79)):
        number = change.find(f"terrain_change.{label}")
        assert number.low < value < number.high


def test_of_two_effects_that_do_the_same_both_are_reported() -> None:
    """Where nothing but turning on the spot was driven, radius and track are one number."""
    made, found, _ = search(drive({"effective_track": 1.3}, program=Program("spins")))
    (chosen,) = found.new
    (group,) = find_undecided(made, found)
    assert chosen in group.candidates
    assert {"effective_track", "wheel_radius"} <= set(group.candidates)
    assert describe_separation(group)
    for name in ("effective_track", "wheel_radius"):
        (value,) = group.parameters[name].values()
        expected = 1.3 if name == "effective_track" else 1.0 / 1.3
        assert value.low < expected < value.high


def test_a_lag_gives_way_to_one_of_which_it_is_a_special_case() -> None:
    """Beside a lag, slower braking promises little: it is looked for in its place."""
    times = np.arange(0.0, 90.0, 0.05)
    speed = np.where(times % 15.0 > 9.0, 0.4 + 0.1 * (times // 15.0), 0.0)
    played = Commands(times, speed, np.zeros(times.size))
    run = drive({"brake_lag": {"tau_drive": 0.3, "tau_brake": 1.5}}, duration_s=90.0, played=played)
    data = prepare_data([run], HUSKY, Input.COMMAND)
    lags = [one for one in data.list_candidates(Input.COMMAND) if one.id in {"drive_lag", "brake_lag"}]
    made = Search(data.paths[-1], tuple(lags), data.conditions)
    found = made.run(data.start_state())
    assert found.new == ("brake_lag",)
    assert estimate_path(found.final).find("brake_lag.tau_brake").value == pytest.approx(1.5, abs=0.1)


@pytest.mark.parametrize(("limit", "seed"), [(1.5, 2), (2.0, 1)])
def test_of_two_that_do_much_alike_the_better_has_a_name(limit: float, seed: int) -> None:
    """Each did too little beside the other to be felt, and neither had one."""
    hidden = {"drive_lag": 0.12, "body_acceleration_limit": limit}
    run = drive(
        hidden, seed=seed, duration_s=120.0, program=Program("drive_steps"),
        disturbance=Disturbance(0.2, 0.2), encoders=None, imu=None,
    )  # fmt: skip
    data = prepare_data([run], HUSKY, Input.COMMAND)
    both = [one for one in data.list_candidates(Input.COMMAND) if one.id in hidden]
    found = Search(data.paths[-1], tuple(both), data.conditions).run(data.start_state())
    assert {*found.judged} == {*hidden}
    assert "body_acceleration_limit" in found.new


def test_the_matrix_knows_what_a_set_costs_before_it_is_fitted() -> None:
    """Of numbers that act linearly it is what a fit under the same noise finds."""
    made, found, _ = search(drive({"effective_track": 1.3, "lateral_skid": 0.3}))
    matrix = made.make_matrix(found.start)
    ids = [trial.effect.id for trial in matrix.trials]
    both = Move().add(ids.index("effective_track")).add(ids.index("lateral_skid"))
    states = matrix.list_states(both)
    assert {*states[0].ids} == {"effective_track", "lateral_skid"}
    for name, value in (("effective_track", 1.3), ("lateral_skid", 0.3)):
        effect = states[0].find(name)
        assert effect is not None
        assert next(iter(effect.values.values())) == pytest.approx(value, rel=0.25)
    assert (
        matrix.expect_change(both) < matrix.expect_change(Move().add(ids.index("effective_track"))) < -100.0
    )
    assert not np.isfinite(matrix.measure(both.add(ids.index("effective_track"))))


def test_derivatives_are_as_wide_as_the_data_resolve() -> None:
    """A narrow one sees one side of each kink of the cost."""
    path = search(drive({"effective_track": 1.3}), names=("effective_track",))[0].path
    (number,) = (one for one in path.list_free(fit_path(path, _start_track(path)).state) if one.effect)
    assert number.list_ends(1.3, 0.02) == pytest.approx((1.28, 1.32))
    assert number.list_ends(1.3) == pytest.approx((1.3 - number.step, 1.3 + number.step))
    low, high = number.bounds
    assert number.list_ends(low, 0.02) == pytest.approx((low + max(0.02, number.step),))
    assert number.list_ends(high, 0.02) == pytest.approx((high - max(0.02, number.step),))
    # What the data hardly resolve is not looked for far away.
    (below, above) = number.list_ends(1.3, 1e9)
    assert above - 1.3 == pytest.approx(1.3 - below) == pytest.approx(0.2 * 1.3 + number.step)


def test_a_refusal_says_why() -> None:
    run = drive({"effective_track": 1.6})
    reasons = {
        effect.id: judge_alone(run, effect).refusal
        for effect in (
            find_effect("effective_track")(k=1.5),
            find_effect("lateral_drift")(c=0.01),
            find_effect("turning_resistance")(k=0.05),
        )
    }
    assert reasons["effective_track"] == ""
    assert "t = " in reasons["lateral_drift"]
    assert reasons["turning_resistance"]


def test_a_limit_counts_by_its_inverse_and_several_numbers_cost_evidence() -> None:
    limit, change = find_effect("body_speed_limit")(limit=2.0), find_effect("side_lag")
    sides = change(tau_left=0.3, tau_right=0.4)

    def make_fit(effect: Effect, *errors: float) -> PathFit:
        state = ModelState((effect,), (Timing(),))
        free = tuple(number for number in state.list_free(()) if number.effect)
        return SimpleNamespace(free=free, state=state, covariance=np.diag(np.square(errors)))  # type: ignore[return-value]

    # No limit is at infinity: a limit that is known to a tenth is ten standard errors from none.
    assert measure_t(make_fit(limit, 0.2), limit) == pytest.approx(10.0)
    assert measure_t(make_fit(sides, 0.1, 0.1), sides) ** 2 == pytest.approx(9.0 + 16.0 - 1.0)


def test_blocks_are_held_out_of_one_run_and_runs_of_three() -> None:
    runs = [drive({}, seed=seed, duration_s=45.0) for seed in range(3)]
    one = search(runs[0], names=("effective_track",))[0].path
    assert [np.unique(make_folds(one)[one.block == block]).size for block in range(int(one.block.max()) + 1)]
    three = search(*runs, names=("effective_track",))[0].path
    folds = make_folds(three)
    assert all(np.unique(folds[three.run == run]).size == 1 for run in range(3))
    assert np.unique(folds).size == 3


def _push_sideways(moment: Moment) -> tuple[float, float, float]:
    """What no effect of the catalogue does."""
    return 0.0, 0.15 * abs(moment.w0), 0.0


def test_what_only_a_formula_explains_is_one() -> None:
    made, found, _ = search(drive({}, duration_s=150.0, extra=_push_sideways))
    kept, formula = search_formula(made, found, sideways=False)
    assert kept.final.ids == ()
    assert formula is not None
    assert formula.formulas == {"v_y": "k_1 * abs(w0)"}
    assert formula.values["k_1"] == pytest.approx(0.15, abs=0.03)


def _turn_short_to_the_right(moment: Moment) -> tuple[float, float, float]:
    """What a track that depends on the speed imitates, and does worse."""
    return 0.0, 0.0, -0.3 * min(moment.w0, 0.0)


def test_effects_that_only_imitate_what_a_formula_describes_go() -> None:
    made, found, _ = search(drive({}, duration_s=180.0, extra=_turn_short_to_the_right))
    assert found.new
    kept, formula = search_formula(made, found, sideways=False)
    assert kept.final.ids == ()
    assert formula is not None
    assert formula.formulas == {"v_w": "k_1 * (w0 - abs(w0))"}
    assert formula.values["k_1"] == pytest.approx(-0.15, abs=0.02)


def test_a_formula_takes_the_place_of_what_imitates_it_and_of_nothing_else() -> None:
    made, found, _ = search(drive({"effective_track": 1.3}, duration_s=150.0, extra=_push_sideways))
    assert {"effective_track", "lateral_drift"} <= set(found.new)
    kept, formula = search_formula(made, found, sideways=False)
    assert kept.final.ids == ("effective_track",)
    assert formula is not None
    assert formula.formulas == {"v_y": "k_1 * abs(w0)"}


def test_a_term_that_an_effect_of_the_catalogue_explains_as_well_is_no_formula() -> None:
    made, found, _ = search(drive({"turning_resistance": 0.2}))
    assert found.new == ("turning_resistance",)
    assert search_formula(made, found, sideways=False) == (found, None)
    # Not even where it was not accepted.
    start = found.start
    refused = replace(found, final=start, new=(), judged={}, matrix=made.make_matrix(start))
    assert search_formula(made, refused, sideways=False)[1] is None
