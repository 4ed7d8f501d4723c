"""Chains of transforms are what tf would answer, at the stamps of the child."""

# ruff: noqa: ANN401 - columns and messages come in many shapes
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap_files import START

from pipeline.core.rigid import multiply_quaternions, quaternions_from_yaw, rotate
from pipeline.logs import LogError, TransformBuffer, open_log, read_topics, wanted_transforms
from pipeline.logs.writer import LogWriter

KIND = "tf2_msgs/msg/TFMessage"
STEP = 50_000_000


def transforms(parent: str, child: str, position: Any, yaw: Any) -> dict[str, Any]:
    """Fields of transforms with positions (n, 3) and yaw angles (n,)."""
    quaternion = quaternions_from_yaw(np.asarray(yaw, dtype=float))
    found: dict[str, Any] = {"transforms[].header.frame_id": parent, "transforms[].child_frame_id": child}
    for number, axis in enumerate("xyz"):
        found[f"transforms[].transform.translation.{axis}"] = np.asarray(position)[:, number]
    for number, axis in enumerate("xyzw"):
        found[f"transforms[].transform.rotation.{axis}"] = quaternion[:, number]
    return found


def buffer_of(path: Path) -> TransformBuffer:
    index = open_log(path)
    return TransformBuffer(read_topics(index, wanted_transforms(index.types)).topics)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), lead=st.integers(-200_000_000, 800_000_000))
def test_a_chain_is_the_product_of_its_links_at_the_child_stamps(
    tmp_path: Path, seed: int, lead: int
) -> None:
    rng = np.random.default_rng(seed)
    times = START + np.arange(200) * STEP
    slow = times[::20]
    drift, yaw = np.linspace(0.0, 2.0, slow.size), np.linspace(0.0, 0.4, slow.size)
    moved = 0.03 * np.cumsum(rng.normal(size=(200, 3)), axis=0)
    turned = 0.01 * np.cumsum(rng.normal(size=200))
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        correction = transforms("map", "odom", np.stack((drift, -drift, 0 * drift), axis=1), yaw)
        writer.write_columns("/tf", KIND, slow, correction, header_time=slow + lead)
        writer.write_columns(
            "/tf", KIND, times + 7, transforms("odom", "base_link", moved, turned), header_time=times
        )
        fixed = transforms("base_link", "imu", np.array([[0.1, 0.2, 0.3]]), np.array([0.5]))
        writer.write_columns("/tf_static", KIND, times[-1:], fixed)
    buffer = buffer_of(path)
    assert buffer.frames() == ("base_link", "imu", "map", "odom")
    assert buffer.chain("map", "imu") == ("map", "odom", "base_link", "imu")
    assert buffer.chain("imu", "odom") == ("imu", "base_link", "odom")
    series = buffer.lookup_series("map", "imu")
    assert set(series.time.tolist()) <= set(times.tolist())
    assert (series.log_time - series.time == 7).all()
    assert series.time.size >= 160
    rows = (series.time - START) // STEP
    # Dated ahead of its recording, a correction counts from there; what it corrects arose along the path.
    known = slow - START + (lead if lead + 7 < 1_000_000 else -7)
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=1) + np.abs(np.diff(turned))
    path = np.append(0.0, np.cumsum(steps))
    along, reached = (np.interp(at, times - START, path) for at in (series.time - START, known))
    fraction = np.interp(along, reached, np.linspace(0.0, 1.0, slow.size))
    outer = quaternions_from_yaw(0.4 * fraction)
    inner = quaternions_from_yaw(turned[rows])
    reach = moved[rows] + rotate(inner, np.tile([0.1, 0.2, 0.3], (rows.size, 1)))
    expected = np.stack((2 * fraction, -2 * fraction, 0 * fraction), axis=1) + rotate(outer, reach)
    assert np.allclose(series.position, expected, atol=1e-6)
    turn = multiply_quaternions(
        multiply_quaternions(outer, inner), quaternions_from_yaw(np.full(rows.size, 0.5))
    )
    assert np.allclose(np.abs((series.quaternion * turn).sum(axis=1)), 1.0, atol=1e-9)
    back = buffer.lookup_series("imu", "map", at=series.time)
    assert np.allclose(series.position + rotate(series.quaternion, back.position), 0.0, atol=1e-6)


def test_a_correction_that_long_stood_is_a_jump_where_it_changes(tmp_path: Path) -> None:
    """A relocalization after 18 m of driving is no drift along them."""
    times, path = START + np.arange(200) * STEP, tmp_path / "log.mcap"
    forward = np.outer(np.arange(200), [0.1, 0.0, 0.0])
    moved = np.outer(np.arange(200) >= 180, [0.0, 0.3, 0.0])
    with LogWriter(path) as writer:
        for frames, position in ((("map", "odom"), moved), (("odom", "base_link"), forward)):
            columns = transforms(*frames, position, np.zeros(200))
            writer.write_columns("/tf", KIND, times, columns, header_time=times)
    series = buffer_of(path).lookup_series("map", "base_link")
    assert np.allclose(series.position, (forward + moved)[(series.time - START) // STEP], atol=1e-9)


def test_stamps_that_many_poses_share_are_no_times_of_them(tmp_path: Path) -> None:
    times, path = START + np.arange(200) * STEP, tmp_path / "log.mcap"
    forward = np.outer(np.arange(200), [0.1, 0.0, 0.0])
    with LogWriter(path) as writer:
        columns = transforms("odom", "base_link", forward, np.zeros(200))
        writer.write_columns("/tf", KIND, times, columns, header_time=times // 10**9 * 10**9)
        # One that is sent again and again, as it was, keeps its stamp.
        held = transforms("map", "odom", 0.0 * forward, np.zeros(200))
        writer.write_columns("/tf", KIND, times, held, header_time=np.full(200, START))
    series = buffer_of(path).lookup_series("map", "base_link")
    assert series.time.tolist() == times.tolist()
    assert np.allclose(series.position, forward, atol=1e-9)
    (note,) = series.notes
    assert note == "stamps of base_link are those of several poses: log times were used"


def test_a_future_dated_correction_serves_from_the_start(tmp_path: Path) -> None:
    times = START + np.arange(100) * STEP
    path = tmp_path / "log.mcap"
    position = np.zeros((100, 3))
    with LogWriter(path) as writer:
        correction = transforms("map", "odom", position[::20] + 1.0, np.zeros(5))
        writer.write_columns("/tf", KIND, times[::20], correction, header_time=times[::20] + 500_000_000)
        motion = transforms("odom", "base_link", position, np.zeros(100))
        writer.write_columns("/tf", KIND, times, motion, header_time=times)
    series = buffer_of(path).lookup_series("map", "base_link")
    assert series.time.tolist() == times.tolist()
    assert np.allclose(series.position, 1.0)


def test_a_correction_that_waits_for_motion_is_the_drift_along_the_path(tmp_path: Path) -> None:
    times = START + np.arange(600) * STEP // 2
    # Straight on, a stop of 4 s, and on; the odometry is a tenth short until a jump of the map by 3 m.
    truth = np.cumsum(np.where((np.arange(600) > 200) & (np.arange(600) < 360), 0.0, 0.01))
    odometry = 0.9 * truth
    scans = np.arange(0, 600, 4)
    since, held = 0.0, np.zeros(scans.size)
    for row, scan in enumerate(scans):
        if odometry[scan] - since > 0.2:
            since, held[row:] = odometry[scan], (truth - odometry)[scan] + 3.0 * (scan > 480)
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        correction = transforms("map", "odom", np.outer(held, [1.0, 0.0, 0.0]), 0 * held)
        writer.write_columns("/tf", KIND, times[scans], correction, header_time=times[scans] + 1_000_000_000)
        motion = transforms("odom", "base_link", np.outer(odometry, [1.0, 0.0, 0.0]), 0 * odometry)
        writer.write_columns("/tf", KIND, times, motion, header_time=times)
        joint = transforms("base_link", "wheel", np.zeros((600, 3)), np.zeros(600))
        writer.write_columns("/tf", KIND, times, joint, header_time=times - STEP)
    series = buffer_of(path).lookup_series("map", "wheel")
    rows = np.searchsorted(times, series.time)
    off = series.position[:, 0] - truth[rows]
    changes = scans[np.flatnonzero(np.diff(held)) + 1]
    jump = int(np.argmax(changes > 480))
    known = (rows > changes[0]) & (rows <= changes[jump - 1])
    moved = (rows >= changes[jump]) & (rows <= changes[-1])
    assert np.abs(off[known]).max() < 1e-9
    assert np.allclose(off[moved], 3.0)
    assert np.abs(off[(rows > changes[jump - 1]) & (rows < changes[jump] - 4)]).max() < 0.05
    assert [note for note in series.notes if "dated 1 s ahead" in note]
    assert rows[series.corrected].tolist() == [row for row in changes.tolist() if row in rows]


def test_a_missing_chain_names_the_known_frames(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as writer:
        for parent, child in (("map", "odom"), ("lidar", "ring")):
            fields = transforms(parent, child, np.zeros((1, 3)), np.zeros(1))
            writer.write_columns("/tf", KIND, np.array([START]), fields)
    buffer = buffer_of(path)
    for parent, child in (("map", "ring"), ("map", "base_link")):
        with pytest.raises(LogError) as caught:
            buffer.lookup_series(parent, child)
        assert caught.value.code == "frame_not_found"
        assert "lidar, map, odom and ring" in caught.value.hint


def test_invalid_rotations_are_left_out_and_counted(tmp_path: Path) -> None:
    times = START + np.arange(10) * STEP
    path = tmp_path / "log.mcap"
    fields = transforms("odom", "base_link", np.zeros((10, 3)), np.zeros(10))
    fields["transforms[].transform.rotation.w"] = np.where(np.arange(10) == 4, 0.0, 2.0)
    with LogWriter(path) as writer:
        writer.write_columns("/tf", KIND, times, fields, header_time=times)
    series = buffer_of(path).lookup_series("odom", "base_link")
    assert series.time.size == 9
    assert np.allclose(np.linalg.norm(series.quaternion, axis=1), 1.0)
    assert any("invalid" in note for note in series.notes)
