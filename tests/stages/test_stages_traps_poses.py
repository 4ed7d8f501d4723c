"""Traps on the way from poses to velocities; the numbers are those of the list of known traps."""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from stage_logs import EXACT, FIELD, ICP, PLAIN, TakeThrough, rms, slope

from pipeline.core import rigid
from pipeline.recording.pose_topics import cut_track
from pipeline.run import Alignment, Track
from pipeline.run.signals import DriveSeries
from pipeline.simulate import VEHICLES, Ground, Program, Recording
from pipeline.sources import Configuration
from pipeline.stages.timing import _take_off
from pipeline.stages.velocity import compute_velocities
from pipeline.words import format_finding

SETTINGS = Configuration().velocity


def test_trap_1_held_poses_do_not_double_velocities(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, pose=replace(ICP, update_hz=5.0)))
    assert taken.finding("held_poses").value == pytest.approx(0.75, abs=0.01)
    assert float(np.abs(taken.velocities["v_x"].to_numpy()).max()) < 1.2  # a 1 m/s Husky
    fast = taken.slip("measured").filter(~pl.col("transitory"))
    assert rms(fast["g_x"]) < 0.05


@pytest.mark.parametrize(("period", "said"), [(1.0, {"slow_poses"}), (0.1, set())])
def test_trap_1_poses_that_are_too_slow_are_said_to_be_and_rest_is_no_repeat(
    period: float, said: set[str]
) -> None:
    times = np.arange(0.0, 60.0, period)
    # It stands for half of the time: its poses are the same then, and new.
    position = np.outer(np.minimum(0.3 * times, 9.0), [1.0, 0.0, 0.0])
    quaternion = np.tile([0.0, 0.0, 0.0, 1.0], (times.size, 1))
    track = cut_track(times, position, quaternion, np.zeros(times.size, dtype=bool), SETTINGS, "/amcl_pose")
    assert {finding.id for finding in track.findings} == said


def test_trap_1_a_standing_vehicle_is_no_gap_and_has_no_velocity(drive: TakeThrough) -> None:
    standing = replace(PLAIN, program=Program("stop_and_go"), pose=replace(EXACT, update_hz=5.0))
    taken = drive(standing)
    assert taken.velocities["segment"].n_unique() == 1
    # Every other step of 6 s stands; after 2 s the lag has died away.
    still = taken.velocities.filter(((pl.col("t") % 12.0) > 2.5) & ((pl.col("t") % 12.0) < 5.0))
    assert float(np.abs(still.select("v_x", "v_y", "v_w").to_numpy()).max()) < 0.02


def test_trap_2_a_circle_has_no_lateral_velocity(drive: TakeThrough) -> None:
    slow = replace(PLAIN, program=Program("circle"), pose=replace(EXACT, rate_hz=4.0))
    taken = drive(slow)
    steady = taken.velocities.filter((pl.col("t") > 5.0) & (pl.col("t") < 55.0))
    # Differencing in the frame of the start would give dt v w / 2 = 0.045 m/s.
    assert float(np.abs(steady["v_y"].to_numpy()).max()) < 1e-3
    assert steady["v_x"].mean() == pytest.approx(0.6, rel=2e-3)


@pytest.mark.parametrize("ground", [Ground(pitch_rad=math.radians(9.0)), Ground(roll_rad=math.radians(9.0))])
def test_trap_2_a_tilted_plane_changes_neither_speed_nor_turning(drive: TakeThrough, ground: Ground) -> None:
    taken = drive(replace(PLAIN, program=Program("circle"), pose=EXACT, ground=ground))
    steady = taken.slip("measured").filter((pl.col("t") > 5.0) & (pl.col("t") < 55.0))
    # In the plane of the map both would be 1.2 % too small.
    assert slope(steady["f_x"], steady["v_x"]) == pytest.approx(1.0, abs=2e-3)
    assert slope(steady["f_w"], steady["v_w"]) == pytest.approx(1.0, abs=2e-3)


def test_trap_3_a_late_heading_is_found_and_said(drive: TakeThrough) -> None:
    taken = drive(replace(FIELD, duration_s=120.0, effects={"heading_skew": 0.12, "drive_lag": 0.3}))
    assert taken.finding("heading_skew").value == pytest.approx(0.12, abs=0.03)


def test_trap_4_a_motion_at_a_third_of_a_hertz_is_kept(drive: TakeThrough) -> None:
    # The slalom's turn is a sine of period 2 step_s: 0.36 Hz, where the published spline keeps a half.
    weave = replace(PLAIN, program=Program("slalom", step_s=1.0 / 0.72), pose=EXACT, effects={})
    taken = drive(weave)
    steady = taken.slip("measured").filter((pl.col("t") > 5.0) & (pl.col("t") < 55.0))
    assert slope(steady["f_w"], steady["v_w"]) == pytest.approx(0.936, abs=0.02)


def test_trap_10_a_pose_of_the_lidar_is_moved_to_base_link(drive: TakeThrough) -> None:
    mounted = replace(EXACT, child_frame="lidar", mount_x_m=0.5, mount_y_m=0.1, mount_yaw_rad=0.3)
    taken = drive(replace(PLAIN, pose=mounted))
    assert taken.finding("child_frame").severity == "info"
    assert rms(taken.velocities["v_y"]) < 2e-3  # not moved, 0.5 m of arm gives 0.3 m/s in turns


def test_trap_10_a_chain_with_a_correction_dated_ahead_gives_the_pose(drive: TakeThrough) -> None:
    chained = replace(PLAIN, vehicle=VEHICLES["jackal"], recording=Recording("tf"))
    taken = drive(chained)
    assert "map to base_link" in format_finding(taken.finding("transforms"))
    steady = taken.slip("measured").filter(~pl.col("transitory"))
    assert float(steady["g_x"].abs().median()) < 5e-3
    assert taken.velocities["t"].max() > 59.0


def test_trap_12_invalid_poses_are_told_and_left_out(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, pose=replace(ICP, invalid=6)))
    assert taken.finding("bad_pose").count == 3
    assert taken.finding("bad_quaternion").count == 3
    assert np.isfinite(taken.velocities.select("v_x", "v_y", "v_w").to_numpy()).all()
    assert taken.velocities["segment"].n_unique() == 1


def test_trap_12_a_yaw_that_wraps_is_no_jump_and_no_turn(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, program=Program("spins"), pose=ICP, start_pose=(0.0, 0.0, 3.1)))
    assert "pose_jump" not in taken.ids()
    assert float(np.abs(taken.velocities["v_w"].to_numpy()).max()) < 1.2
    assert float(np.abs(np.diff(taken.velocities["yaw"].to_numpy())).max()) < 0.1


def test_trap_12_a_correction_of_the_map_is_a_cut_not_a_velocity(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, pose=replace(ICP, jumps=3, jump_m=1.0)))
    assert taken.finding("pose_jump").count == 3
    assert taken.velocities["segment"].n_unique() == 4
    assert float(np.abs(taken.velocities["v_x"].to_numpy()).max()) < 1.3


@pytest.mark.parametrize(("run", "count"), [(1, 1), (3, 3), (6, 0)])
def test_poses_that_lie_apart_are_left_out_and_cut_nothing(run: int, count: int) -> None:
    times = np.arange(0.0, 40.0, 0.1)
    yaw = 0.5 * np.sin(0.3 * times)
    place = np.cumsum(0.1 * np.exp(1j * yaw))
    away = slice(200, 200 + run)
    place[away] += 2.0 - 1.0j
    position = np.column_stack([place.real, place.imag, np.zeros(times.size)])
    quaternion = np.column_stack([np.zeros((times.size, 2)), np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    track = cut_track(times, position, quaternion, np.zeros(times.size, dtype=bool), SETTINGS, "/pose")
    told = {one.id: one.count for one in track.findings}
    # A map that is off for longer is a jump of the map, and back.
    assert told == ({"poses_apart": count} if count else {"pose_jump": 2})
    assert int((~track.valid).sum()) == count
    assert np.unique(track.segment[track.valid]).size == (1 if count else 3)


def test_trap_17_jitter_of_the_stamps_cuts_nothing(drive: TakeThrough) -> None:
    jittery = replace(ICP, rate_hz=10.0, jitter_s=0.02, stamp_jitter_s=0.01)
    taken = drive(replace(PLAIN, pose=jittery))
    assert taken.velocities["segment"].n_unique() == 1
    assert taken.warned() == set()
    steady = taken.slip("measured").filter(~pl.col("transitory"))
    assert rms(steady["g_x"]) < 0.1


@pytest.mark.parametrize("vehicle", ["husky", "warthog"])
@pytest.mark.parametrize("update_hz", [None, 5.0])
def test_trap_18_stretches_with_a_rotated_heading_are_found(
    drive: TakeThrough, vehicle: str, update_hz: float | None
) -> None:
    turned = replace(ICP, rotated_stretches=3, update_hz=update_hz)
    taken = drive(replace(FIELD, vehicle=VEHICLES[vehicle], duration_s=180.0, pose=turned))
    found = taken.finding("bad_stretch")
    assert format_finding(found).endswith(": left out of medians and fits")
    # A stretch that falls into slow driving cannot be told, one over two steps may count twice.
    assert found.count is not None
    assert 2 <= found.count <= 6
    # Kinds of faults that this run does not have are not listed.
    assert "a rotated heading" in format_finding(found)
    assert "(0 s)" not in format_finding(found)
    bad = taken.slip("measured").filter(pl.col("suspect"))
    assert float(bad["g_y"].abs().median() or 0.0) > 3.0 * float(
        taken.slip("measured").filter(~pl.col("suspect"))["g_y"].abs().median() or 0.0
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("vehicle", "effects"),
    [
        ("husky", {"effective_track": 1.8}),
        ("husky", {"effective_track": 1.5, "body_inertia": 0.5, "lateral_skid": 0.1}),
        ("warthog", {"effective_track": 1.5, "body_inertia": 0.9, "acceleration_limit": 4.0}),
        ("husky", {"yaw_misalignment": 0.1}),
        ("husky", {"icr_offset": 0.2, "turning_resistance": 0.24}),
    ],
)
def test_trap_18_sliding_is_no_bad_stretch(
    drive: TakeThrough, vehicle: str, effects: dict[str, float]
) -> None:
    taken = drive(replace(FIELD, vehicle=VEHICLES[vehicle], duration_s=180.0, effects=effects))
    assert "bad_stretch" not in taken.ids()


def tabulate_poses(
    times: np.ndarray, position: np.ndarray, quaternion: np.ndarray, segment: np.ndarray, held: np.ndarray
) -> pl.DataFrame:
    return pl.DataFrame(
        {
            "t": times,
            "stamp": np.round(times * 1e9).astype(np.int64),
            "segment": segment.astype(np.int32),
            **{name: position[:, i] for i, name in enumerate("xyz")},
            **{f"q_{name}": quaternion[:, i] for i, name in enumerate("xyzw")},
            "held": held,
            "latency": 0.0 * times,
            "outlier": np.zeros(times.size, dtype=bool),
        }
    )


def make_windowed_poses(steps: int = 5, *, speed: float = 1.0) -> pl.DataFrame:
    """Poses of 6 s steps with a hole of 1 s between, each step going on where the last one ended."""
    pieces = []
    for step in range(steps):
        since = np.arange(120) * 0.05
        way = (step * 6.0 + since) * speed
        pieces.append((step * 7.0 + since, way))
    times = np.concatenate([piece[0] for piece in pieces])
    position = np.stack((np.concatenate([piece[1] for piece in pieces]), 0.0 * times, 0.0 * times), axis=-1)
    quaternion = rigid.quaternions_from_yaw(0.0 * times)
    track = cut_track(times, position, quaternion, np.zeros(times.size, dtype=bool), SETTINGS, "/pose")
    return tabulate_poses(times, track.position, track.quaternion, track.segment, track.held)


def test_repeats_of_a_localization_that_waits_are_no_rest_while_the_wheels_turn() -> None:
    """Rests between jumps had velocities of 20 m/s and more on recordings of a vehicle that reaches 5 m/s."""
    times = np.arange(0.0, 20.0, 0.05)
    updates = np.concatenate((np.arange(0.0, 6.0, 0.15), [6.0, 6.6, 7.3], np.arange(7.45, 20.0, 0.15)))
    last = updates[np.searchsorted(updates, times + 1e-9, side="right") - 1]
    place = np.stack((last, 0.0 * last, 0.0 * last), axis=-1)
    quaternion = rigid.quaternions_from_yaw(0.0 * times)
    whole, held = np.zeros(times.size, dtype=np.int64), rigid.find_held(place, quaternion)
    poses = tabulate_poses(times, place, quaternion, whole, held)
    turns = np.full(times.size, 1.0 / 0.165)
    wheels = DriveSeries(times, turns, turns, 0.0 * turns, None)

    def find_fastest(measured: DriveSeries | None) -> float:
        made = compute_velocities(poses, pl.DataFrame(), Alignment(), SETTINGS, where="x", wheels=measured)
        inner = made.table.filter(pl.col("t").is_between(1.0, 18.0))
        return float(inner["v_x"].abs().max() or 0.0)  # type: ignore[arg-type]

    assert find_fastest(wheels) == pytest.approx(1.0, abs=0.05)
    assert find_fastest(None) > 1.5


def test_corrected_stamps_keep_the_time_of_the_way_between_poses() -> None:
    generator = np.random.default_rng(3)
    times = np.cumsum(generator.uniform(0.1, 0.3, 300))
    path = (4.0 * times).astype(np.complex128)
    zeros = np.zeros(times.size)
    track = Track(
        times=times,
        segment=zeros.astype(np.int64),
        path=path,
        heading=zeros,
        attitude=np.zeros((times.size, 3)),
        position=np.column_stack((path.real, zeros)),
        active=np.ones(times.size, dtype=bool),
    )
    ages = generator.normal(0.0, 0.15, times.size)
    assert np.array_equal(_take_off(track, zeros), times)
    corrected = _take_off(track, ages)
    assert np.diff(corrected).min() > 0.0
    pace = 4.0 * np.diff(times) / np.diff(corrected)
    # The way is driven in the usual time at least, where that is shorter.
    assert pace[np.diff(times) < 0.19].max() < 4.0 * 1.01
    assert np.abs(corrected - (times - ages)).mean() < 0.15


def test_trap_20_steps_with_holes_between_are_segments_of_their_own() -> None:
    made = compute_velocities(make_windowed_poses(), pl.DataFrame(), Alignment(), SETTINGS, where="x").table
    assert made["segment"].n_unique() == 5
    assert made.group_by("segment").len()["len"].to_list() == [120] * 5
    # Across a hole the vehicle did not move: a line drawn there would slow it down.
    assert np.allclose(made["v_x"].to_numpy(), 1.0, atol=1e-6)


def test_a_short_hole_is_bridged_by_nothing_and_reported(drive: TakeThrough) -> None:
    taken = drive(replace(PLAIN, pose=replace(ICP, dropouts=2, dropout_s=1.5)))
    gap = taken.finding("pose_gap")
    assert gap.count == 2
    assert gap.value == pytest.approx(1.55, abs=0.06)
    times = taken.velocities["t"].to_numpy()
    assert int((np.diff(times) > 1.0).sum()) == 2
