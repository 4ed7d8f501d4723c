"""A recorder's clock that is set inside a log: nothing is sized by how far, and nothing else is found."""

import json
import resource
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from few import few
from hypothesis import given
from hypothesis import strategies as st
from stage_logs import FIELD, Taken, TakeThrough, keep_good_rows, record

from pipeline.analysis.work import as_recorded
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.recording.clocks import Recorded, align_clocks
from pipeline.run import Alignment, read_wheels
from pipeline.simulate import Clock, Scenario
from pipeline.stages.align import align_tables
from pipeline.stages.slip_stage import compute_slip
from pipeline.stages.velocity import compute_velocities

SECOND, DAY = 10**9, 86_400 * 10**9
START = 1_700_000_000 * SECOND
STEPS_S = {"30 days": 30 * 86_400.0, "a year": 365 * 86_400.0, "23 years": 23 * 365.25 * 86_400.0}
AT_S = 30.0


def step(by_s: float) -> Scenario:
    """A drive in the middle of which the clock goes ahead, or back."""
    start_ns = Clock().start_ns - round(max(by_s, 0.0) * 1e9)
    return replace(FIELD, clock=Clock(start_ns=start_ns, backward_at_s=AT_S, backward_s=-by_s))


@given(
    st.integers(2 * 3600 * SECOND, 40 * 365 * DAY),
    st.integers(1, 398),
    st.booleans(),
    st.integers(0, SECOND // 10),
)
def test_stamps_of_both_sides_keep_their_times_however_far_the_clock_is_set(
    far: int,
    at: int,
    stamps_go_on: bool,  # noqa: FBT001
    late: int,
) -> None:
    log = START + np.arange(400) * SECOND // 20
    header = log - late
    leaped = np.where(np.arange(400) < at, -far, 0)
    shown = log + leaped
    clocks, findings = align_clocks(
        {
            "pose": Recorded("/pose", shown, shown, header if stamps_go_on else header + leaped),
            "cmd": Recorded("/cmd", shown, shown, None),
        }
    )
    assert [finding.id for finding in findings] == ["clock_jump"]
    gap = SECOND // 20 if stamps_go_on else 10 * SECOND
    for clock, plain in ((clocks["pose"], header), (clocks["cmd"], log)):
        passed = np.diff(clock.stamp)
        assert np.array_equal(np.delete(passed, at - 1), np.delete(np.diff(plain), at - 1))
        # A double has 53 bits for the offset of two clocks.
        assert abs(passed[at - 1] - gap) < 1000
        assert clock.usable.all()
        # What was recorded after the clock was set is right.
        assert np.array_equal(clock.stamp[at:], plain[at:])


@given(st.integers(0, 3300), st.integers(1, 398))
def test_a_hole_shorter_than_an_hour_is_a_hole(hole_s: int, at: int) -> None:
    log = START + np.arange(400) * SECOND // 20
    log[at:] += hole_s * SECOND
    clocks, findings = align_clocks({"cmd": Recorded("/cmd", log, log, None)})
    assert np.array_equal(clocks["cmd"].stamp, log)
    assert findings == []


@pytest.mark.parametrize(
    "far", few([*STEPS_S.values(), -STEPS_S["30 days"]], 3), ids=[*STEPS_S, "30 days back"]
)
def test_slip_is_that_of_a_clock_that_was_right(drive: TakeThrough, far: float) -> None:
    plain, taken = drive(FIELD), drive(step(far))
    assert taken.finding("clock_jump").value == pytest.approx(abs(far), rel=1e-3)
    assert taken.velocities.height == pytest.approx(plain.velocities.height, abs=20)
    assert taken.velocities["t"].max() == pytest.approx(60.0 + 10.0, abs=1.0)
    for name in ("command", "measured"):
        usual = float(np.median(plain.slip(name)["modulus"]))
        assert float(np.median(taken.slip(name)["modulus"])) == pytest.approx(usual, rel=0.03)


def hold_open(taken: Taken, hole_s: float) -> dict[str, pl.DataFrame]:
    """Tables as extracted, with a hole that no clock explains, or that single messages keep open."""
    later = pl.when(pl.col("t") > AT_S).then(pl.col("t") + hole_s).otherwise(pl.col("t"))
    tables = {}
    for name, frame in taken.extracted.tables.items():
        table = keep_good_rows(name, as_recorded(name, frame)).with_columns(later.alias("t"))
        if name == "poses":
            # The stage that reads the poses cuts a segment at a gap.
            table = table.with_columns((pl.col("t") > AT_S).cast(pl.Int32).alias("segment"))
        tables[name] = table
    return tables


def find_effects(taken: Taken, tables: dict[str, pl.DataFrame]) -> tuple[set[str], dict[str, int]]:
    """Effects that are found, and the most memory of the stages and of the diagnosis [bytes]."""
    peaks = {}
    tracemalloc.start()
    aligned = align_tables(tables, taken.aligned.vehicle, Alignment(), body_commanded=False, where="test")
    tables, vehicle = dict(aligned.tables), aligned.vehicle
    motion = compute_velocities(
        tables["poses"],
        tables["imu"],
        aligned.alignment,
        taken.configuration.velocity,
        where="test",
        wheels=read_wheels(tables["wheels"], vehicle),
    )
    tables["slip"] = compute_slip(
        motion.table,
        tables,
        vehicle=vehicle,
        configuration=taken.configuration,
        hold_s=aligned.alignment.hold_s,
        inputs=("command", "measured"),
        where="test",
    ).slip
    peaks["stages"] = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    (run,) = diagnose_runs([DiagnosisInput("test", tables)], vehicle).runs
    peaks["diagnosis"] = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {effect.id for effect in run.effects}, peaks


@pytest.mark.long
def test_no_array_is_sized_by_a_hole(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, duration_s=40.0))
    effects, peaks = find_effects(taken, hold_open(taken, 0.0))
    assert {"drive_lag", "effective_track"} <= effects
    found, needed = find_effects(taken, hold_open(taken, STEPS_S["23 years"]))
    assert found == effects
    for name, peak in peaks.items():
        assert needed[name] < 1.3 * peak


@pytest.mark.long
@pytest.mark.parametrize(
    "odd", [replace(FIELD, clock=Clock(unset_s=AT_S)), step(STEPS_S["23 years"])], ids=["zero", "23 years"]
)
def test_the_whole_program_needs_little_memory_when_a_clock_is_set(odd: Scenario, tmp_path: Path) -> None:
    answers = []
    for number, scenario in enumerate((FIELD, odd)):
        log = record(scenario, tmp_path / f"run_{number}.mcap")
        told = subprocess.run(
            [sys.executable, "-m", "pipeline", "analyze", log, "--json", "--results", tmp_path / "results"],
            capture_output=True,
            check=True,
            env={"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30)),
        )
        (run,) = json.loads(told.stdout)["runs"]
        assert run["log"]["duration_s"] == pytest.approx(60.0, abs=0.5)
        answers.append({effect["id"] for effect in run["diagnosis"]["effects"]})
    assert answers[0] == answers[1]


@pytest.mark.parametrize(
    ("ahead_ms", "late_ms", "is_set"),
    [((0, 300), (30, 30), True), ((300, 0), (30, 30), True), ((0, 0), (400, 30), False)],
    ids=["ahead", "back", "a delay ends"],
)
def test_a_clock_that_is_set_ahead_by_less_than_delays_shows_by_stamps_of_the_future(
    ahead_ms: tuple[int, int], late_ms: tuple[int, int], *, is_set: bool
) -> None:
    """A track of 1.3 was named 1.6 beside a clock that was set ahead by half a second."""
    moment = START + np.arange(600) * SECOND // 10
    first = np.arange(600) < 250
    header = moment + np.where(first, *ahead_ms) * 10**6
    log = moment + np.where(first, *late_ms) * 10**6
    clocks, findings = align_clocks({"pose": Recorded("/pose", log, log, header)})
    right = moment if is_set else header
    assert (clocks["pose"].stamp == right).all()
    assert {one.id for one in findings} == ({"clock_jump"} if is_set else set())
