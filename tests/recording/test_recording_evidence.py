"""What a motion says of the signals beside it: frame, signs, sides, units and lengths, on drawn drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from drawn_motion import GAIN, LAG, RADIUS, STEP, TRACK, command, draw, measured, sides, tabulate

from pipeline.recording.encoders import Turning, compare_sides
from pipeline.recording.evidence import (
    Units,
    find_body_units,
    find_frame,
    find_pose_unit,
    find_reversed,
    find_steering_unit,
    find_wheel_unit,
    rate_command,
)
from pipeline.recording.geometry import explain_wheels, measure_controller, measure_geometry
from pipeline.recording.motion import CLEAR, FEWEST_STEPS, Steps, compare, fit, measure_motion
from pipeline.recording.readings import Held, Reading


def test_gain_and_delay_of_a_command_are_recovered() -> None:
    drive = draw()
    made = command(drive).explain(measured(tabulate(drive)))
    assert made.is_sure
    assert not made.crossed
    assert made.ahead.gains[0] == pytest.approx(1.0, abs=0.01)
    assert made.turned.gains[0] == pytest.approx(GAIN, abs=0.01)
    assert made.lag + made.delay == pytest.approx(LAG, abs=0.06)


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_the_sign_of_a_command_is_clear_though_the_vehicle_stands_at_times(turn: float) -> None:
    """An emergency stop under a live command is as far off with either sign."""
    drive = draw(3, 30.0)
    asked = np.concatenate((np.tile([0.0, 1.0], (500, 1)), drive.asked))
    time = np.arange(asked.shape[0]) * STEP
    rows = np.arange(0, time.size, 10)
    still = np.zeros(50)
    stopped = replace(
        drive, time=time, asked=asked, rows=rows, yaw=np.concatenate((still, drive.yaw)),
        place=np.concatenate((still + 0j, drive.place)),
    )  # fmt: skip
    made = command(stopped, turn=turn).explain(measured(tabulate(stopped)))
    assert (made.sign("ahead"), made.sign("turned")) == (1, turn)


def test_what_a_signal_says_while_nobody_commands_does_not_count() -> None:
    """An encoder that dies before the driving that counts is dead, though it turned in what went before."""
    drive = draw(4)
    times, counts = drive.time[::5], drive.time[::5] > 50.0
    one, two = (side[::5] for side in drive.wheels())
    left, right = (Held(times, each, counts=counts) for each in (np.where(counts, 0.0, one), two))
    read = Reading("sides", "/wheels", left, right)
    assert read.dead_side == "left"
    steps = measured(tabulate(drive)).steps
    assert not right.is_there(steps)[steps.start < 50.0].any()
    assert right.is_there(steps)[steps.start > 51.0].all()


def test_laps_of_one_radius_reverse_no_side_of_the_drive() -> None:
    """Speed and yaw rate are proportional there, so that either explains what the other does."""
    drive, radius = draw(), 8.0
    turned = drive.speed + 0.05 * draw(2).speed
    yaw = np.cumsum(turned / radius) * STEP
    place = np.cumsum(drive.speed * np.exp(1j * yaw)) * STEP
    asked = np.stack([turned, drive.speed / radius], axis=1)
    laps = replace(drive, asked=asked, place=place[drive.rows], yaw=yaw[drive.rows])
    made = command(laps).explain(measured(tabulate(laps)))
    assert not made.crossed
    assert made.sign_margin == np.inf


def test_radius_and_track_come_from_the_motion_and_from_the_controller() -> None:
    drive = draw(2)
    motion = measured(tabulate(drive))
    wheels = sides(drive)
    made = wheels.explain(motion)
    assert made.is_known
    radius, track = measure_geometry(made)
    assert radius.value == pytest.approx(RADIUS, rel=0.01)
    assert track.value == pytest.approx(TRACK / GAIN, rel=0.01)
    driven = explain_wheels(command(drive), wheels)
    assert driven.is_known
    found = measure_controller(driven)
    assert [one.value for one in found if one] == pytest.approx([RADIUS, TRACK], rel=0.01)


def test_lengths_are_as_good_as_is_said_of_them() -> None:
    far = []
    for seed in range(40, 48):
        drive = draw(seed, 60.0)
        driven = explain_wheels(command(drive), sides(drive))
        assert driven.is_known
        found = measure_controller(driven)
        far += [
            (one.value - true) / one.error for one, true in zip(found, (RADIUS, TRACK), strict=True) if one
        ]
    assert len(far) == 16
    assert np.sqrt(np.mean(np.square(far))) < 2.0
    assert max(np.abs(far)) < 4.0


def test_a_straight_drive_shows_a_radius_and_no_track() -> None:
    drive = draw(3)
    place = (np.cumsum(drive.speed) * STEP)[drive.rows] + 0j
    straight = replace(
        drive, asked=drive.asked * [1.0, 0.0], rate=0.0 * drive.rate, place=place, yaw=0.0 * drive.yaw
    )
    made = sides(straight).explain(measured(tabulate(straight)))
    assert made.is_known
    radius, track = measure_geometry(made)
    assert radius.value == pytest.approx(RADIUS, rel=0.01)
    assert track is None


@pytest.mark.parametrize(("axis", "up"), [(2, "z"), (1, "y")])
@pytest.mark.parametrize("degrees", [0.0, 90.0, -90.0])
def test_the_frame_of_the_pose_is_found(axis: int, up: str, degrees: float) -> None:
    drive = draw(4)
    motion = measured(tabulate(drive, turned=np.radians(degrees), axis=axis))
    assert motion.up == up
    readings = [one.fitted(motion) for one in (command(drive), sides(drive))]
    turned, margin, _ = find_frame(motion, readings)
    assert not turned.flip
    if degrees == 0.0:
        assert (turned.offset_deg, margin) == (0.0, 0.0)
    else:
        assert turned.offset_deg == 90.0
        assert margin > 3.0


@pytest.mark.parametrize(("degrees", "other"), [(0.0, None), (90.0, -90.0), (-90.0, 90.0)])
def test_where_wheels_spin_another_frame_is_told(degrees: float, other: float | None) -> None:
    """The body slides about, and goes a little where its wheels turn."""
    drive = draw(6, 200.0)
    slide = np.random.default_rng(7).normal(0.0, 1.0, (2, drive.time.size))
    smooth = np.ones(100) / 10.0
    ahead, aside = (0.2 * np.convolve(one, smooth, "same") for one in slide)
    yaw = np.cumsum(drive.rate) * STEP
    place = np.cumsum((0.15 * drive.speed + ahead + 1j * aside) * np.exp(1j * yaw))[drive.rows] * STEP
    motion = measured(tabulate(replace(drive, place=place), turned=np.radians(degrees)))
    assert find_frame(motion, [sides(drive).fitted(motion)]) == (motion, 0.0, other)


@pytest.mark.parametrize(("left", "right"), [(-1.0, 1.0), (1.0, -1.0)])
def test_a_side_that_counts_backward_is_told_from_all_else(left: float, right: float) -> None:
    drive = draw(5)
    made = sides(drive, left, right).explain(measured(tabulate(drive)))
    assert made.crossed
    assert made.sign_margin > 3.0
    assert (made.ahead.gains[0] > 0.0) == (right < 0.0)


C, W, G = "command", "wheels", "gyro"


def test_the_fewest_faults_explain_the_signs() -> None:
    for signs, faults in [
        ({(C, "ahead"): 1, (C, "turned"): 1, (W, "ahead"): 1, (W, "turned"): 1}, ()),
        ({(C, "ahead"): -1, (C, "turned"): 1, (W, "ahead"): -1, (W, "turned"): 1}, ("pose_backward",)),
        ({(C, "turned"): -1, (W, "turned"): -1, (G, "turned"): -1}, ("pose_mirrored",)),
        ({(C, "ahead"): 1, (C, "turned"): 1, (W, "ahead"): 1, (W, "turned"): -1}, ("wheels_exchanged",)),
        ({(C, "ahead"): 1, (C, "turned"): 1, (W, "ahead"): -1, (W, "turned"): -1}, ("wheels_both",)),
        ({(C, "ahead"): -1, (C, "turned"): 1, (W, "ahead"): 1, (W, "turned"): 1}, ("command_ahead",)),
        ({(C, "turned"): 1, (W, "turned"): 1, (G, "turned"): -1}, ("gyro",)),
        ({(C, "turned"): -1, (G, "turned"): -1}, ("pose_mirrored",)),
    ]:
        made = find_reversed(signs)  # type: ignore[arg-type]
        assert made.faults == faults
        assert made.rivals == ()


def test_of_two_that_contradict_each_other_both_may_be_wrong() -> None:
    made = find_reversed({(C, "ahead"): -1, (C, "turned"): 1})
    assert {made.faults, *made.rivals} == {("pose_backward",), ("command_ahead",)}


DEGREE = np.pi / 180.0


def test_units_of_a_body_command() -> None:
    for gains, units in [
        ((0.95, 0.6), ("m/s", "rad/s")),
        ((1.0, 0.77 * DEGREE), ("m/s", "deg/s")),
        ((1.0 / 3.6, 0.9), ("km/h", "rad/s")),
        ((0.99 / 3.6, 0.77), ("km/h", "rad/s")),
        ((1e-3, 0.9e-3), ("mm/s", "mrad/s")),
        ((0.3, 0.3), ("m/s", "rad/s")),
        ((0.4, 0.5), ("m/s", "rad/s")),
        ((0.01, None), ("cm/s", "rad/s")),
    ]:
        assert find_body_units(gains, (0.95, 0.95)) == Units(units)


def test_of_two_readings_that_are_as_likely_both_are_told() -> None:
    """Straight ahead a third of the speed is km/h, or a robot that is a third as fast."""
    made = find_body_units((1.0 / 3.6, None), (0.95, 0.95))
    assert made == Units(("m/s", "rad/s"), ("km/h", "rad/s"))
    assert find_body_units((1.0 / 3.6, None), (0.95, 0.95), "/cmd_kph.data").likeliest == ("km/h", "rad/s")
    assert find_body_units((0.35, None), (0.95, 0.95)) == Units(("m/s", "rad/s"))


def test_a_poor_fit_shows_no_unit() -> None:
    assert find_body_units((0.9, 0.076), (0.5, 0.1)) == Units(("m/s", "rad/s"))


def test_unit_of_positions() -> None:
    for commanded, rolled, radius, unit in [
        (0.9, 0.1, None, "m"),
        (865.0, 79.0, None, "mm"),
        (99.0, None, None, "cm"),
        (None, 300.0, 0.3, "mm"),
        (None, 0.9, None, "m"),
        (0.3, 0.03, None, "m"),
        (3.0, 1.0, None, "m"),
    ]:
        assert find_pose_unit(commanded, rolled, radius) == unit


def test_a_poor_fit_of_a_strange_unit_is_known_by_its_size() -> None:
    """On grass a turn is a third of what is asked for, and hardly explained: not a fifty-seventh."""
    assert find_body_units((0.8, 0.3 * DEGREE), (0.8, 0.3)) == Units(("m/s", "deg/s"))
    assert find_body_units((0.2, 0.2), (0.4, 0.4)) == Units(("m/s", "rad/s"))


def test_unit_of_a_steering_angle() -> None:
    for nats, lengths, known, unit, rival in [
        # Large angles fit in their own unit only.
        ((900.0, 100.0), (1.0, None), None, "rad", None),
        ((100.0, 900.0), (None, 1.0), None, "deg", None),
        # Small ones fit in both, and the wheelbase tells.
        ((900.0, 900.0), (0.33, 0.0057), None, "rad", None),
        ((900.0, 900.0), (57.0, 1.0), None, "deg", None),
        ((900.0, 900.0), (10.0, 0.175), None, "rad", "deg"),
        ((900.0, 900.0), (10.0, 0.175), 9.0, "rad", None),
    ]:
        names = ("rad", "deg")
        made = find_steering_unit(
            dict(zip(names, nats, strict=True)), dict(zip(names, lengths, strict=True)), known, "/drive"
        )
        assert made.likeliest[1] == unit
        assert (made.rival[1] if made.rival else None) == rival


def test_unit_of_wheel_speeds() -> None:
    for gain, name, unit in [
        (0.033, "/joint_states", "rad/s"),
        (0.3, "/joint_states", "rad/s"),
        (0.0105, "/wheel/left/rpm", "rpm"),
        (0.0017, "/wheels", "deg/s"),
        (0.1, "/wheel/left/rpm", "rad/s"),
        (1.02, "/wheel/speed", "m/s"),
        (0.5, "/wheel/speed", "rad/s"),
        (3e-4, "/joint_states", ""),
    ]:
        assert find_wheel_unit(gain, 0.95, name) == unit


def test_unit_of_the_wheels_of_a_known_vehicle() -> None:
    """On ice a fit is poor, and its gain low: that is no unit."""
    for gain, share, unit in [(0.29, 0.9, "rad/s"), (0.0271, 0.9, "rpm"), (0.05, 0.35, "rad/s")]:
        assert find_wheel_unit(gain, share, "/wheels", 0.3) == unit


def test_a_measured_motion_is_no_command() -> None:
    drive = draw(6)
    motion = measured(tabulate(drive))
    asked, seen = (
        command(drive),
        Reading("body", "/motion", Held(drive.time, drive.speed), Held(drive.time, drive.rate)),
    )
    asked, seen = (one.fitted(motion) for one in (asked, seen))
    delays = [one.explained.lag + one.explained.delay for one in (asked, seen)]
    # Even where the names say nothing, and the motion comes first by its type.
    asked = replace(asked, name="/velocity_a")
    assert rate_command(asked, 1, min(delays)) > rate_command(seen, 0, min(delays)) + 4.0
    # Or where the names say the opposite.
    asked, seen = replace(asked, name="/wheel_velocity"), replace(seen, name="/motor/command")
    assert rate_command(asked, 0, min(delays)) > rate_command(seen, 0, min(delays)) + 4.0


def test_a_command_that_is_sent_on_changes_only_says_something_all_the_time() -> None:
    drive = draw(7, 60.0)
    changed = np.flatnonzero(np.append(True, np.any(np.diff(drive.asked, axis=0) != 0.0, axis=1)))[::3]
    asked = np.zeros_like(drive.asked)
    for first, last in zip(changed, [*changed[1:], drive.time.size], strict=True):
        asked[first:last] = drive.asked[first]
    first, second = (Held(drive.time[changed], asked[changed, k], may_stand=True) for k in (0, 1))
    assert changed.size < FEWEST_STEPS
    made = Reading("body", "/cmd_vel", first, second).explain(measured(tabulate(drive)))
    assert made.is_known


def test_a_signal_of_another_body_explains_nothing() -> None:
    drive, other = draw(7), draw(8)
    made = command(other).explain(measured(tabulate(drive)))
    assert not made.is_sure


def test_noise_of_positions_does_not_hide_a_gain() -> None:
    """Increments of white noise are anticorrelated: whitened, a small gain is certain; else it is not."""
    rng = np.random.default_rng(9)
    count = 3000
    edges = np.arange(count + 1) * 0.1
    steps = Steps(edges[:-1], edges[1:])
    driven = 0.1 * np.cumsum(rng.normal(0.0, 0.02, count))
    noise = np.diff(rng.normal(0.0, 0.05, count + 1))
    made = fit(0.5 * driven + noise, driven[:, None], steps)
    assert made.gains[0] == pytest.approx(0.5, abs=0.05)
    none = fit(0.5 * driven + noise, np.zeros((count, 0)), steps)
    assert compare(made.blocks, none.blocks) > 3.0
    plain = np.linalg.lstsq(driven[:, None], 0.5 * driven + noise, rcond=None)
    deviation = np.sqrt(plain[1][0] / count / (driven @ driven))
    assert abs(made.t[0]) > 2.0 * abs(plain[0][0] / deviation)


def test_two_alike_readings_are_not_told_apart() -> None:
    rng = np.random.default_rng(10)
    blocks = rng.normal(0.0, 1.0, 40)
    assert abs(compare(blocks, blocks[::-1].copy())) < 3.0
    assert compare(blocks, blocks) == 0.0


def test_too_few_poses_say_nothing() -> None:
    drive = draw(11)
    assert not measure_motion(tabulate(drive).head(FEWEST_STEPS)).is_known


def test_poses_that_were_all_stamped_at_once_say_nothing() -> None:
    poses = tabulate(draw(12))
    assert not measure_motion(poses.with_columns(t=pl.lit(3.0))).is_known


def test_a_stamp_of_another_epoch_is_left_out() -> None:
    times, values = np.arange(0.0, 100.0, 0.05), np.sin(np.arange(2000))
    times[1000] = 2e9
    held = Held(np.sort(times), values)
    assert held.times[-1] < 100.0
    assert held.grid.size < 10_000


@pytest.mark.parametrize(("t", "scale"), [(100.0, 0.5), (6.0, None)])
def test_laps_of_one_radius_tell_no_scale_of_a_side(t: float, scale: float | None) -> None:
    """What drives and what turns are one there, and neither is known."""
    left, right = (Turning(np.array([gain, 1.0]), np.array([t, 0.5]), follows=True) for gain in (5.0, 10.0))
    assert compare_sides(left, right) == scale


@pytest.mark.parametrize(("path", "scale"), [(1.1, 0.5), (1.9, None)])
def test_wheels_that_turn_farther_than_explained_show_no_scale(path: float, scale: float | None) -> None:
    """Noise of the poses may attenuate what one wheel turns with the motion."""
    gains = np.array([1.3, -1.3]), np.array([2.6, 2.6])
    left, right = (
        Turning(each, np.array([30.0, 20.0]), follows=True, path=far)
        for each, far in zip(gains, (path, 1.0), strict=True)
    )
    assert compare_sides(left, right) == scale


def test_wheels_that_roll_straight_on_are_not_exchanged() -> None:
    """What the noise of their difference had in common with that of the heading had a sign."""
    drive, rng = draw(5), np.random.default_rng(8)
    yaw = rng.normal(0.0, 0.002, drive.rows.size)
    place = np.cumsum(drive.speed)[drive.rows] * STEP + rng.normal(0.0, 0.002, yaw.size)
    line = replace(drive, place=place + 0j, yaw=yaw)
    apart = np.diff(rng.normal(0.0, 0.002, yaw.size) - 0.23 * yaw, append=0.0) / (10 * STEP)
    at, mean = drive.time[drive.rows], drive.speed[drive.rows] / RADIUS
    made = Reading("sides", "/joint_states", Held(at, mean - apart), Held(at, mean + apart)).explain(
        measured(tabulate(line))
    )
    assert made.turned.t[0] < -CLEAR
    assert (made.sign("ahead"), made.sign("turned")) == (1, 0)


@pytest.mark.parametrize(("turn", "up"), [(0.35, "z"), (1.5, "y")], ids=["hill", "turns"])
def test_a_straight_hill_is_no_plane_of_motion(turn: float, up: str) -> None:
    """Up and down a ramp a body turns about y alone, but no farther than ground is steep."""
    drive = draw(6)
    pitch = turn * (np.sin(0.3 * drive.time) > 0.0)
    place = np.cumsum(drive.speed * np.exp(1j * pitch)) * STEP
    poses = tabulate(replace(drive, place=place[drive.rows], yaw=pitch[drive.rows]), axis=1)
    assert measured(poses).up == up
