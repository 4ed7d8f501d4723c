"""Traps of time: clocks, latencies, the gyro as the better clock."""

from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from clocks import BunchedClock, SimulatedClock, forget_stamps, lose_between
from few import few
from hypothesis import example, given
from hypothesis import strategies as st
from stage_logs import EXACT, FIELD, PLAIN, TakeThrough, rms

from pipeline.analysis.work import as_recorded
from pipeline.recording.clocks import Recorded, align_clocks
from pipeline.run import Alignment
from pipeline.simulate import Clock, Encoders, Imu, Program, Recording, Scenario
from pipeline.stages.align import align_tables
from pipeline.stages.trust import estimate_delay
from pipeline.words import format_finding

SECOND = 10**9
START = 1_700_000_000 * SECOND
EVERY_50_MS = np.arange(400) * SECOND // 20


def recorded(
    log: np.ndarray, header: np.ndarray | None, *, clock: str | None = None, topic: str = "/pose"
) -> Recorded:
    return Recorded(topic, log, log, header, clock)


def align(**topics: Recorded) -> tuple[dict[str, np.ndarray], set[str]]:
    clocks, findings = align_clocks(topics)
    return {key: clock.stamp for key, clock in clocks.items()}, {finding.id for finding in findings}


def test_trap_5_a_clock_that_goes_back_is_put_right_and_the_segment_ends() -> None:
    log = START + EVERY_50_MS
    header = log - SECOND // 10
    header[200:] -= 3 * SECOND
    clocks, findings = align_clocks({"pose": recorded(log, header)})
    assert np.array_equal(np.diff(clocks["pose"].stamp), np.diff(log))
    assert clocks["pose"].breaks == (int(log[200]),)
    assert [(finding.id, finding.value) for finding in findings] == [("clock_jump", pytest.approx(3.0))]


def test_trap_5_a_clock_that_leaps_ahead_is_put_right() -> None:
    log = START + EVERY_50_MS
    header = log.copy()
    header[300:] += 40 * SECOND
    stamps, ids = align(pose=recorded(log, header))
    assert np.array_equal(stamps["pose"], log)
    assert ids == {"clock_jump"}


def test_trap_5_a_hole_in_the_recording_is_no_clock_jump() -> None:
    log = START + EVERY_50_MS
    log[200:] += 30 * SECOND
    stamps, ids = align(pose=recorded(log, log - SECOND // 20))
    assert np.array_equal(stamps["pose"], log - SECOND // 20)
    assert ids == set()


def test_trap_5_stamps_from_before_the_clock_was_set_are_placed_by_their_log_times() -> None:
    log = START + EVERY_50_MS
    header = log.copy()
    header[:100] = EVERY_50_MS[:100]
    stamps, ids = align(pose=recorded(log, header))
    assert np.allclose(stamps["pose"], log, atol=1000)
    assert ids == {"clock_unset"}


def test_trap_5_stamps_later_than_their_log_times_prove_a_clock_error() -> None:
    log = START + EVERY_50_MS
    _, findings = align_clocks({"pose": recorded(log, log + SECOND // 5)})
    assert [(finding.id, finding.value) for finding in findings] == [
        ("stamp_after_log_time", pytest.approx(-0.2))
    ]


@pytest.mark.parametrize("stamp", [0, START], ids=["zero", "of the start"])
def test_trap_5_header_stamps_that_are_all_the_same_are_said_and_replaced(stamp: int) -> None:
    log = START + EVERY_50_MS
    stamps, ids = align(pose=recorded(log, np.full_like(log, stamp)))
    assert np.array_equal(stamps["pose"], log)
    assert ids == {"no_header_stamp"}


def test_trap_5_clocks_far_apart_are_joined_through_the_log_time() -> None:
    log = START + EVERY_50_MS
    stamps, ids = align(
        pose=recorded(log, log - SECOND // 50, topic="/pose"),
        imu=recorded(log, log - 100 * SECOND, topic="/imu"),
        wheels=recorded(log, log - SECOND // 50, topic="/joint_states"),
    )
    assert ids == {"clock_offset"}
    assert np.abs(stamps["imu"] - stamps["pose"]).max() < SECOND // 100


def test_trap_5_stamps_of_simulated_time_meet_topics_without_any() -> None:
    log = START + EVERY_50_MS
    stamps, ids = align(
        pose=recorded(log, EVERY_50_MS + SECOND, topic="/pose"), cmd=recorded(log, None, topic="/cmd_vel")
    )
    assert ids == {"clock_offset"}
    assert np.array_equal(stamps["cmd"], stamps["pose"])


@pytest.mark.parametrize("ppm", few([50.0, -50.0, 200.0], 2))
def test_trap_5_computers_that_run_apart_are_brought_together(ppm: float) -> None:
    generator = np.random.default_rng(3)
    sent = np.arange(24_000) * SECOND // 20
    late = (generator.uniform(0.002, 0.03, sent.size) * SECOND).astype(np.int64)
    header = START + sent + np.rint(sent * ppm * 1e-6).astype(np.int64)
    stamps, ids = align(
        imu=recorded(START + sent + late, header, topic="/imu"),
        # Too uneven to tell on its own.
        pose=recorded(START + sent[::10] + 20 * late[::10], header[::10], topic="/pose"),
        cmd=recorded(START + sent + SECOND // 500, None, topic="/cmd_vel"),
    )
    assert ids == {"clock_drift"}
    for name, step in (("imu", 1), ("pose", 10)):
        assert np.abs(stamps[name] - START - sent[::step]).max() < 8e-3 * SECOND
    assert np.array_equal(stamps["cmd"], START + sent + SECOND // 500)


@given(st.floats(0.0, 0.2), st.floats(2.0, 60.0), st.integers(0, 10**6))
@example(0.1875, 15.25, 0)
def test_trap_5_delays_that_vary_are_no_drift(spread: float, period_s: float, seed: int) -> None:
    header = START + np.arange(6_000) * SECOND // 10
    busy = np.abs(np.sin((header - START) / SECOND / period_s))
    noise = np.random.default_rng(seed).exponential(0.01, header.size)
    log = np.sort(header + ((0.02 + spread * busy + noise) * SECOND).astype(np.int64))
    _, ids = align(pose=recorded(log, header))
    assert ids == set()


@pytest.mark.parametrize("period_s", few([0.02, 0.05, 0.1], 2))
def test_trap_5_what_a_bridge_holds_up_is_put_back_to_its_pace(period_s: float) -> None:
    sent = START + (np.arange(3000) * period_s * SECOND).astype(np.int64)
    sent[1500:] += 30 * SECOND
    ends = START + np.cumsum(np.random.default_rng(5).uniform(0.05, 0.25, 5000) * SECOND).astype(np.int64)
    clocks, findings = align_clocks(
        {"cmd": recorded(ends[np.searchsorted(ends, sent)], None, topic="/cmd_vel")}
    )
    assert [finding.id for finding in findings] == ["bunched_times"]
    error = clocks["cmd"].stamp - sent
    assert np.quantile(np.abs(error), 0.9) < 0.04 * SECOND
    assert abs(float(np.median(error))) < 0.02 * SECOND


@pytest.mark.parametrize("seed", few(range(3), 3))
def test_trap_5_commands_of_a_joystick_are_no_bunches(seed: int) -> None:
    generator = np.random.default_rng(seed)
    log = START + np.cumsum(generator.exponential(0.05, 2000) * SECOND).astype(np.int64)
    twice = np.sort(np.concatenate((log, log + 1000)))
    for times in (log, twice):
        stamps, ids = align(cmd=recorded(times, None, topic="/cmd_vel"))
        assert ids == set()
        assert np.array_equal(stamps["cmd"], times)


@given(st.floats(0.0, 0.3), st.integers(0, 10**6))
def test_trap_5_plain_latency_changes_no_stamp(latency: float, seed: int) -> None:
    header = START + EVERY_50_MS
    noise = np.random.default_rng(seed).uniform(0.0, 0.1, header.size)
    log = np.sort(header + ((latency + noise) * SECOND).astype(np.int64))
    stamps, ids = align(pose=recorded(log, header))
    assert np.array_equal(stamps["pose"], header)
    assert ids == set()


@pytest.mark.parametrize("clock", ["log", "publish", "header"])
def test_trap_5_the_configured_time_is_taken(clock: str) -> None:
    header = START + EVERY_50_MS
    times = Recorded("/pose", header + 2 * SECOND // 10, header + SECOND // 10, header, clock)
    clocks, _ = align_clocks({"pose": times})
    offset = {"log": 2, "publish": 1, "header": 0}[clock]
    assert np.array_equal(clocks["pose"].stamp, header + offset * SECOND // 10)


@pytest.fixture(scope="module")
def unstamped() -> Scenario:
    """A robot whose commands have no stamps."""
    return replace(FIELD, recording=Recording("tf"), program=Program())


@pytest.mark.parametrize(
    ("clock", "noticed"),
    [
        (SimulatedClock(), "clock_offset"),
        (SimulatedClock(factor=0.6, swing=0.5), "simulated_time"),
        (SimulatedClock(factor=0.6, bunch_s=0.2), "bunched_times"),
        *(
            pytest.param(clock, noticed, marks=pytest.mark.long)
            for clock, noticed in (
                (SimulatedClock(swing=0.5), "simulated_time"),
                (SimulatedClock(factor=0.6), "simulated_time"),
                (SimulatedClock(factor=0.05), "simulated_time"),
                (BunchedClock(), "bunched_times"),
            )
        ),
    ],
    ids=["factor 1", "swings about .6", "both", "swings about 1", "factor .6", "factor .05", "bridge"],
)
def test_trap_5_slip_is_that_of_a_log_with_one_clock(
    drive: TakeThrough, unstamped: Scenario, clock: Clock, noticed: str
) -> None:
    plain, taken = drive(unstamped), drive(replace(unstamped, clock=clock))
    assert noticed in taken.ids()
    assert noticed not in plain.ids()
    if getattr(clock, "factor", 1.0) != 1.0:
        # The default screen shows warnings: on a robot, all speeds are wrong by this factor.
        assert "simulated_time" in taken.warned()
    for name in ("command", "measured"):
        usual = float(np.median(plain.slip(name)["modulus"]))
        assert float(np.median(taken.slip(name)["modulus"])) == pytest.approx(usual, rel=0.02)


def test_trap_5_topics_whose_stamps_are_zero_have_log_times(drive: TakeThrough, unstamped: Scenario) -> None:
    zero = replace(unstamped.recording, lose=partial(forget_stamps, ("/joint_states", "/imu/data")))
    for clock in (Clock(), SimulatedClock(factor=0.6)):
        taken = drive(replace(unstamped, recording=zero, clock=clock))
        plain = drive(unstamped)
        assert "no_header_stamp" in taken.ids()
        usual = float(np.median(plain.slip("measured")["modulus"]))
        assert float(np.median(taken.slip("measured")["modulus"])) == pytest.approx(usual, rel=0.02)


def test_trap_5_a_recorder_whose_clock_goes_back_mixes_nothing(drive: TakeThrough) -> None:
    back = Clock(backward_at_s=40.0, backward_s=3.0)
    taken = drive(replace(FIELD, duration_s=80.0, clock=back))
    assert taken.finding("clock_jump").value == pytest.approx(3.0, abs=0.6)
    assert "pose_jump" not in taken.ids()
    assert "imu_disagrees" not in taken.ids()
    times = taken.velocities["t"].to_numpy()
    assert not ((times > 37.5) & (times < 39.5)).any()
    assert float(np.abs(taken.velocities["v_x"].to_numpy()).max()) < 1.3


def test_trap_5_a_hole_in_everything_is_crossed_by_nothing(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, recording=Recording(lose=partial(lose_between, 25.0, 28.0))))
    assert taken.velocities["segment"].n_unique() == 2
    for windows in (taken.windows("command"), taken.windows("measured")):
        spans = windows["t_end"] - windows["t_start"]
        assert spans.max() == pytest.approx(2.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_trap_6_the_sign_of_the_gyro_is_checked_and_corrected(drive: TakeThrough, sign: int) -> None:
    taken = drive(replace(FIELD, imu=Imu(sign=sign)))  # type: ignore[arg-type]
    assert ("imu_sign" in taken.ids()) == (sign < 0)
    velocities = taken.velocities
    assert rms(velocities["v_w_imu"] - velocities["v_w"]) < 0.03


def test_trap_6_a_sign_of_the_gyro_that_is_written_counts(drive: TakeThrough) -> None:
    """The gyro was inverted without the line that does it, and there was none."""
    inverted = replace(FIELD, imu=Imu(sign=-1))
    assert "sign = -1 under [imu]" in format_finding(drive(inverted).finding("imu_sign"))
    written = drive(inverted, {"imu": {"sign": -1}})
    assert not written.ids() & {"imu_sign", "imu_disagrees"}
    assert rms(written.velocities["v_w_imu"] - written.velocities["v_w"]) < 0.03
    kept = drive(inverted, {"imu": {"sign": 1}})
    assert "imu_disagrees" in kept.ids()
    assert "imu_sign" not in kept.ids()


def test_trap_6_scale_and_bias_of_the_gyro_are_found_and_taken_off(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, imu=Imu(scale=0.8, bias_radps=0.05)))
    assert taken.finding("imu_scale").value == pytest.approx(1.25, rel=0.01)
    # Poses = scale x gyro + bias: an offset of 0.05 in the gyro is one of -0.0625 in the poses.
    assert taken.aligned.alignment.gyro.bias == pytest.approx(-0.0625, abs=2e-3)
    assert rms(taken.velocities["v_w_imu"] - taken.velocities["v_w"]) < 0.03


def test_trap_6_the_gyro_fits_alike_whenever_the_recorder_was_started(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, imu=Imu(scale=0.8, bias_radps=0.05)))
    tables = {name: as_recorded(name, frame) for name, frame in taken.extracted.tables.items()}
    fits = []
    for late in (0.0, 12.8, 0.7):
        shifted = {name: frame.with_columns(pl.col("t") + late) for name, frame in tables.items()}
        made = align_tables(shifted, taken.aligned.vehicle, Alignment(), body_commanded=True, where="shifted")
        fits.append((made.alignment.gyro.signed_scale, made.alignment.gyro.bias))
    assert fits[1:] == [pytest.approx(fits[0], rel=1e-9)] * 2


def test_trap_6_a_gyro_that_measures_something_else_is_not_used(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, imu=Imu(scale=0.0, noise_radps=0.2)))
    assert taken.finding("imu_disagrees").severity == "warning"
    assert taken.velocities["v_w_imu"].null_count() == taken.velocities.height


@pytest.mark.parametrize("late", few([-0.1, 0.0, 0.2, 0.35], 2))
def test_trap_15_how_late_the_poses_are_against_the_gyro_is_told(drive: TakeThrough, late: float) -> None:
    taken = drive(replace(FIELD, effects={"drive_lag": 0.3, "clock_offset": late}))
    assert taken.aligned.alignment.gyro is not None
    assert taken.aligned.alignment.heading_delay_s == pytest.approx(late, abs=0.02)
    assert ("pose_delay" in taken.ids()) == (abs(late) > 0.05)


def test_trap_15_the_gyro_gives_the_yaw_rate_at_its_own_clock(drive: TakeThrough) -> None:
    late = replace(PLAIN, pose=EXACT, effects={"drive_lag": 0.3, "clock_offset": 0.3})
    taken = drive(late, {"velocity": {"yaw": "imu"}})
    slip = taken.slip("measured")
    # The wheels are exact: against poses 0.3 s late the slip in turning would be five times as large.
    against_pose = drive(late).slip("measured")
    assert rms(slip["g_w"]) < 0.02
    assert slip["v_x"].equals(against_pose["v_x"])


@pytest.mark.parametrize("late", [0.0, 0.2])
def test_trap_16_late_encoders_are_told(drive: TakeThrough, late: float) -> None:
    taken = drive(replace(FIELD, encoders=Encoders(delay_s=late)))
    if late > 0.0:
        assert taken.finding("wheels_delay").value == pytest.approx(late, abs=0.04)
    else:
        assert "wheels_delay" not in taken.ids()


def test_trap_16_a_body_that_follows_its_wheels_late_is_no_encoder(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, effects={"body_inertia": 0.4}))
    assert "wheels_delay" not in taken.ids()


@given(st.floats(-0.4, 0.4), st.integers(0, 10**6))
def test_a_delay_comes_back_with_its_sign(late: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    times = np.arange(0.0, 60.0, 0.05)
    phases, speeds = generator.uniform(0.0, 6.0, 6), generator.uniform(0.3, 3.0, 6)

    def signal(at: np.ndarray) -> np.ndarray:
        return np.sum(np.sin(speeds[:, None] * at + phases[:, None]), axis=0)

    found = estimate_delay(times, signal(times - late), times, signal(times))
    assert found.seconds == pytest.approx(late, abs=0.01)
    mirrored = estimate_delay(times, -signal(times - late), times, signal(times))
    assert mirrored.correlation < -0.95
