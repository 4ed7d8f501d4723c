"""Runs without a gyro that are judged together: the clock of each is its own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.estimation import Diagnosis, EstimationData, Input, carry_over, diagnose_runs, load_recording
from pipeline.estimation.ambiguity import read_clocks
from pipeline.estimation.ladder import assess_model
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.models import Number, Timing, find_effect, read_model, write_model
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    PoseSensor,
    Recording,
    Scenario,
    simulate_run,
    write_log,
)
from pipeline.words.diagnosis import describe
from pipeline.words.effects import format_value
from pipeline.words.objects import diagnosis_as_json

if TYPE_CHECKING:
    from pipeline.run import MotionRun
    from pipeline.sources import Vehicle

_CLOCKS = (0.06, 0.14, 0.22)
_SCENE = Scenario(
    vehicle=VEHICLES["husky"],
    duration_s=120.0,
    disturbance=Disturbance(0.02, 0.03),
    pose=PoseSensor(drift_m=0.005),
    imu=None,
)


def _diagnose(
    layout: str, effects: Mapping[str, float], folder: Path
) -> tuple[Diagnosis, list[MotionRun], Vehicle]:
    recordings = []
    for number, late in enumerate(_CLOCKS):
        log = folder / f"run{number}.mcap"
        scene = replace(_SCENE, seed=11 + number, recording=Recording(layout))
        write_log(simulate_run(replace(scene, effects={**effects, "clock_offset": late})), log)
        options = Options(out=folder / "out", report=False, diagnosis=False)
        vehicle, recording = read_recording(analyze_log(log, options).manifest)
        recordings.append(recording)
    runs = [load_recording(recording, vehicle) for recording in recordings]
    return diagnose_runs(recordings, vehicle), runs, vehicle


@pytest.mark.parametrize(
    ("layout", "effects"),
    [("body_command", {}), pytest.param("husky", {"drive_lag": 0.4}, marks=pytest.mark.long)],
    ids=["the command alone", "encoders and a lag"],
)
def test_the_clock_of_each_run_is_told_and_no_effect_stands_for_it(
    layout: str, effects: dict[str, float], tmp_path: Path
) -> None:
    diagnosis, runs, vehicle = _diagnose(layout, effects, tmp_path)
    screen = describe(diagnosis.runs, everything=True)
    for run, late in zip(diagnosis.runs, _CLOCKS, strict=True):
        told = json.loads(json.dumps(diagnosis_as_json(run)))
        named = {effect["id"]: effect["parameters"] for effect in told["effects"]}
        assert set(named) == {*effects, "clock_offset"}
        clock = named["clock_offset"]["d"]
        assert clock["low"] < late < clock["high"]
        assert clock["high"] - clock["low"] < 0.08
        assert told["timing"]["pose_delay_s"] == pytest.approx(clock["value"], abs=1e-4)
        # A value has the digits that its interval supports.
        value, low, high = (clock[name] for name in ("value", "low", "high"))
        assert f"d = {format_value(Number(value, low, high, 's'))} in {run.run}" in screen
    for name, value in effects.items():
        (number,) = named[name].values()
        assert number["low"] < value < number["high"]
        confused = {effect.id: effect.confused_with for effect in diagnosis.runs[0].effects}
        assert name in confused["clock_offset"]
        assert "clock_offset" in confused[name]

    proposal = diagnosis.proposal
    assert proposal is not None
    path = tmp_path / "model.toml"
    write_model(proposal, path)
    file = read_model(path)
    assert file.per_run == ("clock_offset.d",)
    judged = assess_model(EstimationData(runs, vehicle, Input.COMMAND), file.model, per_run=file.per_run)
    own = {item.free.runs: item for item in judged.estimates.items if item.free.effect == "clock_offset"}
    for number, run in enumerate(diagnosis.runs):
        (told_d,) = next(e.parameters.values() for e in run.effects if e.id == "clock_offset")
        (written,) = (e.values["d"] for e in file.find_effects(run.run) if e.id == "clock_offset")
        assert written == pytest.approx(told_d.value, abs=1e-5)
        assert own[number,].value == pytest.approx(told_d.value, abs=2e-4)
    for item in carry_over(file.model, runs, Input.COMMAND, per_run=file.per_run):
        assert item.ratio < 1.05


def test_one_run_has_one_clock_and_runs_with_gyros_are_dated_by_them(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    scene = replace(_SCENE, duration_s=60.0, imu=Scenario().imu)
    write_log(simulate_run(scene), log)
    options = Options(out=tmp_path / "out", report=False, diagnosis=False)
    vehicle, recording = read_recording(analyze_log(log, options).manifest)
    run = load_recording(recording, vehicle)
    blind = replace(run, alignment=replace(run.alignment, gyro=None))
    for runs, clocks in (([blind], ()), ([run, run], ()), ([run, blind], ("clock_offset",))):
        data = EstimationData(runs, vehicle, Input.COMMAND)
        assert all(path.clocks == clocks for path in data.paths)


@pytest.mark.parametrize("named", [("clock_offset",), ()], ids=["proven", "not proven"])
def test_a_heading_is_said_to_be_old_where_the_search_named_it(named: tuple[str, ...]) -> None:
    """A clock that stays in a model without a name was named whatever its size."""
    clock = find_effect("clock_offset")(d=-0.05)
    state = SimpleNamespace(effects=(clock,), effects_of=lambda _: (clock,), timing=(Timing(),))
    alignment = SimpleNamespace(heading_delay_s=0.0)
    run = SimpleNamespace(alignment=alignment, gyro_fit=SimpleNamespace(delay_error_s=0.001))
    data = SimpleNamespace(runs=(run,), has_gyro=True, largest=SimpleNamespace(moves_both_ways=True))
    outcome = SimpleNamespace(
        final=SimpleNamespace(state=state), new=named, start=SimpleNamespace(ids=frozenset())
    )
    clocks = read_clocks(cast("Any", data), cast("Any", outcome), Input.COMMAND)
    assert [one.id for one in clocks.effects] == (["heading_skew"] if named else [])
