"""Short logs, slow topics and slow vehicles get the findings of long and fast ones."""

import math

import numpy as np
import pytest
from stage_logs import make_samples

from pipeline.recording.clocks import Recorded, align_clocks
from pipeline.recording.satellite import Turning, find_heading, follow_velocity
from pipeline.run import Alignment
from pipeline.sources import find_preset
from pipeline.stages.checks import check_delays, check_motion, check_scale
from pipeline.stages.velocity import report_gyro
from pipeline.words import format_finding

SECOND = 10**9
START = 1_700_000_000 * SECOND


def test_three_seconds_of_driving_in_a_minute_are_motion() -> None:
    times = np.arange(0.0, 60.0, 0.05)
    ideal = np.zeros((times.size, 3))
    ideal[(times > 20.0) & (times < 23.0), 0] = 0.6
    vehicle = find_preset("husky_a200")
    assert check_motion(make_samples(times, ideal, 0.9 * ideal), vehicle) == []
    still = check_motion(make_samples(times, ideal, 0.0 * ideal), vehicle)
    assert [finding.id for finding in still] == ["not_moving"]


def test_eight_seconds_at_ten_hertz_show_a_heading_that_is_late() -> None:
    times = np.arange(0.0, 8.0, 0.1)

    def move(late: float) -> np.ndarray:
        turn = 0.6 * np.sin(2.3 * (times - late)) + 0.3 * np.sin(3.7 * (times - late))
        return np.column_stack((1.0 + 0.5 * np.sin(1.9 * times), np.zeros(times.size), turn))

    (found,) = check_delays(make_samples(times, move(0.0), move(0.2)), find_preset("husky_a200"))
    assert found.id == "heading_skew"
    assert found.value is not None
    assert abs(found.value - 0.2) < 0.03
    assert format_finding(found).startswith("compared with the wheels, the heading lags the position by ")
    (early,) = check_delays(make_samples(times, move(0.0), move(-0.2)), find_preset("husky_a200"))
    assert "the heading leads the position by " in format_finding(early)


def test_bunches_of_seven_messages_of_a_slow_topic_are_put_back_to_its_pace() -> None:
    sent = START + (np.arange(2100) * 0.25 * SECOND).astype(np.int64)
    log = np.repeat(sent[6::7], 7) + 1_000_000
    clocks, findings = align_clocks({"cmd": Recorded("/cmd_vel", log, log, None, None)})
    assert [finding.id for finding in findings] == ["bunched_times"]
    assert np.ptp(np.quantile(clocks["cmd"].stamp - sent, (0.05, 0.95))) < 0.1 * SECOND


def test_a_gyro_is_put_on_the_course_of_a_vehicle_that_turns_slowly() -> None:
    times = np.arange(0.0, 200.0, 0.1)
    yaw = 0.5 * np.sin(0.1 * times)
    velocity = np.column_stack((np.cos(yaw), np.sin(yaw)))
    course = follow_velocity(times, velocity, None)
    heading = find_heading(times, course, [Turning("/imu", times, yaw)], np.zeros(2), "/gps")
    assert heading.finding.id == "heading_from_imu"
    assert np.max(np.abs(heading.yaw - yaw)) < 0.02


def test_a_gyro_that_disagrees_with_a_vehicle_that_turns_slowly_is_said_to() -> None:
    turning = 0.05 * np.sin(0.3 * np.arange(0.0, 200.0, 0.05))
    assert 0.03 < np.std(turning) < 0.04
    assert [finding.id for finding in report_gyro(Alignment(), turning)] == ["imu_disagrees"]
    assert [finding.id for finding in report_gyro(Alignment(), 0.5 * turning)] == ["imu_unchecked"]


@pytest.mark.parametrize(
    ("gain", "found"),
    [(0.6, "unit_wrong"), (1.2, "unit_wrong"), (0.5, "wheel_radius_wrong"), (1.3, "wheel_radius_wrong")],
)
def test_wheels_are_in_another_unit_where_the_ground_explains_the_rest(gain: float, found: str) -> None:
    # The limits are those between which wheels in the right unit are believed: slip takes up to 45 %.
    times = np.arange(0.0, 30.0, 0.05)
    ideal = np.zeros((times.size, 3))
    ideal[:, 0] = 1.0 + 0.3 * np.sin(times)
    vehicle = find_preset("husky_a200")
    believed = check_scale(make_samples(times, ideal, gain * ideal), vehicle) == []
    assert believed == (found == "unit_wrong")
    revolutions = ideal / (2.0 * math.pi / 60.0)
    (finding,) = check_scale(make_samples(times, revolutions, gain * ideal), vehicle)
    assert finding.id == found
    assert ("rpm" in format_finding(finding)) == (found == "unit_wrong")
