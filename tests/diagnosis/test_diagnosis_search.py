"""What the search owes a user: wrong names that were taken first are given back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from pipeline.analysis.analyze import analyze_log
from pipeline.analysis.diagnosis import read_recording
from pipeline.analysis.options import Options
from pipeline.diagnosis.budget import Budget
from pipeline.diagnosis.context import prepare
from pipeline.diagnosis.recording import load_recording
from pipeline.diagnosis.search import prune, search_effects
from pipeline.diagnosis.selection import open_selection
from pipeline.identification import Input, Problem, fit_model
from pipeline.identification.state import State
from pipeline.models import Model, find_effect
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    Imu,
    PoseSensor,
    Program,
    Scenario,
    simulate_run,
    write_log,
)

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.runs.recording import MotionRun
    from pipeline.vehicles import Vehicle

_LAGS = {"drive_lag": 0.45, "steering_lag": 0.38}
_CAR = Scenario(
    vehicle=VEHICLES["car"],
    effects=_LAGS,
    program=Program("circle", speed_scale=0.4, turn_scale=0.4),
    duration_s=40.0,
    seed=5,
    disturbance=Disturbance(0.01, 0.005),
    pose=PoseSensor(),
    imu=Imu(),
)


def _load(scenario: Scenario, folder: Path) -> tuple[MotionRun, Vehicle]:
    folder.mkdir()
    write_log(simulate_run(scenario), folder / "run.mcap")
    options = Options(out=folder / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(folder / "run.mcap", options).manifest)
    return load_recording(recording, vehicle), vehicle


def test_two_lags_take_the_place_of_the_delay_and_the_limits_that_imitate_them(tmp_path: Path) -> None:
    """Neither lag helps beside the delay alone, and beside both lags the limits are never reached."""
    wrong = ("body_speed_limit", "body_turn_limit", "transport_delay", "steering_gain")
    run, vehicle = _load(_CAR, tmp_path / "car")
    context = prepare([run], vehicle, Input.COMMAND)
    part = context.problem.parts[1]
    begin = context.problem.start_state()
    selection, current = open_selection(part, begin, context.list_drivetrain(), context.conditions, Budget())
    for name in wrong:
        effect = find_effect(name)().make_usual(context.largest)
        current = selection.enter(current.state.add(effect))
    found = search_effects(selection, selection.adapt(current))[0].state
    assert {effect.id: effect.values["tau"] for effect in found.effects} == pytest.approx(_LAGS, abs=0.01)


def test_a_run_without_a_usable_gyro_leaves_the_clock_of_another_run_free(tmp_path: Path) -> None:
    """A straight drive dates nothing by its gyro; the encoders' delay of the turning run went into a lag."""
    runs = []
    for name, seed in (("straight", 3), ("smooth", 4)):
        scenario = replace(
            _CAR,
            vehicle=VEHICLES["jackal"],
            effects={"body_inertia": 0.52},
            program=Program(name),  # type: ignore[arg-type]
            seed=seed,
        )
        run, vehicle = _load(scenario, tmp_path / name)
        runs.append(run)
    problem = Problem(runs, vehicle, Input.MEASURED)
    assert [comparison.has_gyro for comparison in problem.comparisons] == [False, True]
    fitted = fit_model(problem, Model(vehicle, (find_effect("body_inertia")(),)))
    (effect,) = fitted.state.effects
    assert effect.values["tau"] == pytest.approx(0.52, abs=0.004)


_NOTHING = State((), ())


@dataclass(frozen=True)
class _Set:
    """A model of which only its effects and its score matter."""

    ids: tuple[str, ...]
    score: float
    state: State = _NOTHING

    @property
    def numbers(self) -> int:
        return len(self.ids)


class _Scores:
    """A selection in which sets of effects have fixed scores, and what halves the score is preferred."""

    kept = frozenset[str]()
    budget = Budget()
    asked = 0
    least = 0.5

    def __init__(self, **scores: float) -> None:
        self.sets = {tuple(name): _Set(tuple(name), score) for name, score in scores.items()}
        self.sets[()] = _Set((), 100.0)

    def drop_each(self, current: _Set, groups: list[list[str]]) -> list[_Set]:
        return [self.sets[tuple(name for name in current.ids if name not in names)] for names in groups]

    def prefers(self, before: _Set, after: _Set, least_gain: float) -> bool:
        assert least_gain >= 0.0
        return after.score < self.least * before.score

    def adapt(self, tested: _Set) -> _Set:
        return tested

    def suggest(self, base: _Set, count: int, **_: object) -> list[_Set]:
        self.asked += 1
        more = (one for ids, one in self.sets.items() if set(ids) > set(base.ids))
        return sorted(more, key=lambda one: one.score)[:count]


def test_effects_of_which_either_will_do_are_not_both_dropped() -> None:
    scores = _Scores(a=60.0, b=50.0, ab=30.0)
    assert prune(scores, scores.sets["a", "b"]).ids == ("b",)  # type: ignore[arg-type]


def test_a_set_that_was_come_to_before_ends_the_growth() -> None:
    scores = _Scores(a=40.0)

    def adapt(tested: _Set) -> _Set:
        # Under the weights of the model with it, the effect is not missed any more.
        scores.least = 0.1
        return tested

    def suggest(base: _Set, count: int, **_: object) -> list[_Set]:
        scores.asked, scores.least = scores.asked + 1, 0.5
        return [one for one in scores.sets.values() if one is not base][:count]

    scores.adapt, scores.suggest = adapt, suggest  # type: ignore[method-assign]
    found, declined = search_effects(scores, scores.sets[()])  # type: ignore[arg-type]
    assert found.ids == ()
    assert [one.ids for one in declined] == [("a",)]
    assert scores.asked == 1


def test_what_may_not_be_named_once_it_is_in_ends_no_search() -> None:
    """Effect a takes away more than b, but may not be named under its own weights."""
    scores = _Scores(a=20.0, b=45.0)
    for ids, one in scores.sets.items():
        effects = [SimpleNamespace(id=name, price=0.0) for name in ids]
        scores.sets[ids] = replace(one, state=SimpleNamespace(effects=effects))  # type: ignore[arg-type]

    def suggest(base: _Set, count: int, without: set[str], **_: object) -> list[_Set]:
        more = [one for ids, one in scores.sets.items() if len(ids) > len(base.ids)]
        return sorted((one for one in more if not without & set(one.ids)), key=lambda one: one.score)[:count]

    scores.suggest = suggest  # type: ignore[method-assign]
    scores.may_stay = lambda effect, _: effect.id != "a"  # type: ignore[attr-defined]
    found, declined = search_effects(scores, scores.sets[()])  # type: ignore[arg-type]
    assert found.ids == ("b",)
    assert declined == ()
