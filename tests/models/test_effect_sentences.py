"""Every effect is said in one plain sentence: its name, its quantities with units."""

from __future__ import annotations

import msgspec
import pytest

from pipeline.models import find_effect, list_effects
from pipeline.sources import Vehicle, list_presets

PRESETS: dict[str, Vehicle] = {vehicle.id: vehicle for vehicle in list_presets()}
HUSKY, CAR = PRESETS["husky_a200"], PRESETS["ackermann_car"]
MOST_IN_SENTENCE = 3


@pytest.mark.parametrize(
    ("name", "values", "sentence"),
    [
        ("wheel_radius", {"k": 0.71}, "Effective wheel radius: the robot travels 29 % less than ideal"),
        ("wheel_radius", {"k": 1.04}, "Effective wheel radius: the robot travels 4 % more than ideal"),
        ("drive_lag", {"tau": 0.3}, "Drive lag: time constant 0.30 s"),
        ("steering_offset", {"o": 0.02}, "Steering offset: 1.1 degrees to the left at zero command"),
        ("steering_offset", {"o": -0.02}, "Steering offset: 1.1 degrees to the right at zero command"),
        ("clock_offset", {"d": -0.12}, "Clock offset: poses are stamped 120 ms early"),
        (
            "grade_load",
            {"k": 0.6},
            "Grade load: the wheels turn 0.1 m/s slower uphill on a slope of 10 degrees",
        ),
        (
            "gain_drift",
            {"k": 0.2},
            "Gain drift: the wheels turn 20 % less of their command at the end of the run than at its start",
        ),
        (
            "motor_imbalance",
            {"e": 0.1},
            "Motor imbalance: the motor on the left is weaker, as with 9.5 % less voltage",
        ),
        ("slope_drift", {"k": 0.6}, "Slope drift: 0.1 m/s downhill on a slope of 10 degrees"),
        (
            "terrain_change",
            {"k_v": 0.8, "k_w": 0.7, "at_s": 90.0},
            "Terrain change from 90 s on: speed 80 %, yaw rate 70 % of before",
        ),
        (
            "effective_track",
            {"k": 1.8},
            (
                f"Effective track {1.8 * (HUSKY.track_width_m or 0.0):.2f} m (nominal "
                f"{HUSKY.track_width_m:.2f}): the robot turns at 56 % of the ideal rate"
            ),
        ),
    ],
)
def test_the_sentence_has_the_number_and_the_side(name: str, values: dict[str, float], sentence: str) -> None:
    assert find_effect(name)().change(**values).describe_motion(HUSKY) == sentence


@pytest.mark.parametrize("kind", list_effects(), ids=lambda kind: str(kind.id))
def test_every_effect_has_a_sentence_of_its_own_that_moves_with_its_numbers(kind: type) -> None:
    vehicle = next(v for v in (HUSKY, CAR, PRESETS["dingo_o"]) if v.kind in kind.kinds)
    usual = {p.name: p.typical for p in kind.parameters if not p.instead_of}
    effect = kind().change(**usual)
    sentence = effect.describe_motion(vehicle)
    assert sentence
    assert kind.id not in sentence
    assert "nan" not in sentence
    assert len(sentence) < 100
    if len(usual) > MOST_IN_SENTENCE:
        # Its numbers stand below the sentence, one in each line with its interval.
        assert not set(usual) & set(sentence.split())
        return
    for parameter in kind.parameters:
        if parameter.instead_of:
            continue
        low, high = parameter.bounds
        other = min(max(1.7 * parameter.typical, low), high)
        assert effect.change(**{parameter.name: other}).describe_motion(vehicle) != sentence, parameter.name


def test_no_metres_are_said_of_a_vehicle_of_which_only_the_body_motion_is_known() -> None:
    stand_in = msgspec.structs.replace(HUSKY, stand_ins=["track_width_m"])
    assert find_effect("effective_track")().change(k=1.08).describe_motion(stand_in) == (
        "Effective track 1.08 times the controller's: the robot turns at 93 % of the ideal rate"
    )


def test_a_point_metres_away_is_told_in_plain_digits() -> None:
    arm = find_effect("lever_arm")().change(l_x=1.804, l_y=-0.0312).describe_motion(CAR)
    assert arm == "Lever arm: the pose is measured 1.8 m ahead of base_link and 3.1 cm to the right"


def test_understeer_is_told_at_a_speed() -> None:
    """w = v tan(delta) / (l + K v^2): at 3 m/s with K = l / 9 half the turning is left."""
    wheelbase = CAR.wheelbase_m or 1.0
    sentence = find_effect("understeer")().change(K=wheelbase / 9.0).describe_motion(CAR)
    assert sentence == "Understeer: the robot turns 50 % less than ideal at 3 m/s"


def test_the_rate_of_turning_is_read_with_the_effective_wheel_radius() -> None:
    """w = k_radius / k_track w_ideal: a smaller radius takes from turning, too."""
    track, radius = (
        find_effect("effective_track")().change(k=2.0),
        find_effect("wheel_radius")().change(k=0.8),
    )
    assert "50 % of the ideal rate" in track.describe_motion(HUSKY)
    assert track.describe_motion(HUSKY, (radius, track)) == (
        "Effective track 1.10 m (nominal 0.55), with the effective wheel radius: "
        "the robot turns at 40 % of the ideal rate"
    )
    gains = [find_effect("drive_gain")().change(g=0.9), find_effect("difference_gain")().change(g=1.1)]
    assert track.describe_motion(HUSKY, (*gains, track)) == (
        "Effective track 1.10 m (nominal 0.55), with the drive gain and the difference gain: "
        "the robot turns at 50 % of the ideal rate"
    )
    alone = track.change(k=1.0).describe_motion(HUSKY, (radius, gains[1]))
    assert alone.endswith("at 88 % of the ideal rate")


def test_the_share_of_a_difference_is_that_of_both_gains() -> None:
    """D = g_difference g_drive D_command: tile was said to reach 106 % beside wheels that reach 96.9 %."""
    difference, drive = find_effect("difference_gain")().change(g=1.06), find_effect("drive_gain")()
    assert "reaches 106 % of the commanded" in difference.describe_motion(HUSKY, (difference,))
    both = (difference, drive.change(g=0.969))
    said = "reaches 103 % of the commanded speed difference of its sides"
    whole = difference.describe_motion(HUSKY, both)
    assert whole == f"Difference gain, with the drive gain: the robot {said}"
    assert difference.describe_clause(HUSKY, both) == said


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("side_lag", {"tau_left": 0.2, "tau_right": 0.4}),
        ("brake_lag", {"tau_drive": 0.6, "tau_brake": 0.2}),
        ("torque_limit", {"tau": 0.5, "limit": 12.0}),
    ],
)
def test_a_clause_of_two_numbers_is_none_with_one_of_them(name: str, values: dict[str, float]) -> None:
    """Of side_lag with one number was said: `the robot 0.4 s on the right`."""
    effect = find_effect(name)().change(**values)
    assert all(f"{value:.2g}" in effect.describe_clause(HUSKY) for value in values.values())
    for number in values:
        assert effect.omit_open({number}).describe_clause(HUSKY) == f"shows signs of {name.replace('_', ' ')}"


def test_a_part_in_brackets_is_left_out_with_its_number() -> None:
    servo = find_effect("wheel_servo")().change(tau=0.68)
    assert servo.describe_clause(HUSKY).endswith("by ground friction (time constant 0.68 s)")
    assert servo.omit_open({"tau"}).describe_clause(HUSKY).endswith("by ground friction")
    lag = find_effect("turn_lag")().change(tau_mean=0.31, tau_diff=1.2).omit_open({"tau_diff"})
    assert lag.describe_motion(HUSKY) == "Turning lag: 0.31 s for speed"


def test_contact_without_a_bound_tells_no_coefficient() -> None:
    contact = find_effect("contact_friction")(k=1.75)
    assert contact.describe_motion(HUSKY) == "Contact friction: effective track 1.75 times nominal"
