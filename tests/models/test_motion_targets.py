"""What is exported is what its project documents, says where each line came from, and drives as was asked."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from exported_files import CAR, F1TENTH, FIT, HUSKY, make, make_full, predict, read, take
from target_schemas import ALL, SCHEMAS
from verbs import run_verb

from pipeline import export
from pipeline.estimation.estimates import format_parameters, list_parameters
from pipeline.export import export_model, find_target, list_targets, read_current
from pipeline.models import Place, find_effect, list_effects
from pipeline.models.catalogue import run_effects
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.run import MotionError
from pipeline.sources import Vehicle

PARAMETERS = sorted(SCHEMAS)
CASES = [
    (name, vehicle)
    for name in PARAMETERS
    for vehicle in (HUSKY, F1TENTH)
    if name not in {"autoware", "vesc"} or vehicle is F1TENTH
]


def test_targets_are_found_by_being_there() -> None:
    texts = [path.read_text("utf-8") for path in Path(export.__path__[0]).glob("[!_]*.py")]
    names = {target.name for target in list_targets()}
    assert names == {*SCHEMAS, "json", "python", "traction"}
    assert sum(text.count(" = Target(") for text in texts) == len(names)
    assert all(target.about and target.source for target in list_targets())


def test_the_help_names_every_target() -> None:
    text = run_verb("model", "export", "--help").stdout
    assert all(target.name in text for target in list_targets())


@pytest.mark.parametrize(("name", "vehicle"), CASES)
def test_names_types_and_bounds_are_those_that_the_project_declares(name: str, vehicle: object) -> None:
    found = read(name, export_model(make_full(vehicle), name))
    assert found
    for path, value in found.items():
        schema = SCHEMAS[name][path]
        if isinstance(schema, int):
            assert isinstance(value, list)
            assert len(value) == schema
            assert {type(item) for item in value} == {bool if path.endswith("config") else float}, path
        else:
            assert type(value) is float, path
            assert schema[0] <= value <= schema[1], path


def test_every_parameter_of_the_schemas_is_written_for_some_vehicle() -> None:
    """So that no line of the tables above stands for nothing."""
    for name in PARAMETERS:
        vehicles = (CAR, F1TENTH) if name in {"autoware", "vesc"} else (HUSKY, CAR)
        written = set[str]()
        for vehicle in vehicles:
            if name != "vesc" or vehicle is F1TENTH:
                written |= set(read(name, export_model(make_full(vehicle), name)))
        assert written == set(SCHEMAS[name]), name


@pytest.mark.parametrize(("name", "vehicle"), CASES)
def test_every_effect_stands_at_a_line_or_among_those_without_one(name: str, vehicle: object) -> None:
    file = make_full(vehicle)
    head, _, rest = export_model(file, name).partition("Not covered by these parameters:")
    lines = [line.strip("# <!->") for line in rest.splitlines()]
    unmapped = set()
    for line in lines[1:]:
        label = re.match(r"(\w+)\.\w+ = ", line)
        if label is None:
            break
        unmapped.add(label[1])
    text = export_model(file, name)
    below = text[text.index(rest) :].split("\n", len(unmapped) + 1)[-1]
    for effect in file.model:
        stands = any(f"{effect.id}.{p.name} = " in below for p in effect.parameters)
        assert stands or effect.id in unmapped, (effect.id, head)
    known = {e.id for e in file.model if any(p.quantities for p in e.parameters)}
    assert unmapped >= {e.id for e in file.model} - known
    assert unmapped != {e.id for e in file.model} or name == "robot_localization"


def test_a_line_says_its_effect_value_interval_and_bound() -> None:
    effects = (find_effect("effective_track")(k=1.8), find_effect("transport_delay")(d=1.0))
    intervals = {"effective_track.k": (1.7, 1.9)}
    fit = FIT | {"undecided": [["transport_delay", "drive_lag"]]}
    lines = export_model(make(*effects, intervals=intervals, fit=fit), "ros2_control").splitlines()
    at = next(i for i, line in enumerate(lines) if "wheel_separation_multiplier: 1.8" in line)
    assert "effective_track.k = 1.8 (95 %: 1.7 to 1.9)" in "".join(lines[at - 2 : at])
    rivals = "undecided: 'drive_lag' would explain the data as well"
    at_bound = "at its bound: a limit of the search, not a measurement"
    assert f"#   transport_delay.d = 1 s, {rivals}, {at_bound}" in lines
    assert "# Fitted from wheel encoders of 'yard/monday'." in lines


def test_show_marks_the_numbers_that_an_export_marks() -> None:
    effects = (
        find_effect("effective_track")(k=1.8),
        find_effect("transport_delay")(d=1.0),
        find_effect("drive_lag")(tau=0.3),
    )
    file = make(*effects, intervals={"effective_track.k": (1.7, 1.9)}, fit=FIT)
    doubts = file.list_doubts()
    assert doubts.keys() == {"transport_delay.d", "drive_lag.tau"}
    shown = "\n".join(format_parameters(list_parameters(file)))
    exported = export_model(file, "ros2_control")
    for doubt in doubts.values():
        assert f"({doubt})" in shown
        assert doubt in exported


def test_what_is_not_known_is_not_written() -> None:
    assert take("ros2_control", make()).keys() == {"wheel_separation", "wheel_radius"}
    assert read("nav2", export_model(make(), "nav2")) == {"": None}
    unlimited = make(find_effect("body_speed_limit")(), find_effect("acceleration_limit")(limit=4.0))
    assert "vx_max" not in export_model(unlimited, "nav2")
    assert "max_velocity" not in export_model(unlimited, "nav2")


@pytest.mark.parametrize("known", [HUSKY, F1TENTH], ids=["robot", "car"])
@pytest.mark.parametrize("target", list_targets(), ids=lambda target: target.name)
def test_no_export_states_a_dimension_that_is_a_stand_in(target: export.Target, known: Vehicle) -> None:
    names = ["wheel_radius_m", *(["track_width_m"] if known is HUSKY else [])]
    guess = msgspec.structs.replace(known, wheel_radius_m=0.123, stand_ins=names)
    if known is HUSKY and target.name in {"autoware", "vesc"}:
        return
    text = export_model(make_full(guess), target.name)
    if target.name == "traction":
        assert "0.123" not in text
        return
    assert "Not known: " + " and ".join(names) in text
    # XML takes no two dashes: what to do is told without options, which it would have torn apart.
    assert "- -" not in text
    if target.name == "json":
        vehicle = json.loads(text)["vehicle"]
        assert [vehicle[name] for name in names] == [None] * len(names)
        assert vehicle["stand_ins"].keys() == set(names)
    elif target.name != "python":
        # Nothing else is missing: in limits of the body the stand-in cancels out.
        usual = read(target.name, export_model(make_full(known), target.name))
        found = read(target.name, text)
        gone = {path.rpartition(".")[2] for path in usual.keys() - found.keys()}
        dimensions = {"wheel_radius", "traction_wheels_radius", "wheel_separation", "RD_WHEEL_TRACK"}
        assert gone == {path.rpartition(".")[2] for path in usual} & dimensions - (
            set() if known is HUSKY else {"wheel_separation"}
        )


def test_numbers_mean_the_same_to_effects_and_targets() -> None:
    for kind in list_effects():
        for parameter in kind.parameters:
            assert all(quantity.unit == parameter.unit for quantity in parameter.quantities), kind.id


def test_a_formula_of_an_effects_name_is_no_quantity() -> None:
    formula = FormulaEffect("effective_track", {"v_w": "k * w0"}, (make_parameter("k", "1", (-1, 1)),), k=0.5)
    text = export_model(make(formula), "ros2_control")
    assert "multiplier" not in text
    assert "#   effective_track.k = 0.5" in text


def test_python_of_ones_own_is_no_quantity_and_has_no_step(tmp_path: Path) -> None:
    code = (
        b"from pipeline.models.effects.effective_track import EffectiveTrack\n"
        b"class Twice(EffectiveTrack):\n"
        b"    'Turns twice.'\n"
        b"    def roll(self, rolling, around):\n"
        b"        return rolling.scale(1.0, 2.0 / self.values['k'])\n"
    )
    own = run_effects(code, tmp_path / "own.py")["effective_track"](k=1.8)
    text = export_model(make(own), "ros2_control")
    assert "multiplier" not in text
    assert "#   effective_track.k = 1.8" in text
    with pytest.raises(MotionError, match="Python of your own"):
        export_model(make(own), "python")


def test_comments_stay_comments_in_xml() -> None:
    odd = FormulaEffect("a--b", {"v_w": "k * w0"}, (make_parameter("k", "1", (-1, 1)),), k=0.5)
    assert "wheel_radius" in read("gazebo", export_model(make(odd), "gazebo"))


@pytest.mark.parametrize(("v", "w"), [(1.0, 0.0), (0.6, 0.8), (-0.4, -0.5)])
def test_a_differential_controller_with_the_export_drives_what_it_is_asked(v: float, w: float) -> None:
    file = make(
        find_effect("effective_track")(k=1.8),
        find_effect("wheel_radius")(k=0.95),
        find_effect("wheel_asymmetry")(e=0.04),
    )
    p = take("ros2_control", file)
    # diff_drive_controller.cpp: the speed of each side over its own radius.
    half = p["wheel_separation"] * p["wheel_separation_multiplier"] / 2.0
    left = (v - w * half) / (p["wheel_radius"] * p["left_wheel_radius_multiplier"])
    right = (v + w * half) / (p["wheel_radius"] * p["right_wheel_radius_multiplier"])
    row = predict(file, [(-1.0, left, right)], 1.0)[-1]
    assert row[[4, 6]] == pytest.approx([v, w], abs=1e-3)


def test_a_rover_of_px4_turns_as_it_is_asked() -> None:
    file = make(find_effect("effective_track")(k=1.8), find_effect("wheel_speed_limit")(limit=8.0))
    p = take("px4", file)
    # RoverControl.cpp: speed difference = yaw rate * track / 2 * correction, over the speed at full throttle.
    throttle = 0.6 * p["RD_WHEEL_TRACK"] / 2.0 * p["RO_YAW_RATE_CORR"] / p["RO_MAX_THR_SPEED"]
    wheel = throttle * 8.0
    assert predict(file, [(-1.0, -wheel, wheel)], 1.0)[-1, 6] == pytest.approx(0.6, rel=1e-3)


@pytest.mark.parametrize("name", ["drive_lag", "body_inertia", "turn_lag"])
def test_a_smooth_command_is_followed_as_late_as_mppi_is_told(name: str) -> None:
    lag = find_effect(name)
    lag = lag(tau_mean=0.2, tau_diff=0.5) if name == "turn_lag" else lag(tau=0.4)  # type: ignore[assignment]
    file = make(find_effect("transport_delay")(d=0.15), lag)  # type: ignore[arg-type]
    p = take("nav2", file)
    times = np.arange(0.0, 5.0, 0.005)
    for delay, sign, column in (("vx", 1.0, 4), ("wz", -1.0, 6)):
        rows = predict(file, [(t, sign * t, t) for t in times], 5.0)
        late = 5.0 - rows[-1, column] / (np.gradient(rows[:, column], 0.005)[-1])
        assert late == pytest.approx(p[f"FollowPath.model_delay_{delay}"], abs=0.02), delay


def test_a_car_that_steers_to_the_left_of_itself_is_sent_to_the_right() -> None:
    file = make(
        find_effect("steering_offset")(o=0.02),
        find_effect("steering_gain")(g=0.9),
        find_effect("wheel_radius")(k=0.95),
        vehicle=F1TENTH,
    )
    p, used = take("vesc", file), F1TENTH.units
    for asked in (0.0, 0.2, -0.1):
        # ackermann_to_vesc.cpp with the new gains; the same hardware answers as it did with the old ones.
        servo = p["steering_angle_to_servo_gain"] * asked + p["steering_angle_to_servo_offset"]
        angle = (servo - used["servo"].offset) / used["servo"].per
        wheel = p["speed_to_erpm_gain"] * 1.0 / used["erpm"].per / F1TENTH.wheel_radius_m
        row = predict(file, [(-1.0, wheel, wheel, angle)], 1.0)[-1]
        assert row[4] == pytest.approx(1.0, rel=1e-3)
        assert row[6] == pytest.approx(math.tan(asked) / 0.25, abs=2e-3)
    assert predict(file, [(-1.0, 9.0, 9.0, 0.0)], 1.0)[-1, 6] > 0.03


def test_autoware_simulates_the_car_that_was_driven() -> None:
    file = make(find_effect("steering_offset")(o=0.02), find_effect("steering_lag")(tau=0.3), vehicle=CAR)
    p = take("autoware", file)
    # sim_model_delay_steer_vel.cpp: the measured angle, true angle plus bias, goes where it is asked.
    true, step = 0.0, 0.001
    for _ in range(3000):
        true += step * (0.1 - (true + p["steer_bias"])) / p["steer_time_constant"]
    row = predict(file, [(-1.0, 3.0, 3.0, 0.1)], 3.0)[-1]
    assert row[6] == pytest.approx(row[4] * math.tan(true) / p["wheel_base"], rel=1e-3)
    assert "steer_offset = 0.02 rad" in export_model(file, "autoware")


def test_the_narrowest_turn_is_one_that_both_sides_can_drive() -> None:
    file = make(find_effect("steering_offset")(o=-0.05), find_effect("steering_gain")(g=0.8), vehicle=CAR)
    radius = take("nav2", file)["FollowPath.ackermann.min_turning_r"]
    turns = [
        predict(file, [(-1.0, 3.0, 3.0, side * (CAR.max_steering_rad or 0.0))], 1.0)[-1] for side in (1, -1)
    ]
    assert radius == pytest.approx(max(abs(row[4] / row[6]) for row in turns), rel=1e-4)


def test_covariances_are_held_out_errors_of_what_odometry_can_follow() -> None:
    file = make(find_effect("drive_lag")(tau=0.3), find_effect("icr_offset")(x_icr=0.1), fit=FIT)
    p = take("robot_localization", file)
    assert p["twist_covariance_diagonal"] == pytest.approx([4e-4, 9e-4, 0.0, 0.0, 0.0, 2.5e-3])
    assert p["odom0_config"] == [name in {6, 7, 11} for name in range(15)]  # type: ignore[comparison-overlap]
    assert "slip model drop MODEL icr_offset" in export_model(file, "robot_localization")


@pytest.mark.parametrize(
    "ladder", [[], "none", [{"effects": []}], [{"effects": 3, "velocity_rms": [1, 2, 3]}]]
)
def test_a_model_that_was_not_fitted_has_no_covariance(ladder: object) -> None:
    with pytest.raises(MotionError, match="never fitted"):
        export_model(make(fit={"ladder": ladder}), "robot_localization")


def test_gains_in_use_are_corrected_and_unknown_ones_are_asked_for(tmp_path: Path) -> None:
    used = tmp_path / "vesc.yaml"
    used.write_text(
        "/**:\n  ros__parameters:\n    speed_to_erpm_gain: 4000\n    steering_angle_to_servo_gain: -1.0\n"
        "    steering_angle_to_servo_offset: 0.5\n    port: /dev/vesc\n    flag: true\n",
        encoding="utf-8",
    )
    effects = (find_effect("steering_offset")(o=0.03), find_effect("wheel_radius")(k=0.8))
    current = read_current(used, "vesc")
    found = read("vesc", export_model(make(*effects, vehicle=CAR), "vesc", current))
    assert found[ALL + "speed_to_erpm_gain"] == 5000.0
    assert found[ALL + "steering_angle_to_servo_offset"] == 0.53
    with pytest.raises(MotionError, match="is not known") as error:
        export_model(make(vehicle=CAR), "vesc")
    assert "--current vesc.yaml" in error.value.hint
    saved = tmp_path / "rover.params"
    saved.write_text("# Onboard\n1\t1\tRO_MAX_THR_SPEED\t2.5\t9\n", encoding="utf-8")
    text = export_model(make(find_effect("wheel_radius")(k=0.8)), "px4", read_current(saved, "px4"))
    assert read("px4", text)["RO_MAX_THR_SPEED"] == 2.0


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("vesc", "a: [", "is not YAML"),
        ("px4", "1 1 NAME\n", "vehicle, component, name"),
        ("nav2", "", "written without"),
    ],
)
def test_a_wrong_file_of_parameters_is_one_clear_error(
    name: str, text: str, what: str, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(MotionError, match=what) as error:
        read_current(file, name)
    assert error.value.where.startswith(str(file))


@pytest.mark.parametrize("k", [0.0, 5e-324, 1e-6])
def test_a_vehicle_that_does_not_move_has_no_parameters(k: float) -> None:
    for vehicle in (HUSKY, F1TENTH):
        stuck = make(find_effect("wheel_radius")(k=k, fixed=["k"]), vehicle=vehicle, fit=FIT)
        for target in list_targets():
            if target.name in {"json", "python"}:
                assert export_model(stuck, target.name)
                continue
            with pytest.raises(MotionError) as caught:
                export_model(stuck, target.name)
            assert caught.value.code in {"absurd_number", "wrong_vehicle"}
    assert caught.value.where == "wheel_radius.k"


def test_other_targets_and_vehicles_are_one_clear_error() -> None:
    with pytest.raises(MotionError, match="no export is called 'moveit'") as error:
        find_target("moveit")
    assert all(target.name in error.value.hint for target in list_targets())
    with pytest.raises(MotionError, match="husky_a200 is differential"):
        export_model(make(), "autoware")


def test_the_verb_writes_the_file_or_nothing(tmp_path: Path) -> None:
    model = tmp_path / "m.toml"
    model.write_text(
        '[vehicle]\npreset = "husky_a200"\n[[effect]]\nid = "effective_track"\nk = 1.8\n', "utf-8"
    )
    out = tmp_path / "p.yaml"
    export = ("model", "export", model, "--to")
    assert run_verb(*export, "ros2_control", "--out", out).returncode == 0
    assert "wheel_separation_multiplier: 1.8" in out.read_text(encoding="utf-8")
    done = run_verb(*export, "px4", "--out", tmp_path / "no" / "p")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)


def test_effects_that_move_the_vehicle_can_be_written_out() -> None:
    for kind in list_effects():
        for vehicle in kind.kinds:
            text = kind().choose_python(vehicle)
            assert (text is None) == (kind.place is Place.LOCALIZATION), kind.id


def test_what_the_fit_left_open_is_a_comment_and_no_parameter() -> None:
    effects = (
        find_effect("acceleration_limit")(limit=36.0),
        find_effect("body_speed_limit")(limit=2.0),
        find_effect("transport_delay")(d=0.2),
        find_effect("drive_lag")(tau=0.3),
    )
    intervals = {"acceleration_limit.limit": (0.1, 40.0), "drive_lag.tau": (0.1, 0.5)}
    fit = FIT | {"undecided": [["acceleration_limit", "wheel_speed_limit"]]}
    file = make(*effects, intervals=intervals, fit=fit)
    text = export_model(file, "nav2")
    assert "ax_max" not in text
    assert "vx_max" not in text
    assert take("nav2", file)["FollowPath.model_delay_vx"] == pytest.approx(0.3)
    lines = text.splitlines()
    assert "#   body_speed_limit.limit = 2 m/s, undetermined: the runs of the fit leave it open" in lines
    assert any("acceleration_limit.limit = 36 rad/s^2" in line and "undecided" in line for line in lines)
    numbers = {
        effect["id"]: effect["parameters"] for effect in json.loads(export_model(file, "json"))["effects"]
    }
    assert numbers["transport_delay"]["d"]["doubt"].startswith("undetermined")
    assert "doubt" not in numbers["drive_lag"]["tau"]
    fixed = make(find_effect("body_speed_limit")(limit=2.0, fixed=["limit"]), fit=FIT)
    assert take("nav2", fixed)["FollowPath.vx_max"] == 2.0
    limit = find_effect("body_speed_limit")(limit=2.0)
    ends = {"body_speed_limit.limit": (limit.parameters[0].bounds[0], 4.0)}
    text = export_model(make(limit, intervals=ends, fit=FIT), "nav2")
    assert "vx_max" not in text
    assert "undetermined: its interval reaches a limit of the search" in text


def test_limits_of_the_body_are_no_larger_than_it_was_driven() -> None:
    """Wheels that spin are not a body that turns: the gyro of a run with a limit of 3.68 rad/s saw 2.8."""
    limit = find_effect("body_turn_limit")(limit=3.68)
    runs = [{"run": "a", "driven_yaw_rate_radps": 2.8}, {"run": "b", "driven_yaw_rate_radps": 1.2}]
    known = {"intervals": {"body_turn_limit.limit": (3.5, 3.8)}}
    text = export_model(make(limit, fit=FIT | {"runs": runs}, **known), "nav2")
    assert "wz_max: 2.8\n" in text
    assert "no more than was driven: 2.8 rad/s (99th percentile)" in text
    slower = [{"run": "a", "driven_yaw_rate_radps": 4.0}]
    assert "wz_max: 3.68\n" in export_model(make(limit, fit=FIT | {"runs": slower}, **known), "nav2")
