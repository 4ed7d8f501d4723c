"""Events in motion: what a user is promised of wheels that dig in or spin, and of a body that slides."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from few import few
from incidents import TRACTION, Incident, IncidentKind, simulate_incidents

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.run.signals import Limits, trace_traction
from pipeline.simulate import VEHICLES, Scenario, write_log
from pipeline.simulate.scenario import Commands
from pipeline.sources import find_preset
from pipeline.stages.inputs import Ideal
from pipeline.stages.motion_events import find_events
from pipeline.stages.spans import Spans

STEP_S = 0.05
LIMITS = vars(Limits(live=0.1, margin=0.25))


def trace(wheels: np.ndarray, share: np.ndarray, turning: float = 0.0) -> list[int]:
    size = wheels.size
    return trace_traction(wheels.tolist(), [turning] * size, (wheels * share).tolist(), STEP_S, **LIMITS)


def first(codes: list[int], code: int) -> float:
    return codes.index(code) * STEP_S


def test_wheels_that_dig_in_are_told_before_the_vehicle_stands() -> None:
    times = np.arange(0.0, 20.0, STEP_S)
    for falls_s in (4.0, 6.0, 8.0):
        share = np.clip(1.0 - (times - 8.0) / falls_s, 0.0, 1.0)
        codes = trace(np.ones(times.size), share)
        assert 8.0 + 0.5 * falls_s < first(codes, 1) < 8.0 + falls_s


def test_wheels_in_the_air_spin() -> None:
    times = np.arange(0.0, 20.0, STEP_S)
    codes = trace(np.full(times.size, -0.8), (times < 8.0).astype(float))
    assert first(codes, 2) - 8.0 == pytest.approx(LIMITS["hold_s"], abs=0.15)
    assert 1 not in codes
    # From a stand nothing falls: they bring nothing from the beginning.
    wheels = np.where(times > 8.0, 0.8, 0.0)
    assert set(trace(wheels, np.zeros(times.size))) == {0, 2}


def test_a_body_on_locked_wheels_slides() -> None:
    times = np.arange(0.0, 20.0, STEP_S)
    wheels = np.where(times < 8.0, 1.0, 0.0)
    codes = trace_traction(wheels.tolist(), [0.0] * times.size, [1.0] * times.size, STEP_S, **LIMITS)
    assert first(codes, 3) - 8.0 == pytest.approx(LIMITS["window_s"] + LIMITS["hold_s"], abs=0.15)


def test_a_slide_that_slows_down_is_told_and_a_jump_of_the_poses_is_not() -> None:
    times = np.arange(0.0, 20.0, STEP_S)
    wheels = np.where(times < 8.0, 0.5, 0.0)
    # Above the margin for 0.9 s once the wheels have stood for the window, and above its half for 1.3 s more.
    slowing = np.where(times < 8.0, 0.5, np.maximum(0.5 - 0.115 * (times - 8.0), 0.0))
    turning = [0.0] * times.size
    assert 3 in trace_traction(wheels.tolist(), turning, slowing.tolist(), STEP_S, **LIMITS)
    jumping = np.where((times > 10.0) & (times < 11.2), 20.0, 0.0)
    assert 3 not in trace_traction([0.0] * times.size, turning, jumping.tolist(), STEP_S, **LIMITS)


@pytest.mark.parametrize("tau", [0.2, 0.6])
def test_steps_of_commands_and_turns_are_no_event(tau: float) -> None:
    times = np.arange(0.0, 120.0, STEP_S)
    wheels = np.where((times // 4.0) % 3 == 0, 1.0, np.where((times // 4.0) % 3 == 1, -0.8, 0.0))
    body, state = [], 0.0
    for wheel in wheels:
        state += (wheel - state) * STEP_S / tau
        body.append(state)
    assert set(trace_traction(wheels.tolist(), [0.0] * times.size, body, STEP_S, **LIMITS)) == {0}
    assert set(trace(np.ones(times.size), np.where(times > 8.0, 0.1, 1.0), turning=1.2)) == {0}


@pytest.mark.parametrize(
    ("forward", "sideways", "said"), [(0.2, -0.95, []), (0.0, 0.9, []), (0.4, 0.0, ["digging_in"])]
)
def test_a_body_that_slides_sideways_does_not_dig_in(
    forward: float, sideways: float, said: list[str]
) -> None:
    vehicle = find_preset("husky_a200")
    times = np.arange(0.0, 60.0, STEP_S)
    # Over two seconds the motion turns from ahead to the side, or is lost.
    part = np.clip((times - 40.0) / 2.0, 0.0, 1.0) * (times < 46.0)
    v_x, v_y = 1.0 + part * (forward - 1.0), part * sideways
    columns = {"t": times, "v_x": v_x, "v_y": v_y, "v_w": 0.0 * times, "x": times, "y": times}
    wheels = np.column_stack((np.ones(times.size), np.zeros((times.size, 2))))
    flags = np.zeros(times.size, dtype=bool)
    inputs = {"measured": Ideal(wheels, flags, ~flags)}
    assert (
        find_events(pl.DataFrame(columns), inputs, vehicle, Spans(flags, flags)).table["kind"].to_list()
        == said
    )


def test_a_sensor_ahead_of_the_axles_is_not_seen_to_slide_in_turns() -> None:
    vehicle = find_preset("husky_a200")
    times = np.arange(0.0, 60.0, STEP_S)
    turns = np.where((times > 30.0) & (times < 40.0), 1.0, 0.0)
    columns = {"t": times, "v_x": 1.0 - turns, "v_y": turns, "v_w": turns, "x": times, "y": times}
    wheels = np.column_stack((1.0 - turns, 0.0 * turns, turns))
    flags = np.zeros(times.size, dtype=bool)
    inputs = {"measured": Ideal(wheels, flags, ~flags)}
    assert find_events(pl.DataFrame(columns), inputs, vehicle, Spans(flags, flags)).findings == ()


def test_a_body_of_a_short_drive_that_lags_behind_its_wheels_does_not_slide() -> None:
    """Of less than two seconds of driving no usual ratio was known, and any motion was more than none."""
    times = np.arange(0.0, 3.0, STEP_S)
    wheels = np.clip(4.0 * (times - 0.5), 0.0, 4.0) * (times < 2.3)
    flags, still = np.zeros(times.size, dtype=bool), np.zeros(times.size)
    columns = {"t": times, "v_x": 0.6 * wheels, "v_y": still, "v_w": still, "x": times, "y": still}
    inputs = {"measured": Ideal(np.column_stack((wheels, still, still)), flags, ~flags)}
    made = find_events(pl.DataFrame(columns), inputs, find_preset("f1tenth"), Spans(flags, flags))
    assert made.findings == ()


def make_log(path: Path, kind: IncidentKind, *times: tuple[float, float]) -> Path:
    at = np.arange(0.0, 89.0, 0.1)
    ahead = Commands(at, np.where(at % 30.0 < 27.0, 0.6, 0.0), 0.3 * (at % 30.0 < 8.0))
    incidents = tuple(Incident(kind, *one) for one in times)
    scenario = Scenario(VEHICLES["husky"], played=ahead, duration_s=90.0, seed=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_log(simulate_incidents(scenario, *incidents), path)
    return path


@pytest.mark.parametrize("kind", few(TRACTION, 2))
def test_an_event_of_a_log_stands_in_its_table_its_findings_and_its_report(
    tmp_path: Path, kind: IncidentKind
) -> None:
    log = make_log(tmp_path / "run.mcap", kind, (42.0, 50.0))
    outcome = analyze_log(log, Options(out=tmp_path / "out", diagnosis=False))
    events = outcome.manifest.read("events").filter(pl.col("kind") == kind)
    row = events.row(0, named=True)
    begins = 42.0 + (0.15 * 8.0 if kind == "digging_in" else 0.0)
    assert row["t_start"] == pytest.approx(begins, abs=1.0)
    assert row["t_start"] < row["t_known"] < row["t_end"] + 0.1
    assert 0.5 < row["size"] <= 1.0
    poses = outcome.manifest.read("poses")
    near = poses.row(int((poses["t"] - row["t_start"]).abs().arg_min() or 0), named=True)
    assert np.hypot(near["x"] - row["x"], near["y"] - row["y"]) < 0.2
    (finding,) = [one for one in outcome.summary["findings"] if one["id"] == kind]
    assert finding["t_start"] == pytest.approx(row["t_start"])
    report = outcome.manifest.path("report.html").read_text(encoding="utf-8")
    assert finding["text"][1:] in report
    assert kind.replace("_", " ") in report
