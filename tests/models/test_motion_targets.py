"""What is exported is what its project documents, says where each line came from, and drives as was asked."""

import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from exported_files import CAR, F1TENTH, FIT, HUSKY, make, make_full, predict, read, take
from target_schemas import SCHEMAS
from verbs import run_verb

from pipeline import export
from pipeline.core import PACKAGE, read_version, split_interval
from pipeline.export import REACHED_ACCELERATION, Facts, export_model, list_targets
from pipeline.export.spread import find_response
from pipeline.models import find_effect, format_model, list_effects, name_term, predict_step, read_model
from pipeline.run import MotionError
from pipeline.simulate import simulate_case
from pipeline.sources import Vehicle, list_presets

PARAMETERS = sorted(SCHEMAS)
MECANUM = next(one for one in list_presets() if one.kind == "mecanum")
CASES = [
    (name, vehicle)
    for name in PARAMETERS
    for vehicle in (HUSKY, F1TENTH)
    if name not in {"autoware", "vesc"} or vehicle is F1TENTH
]


def test_targets_are_found_by_being_there() -> None:
    texts = [path.read_text("utf-8") for path in Path(export.__path__[0]).glob("[!_]*.py")]
    names = {target.name for target in list_targets()}
    assert names == {*SCHEMAS, "json", "python", "latex"}
    assert sum(text.count(" = Target(") for text in texts) == len(names)
    assert all(target.about and target.source for target in list_targets())


def test_names_types_and_bounds_are_those_that_the_project_declares_and_each_is_written() -> None:
    written: dict[str, set[str]] = {name: set() for name in PARAMETERS}
    # Some parameters are those of a kind of car or robot alone.
    cases = [(n, make_full(v)) for n, v in (*CASES, *((n, CAR) for n in PARAMETERS if n != "vesc"))]
    for name, file in (*cases, ("nav2", make(find_effect("transport_delay")(d=0.1), vehicle=MECANUM))):
        found = read(name, export_model(file, name))
        written[name] |= set(found)
        for path, value in found.items():
            schema = SCHEMAS[name][path]
            if isinstance(schema, int):
                kind = bool if path.endswith("config") else float
                assert isinstance(value, list)
                assert [type(item) for item in value] == [kind] * schema, path
            elif isinstance(schema, frozenset):
                assert value in schema, path
            else:
                assert type(value) is float, path
                assert schema[0] <= value <= schema[1], path
    assert written == {name: set(schema) for name, schema in SCHEMAS.items()}


def test_every_effect_stands_at_a_line_or_among_those_without_one() -> None:
    for name, vehicle in CASES:
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
        # What a step of the command does depends on all of them.
        assert name == "nav2" or unmapped >= {e.id for e in file.model} - known
        assert unmapped != {e.id for e in file.model} or name in {"robot_localization", "nav2_amcl"}


@pytest.mark.parametrize("known", [HUSKY, F1TENTH], ids=["robot", "car"])
@pytest.mark.parametrize("target", list_targets(), ids=lambda target: target.name)
def test_no_export_states_a_dimension_that_is_a_stand_in(target: export.Target, known: Vehicle) -> None:
    names = ["wheel_radius_m", *(["track_width_m"] if known is HUSKY else [])]
    guess = msgspec.structs.replace(known, wheel_radius_m=0.123, stand_ins=names)
    if known is HUSKY and target.name in {"autoware", "vesc"}:
        return
    text = export_model(make_full(guess), target.name)
    assert "Not known: " + " and ".join(names) in text
    # XML takes no two dashes: what to do is told without options, which it would have torn apart.
    assert "- -" not in text
    if target.name == "json":
        vehicle = json.loads(text)["vehicle"]
        assert [vehicle[name] for name in names] == [None] * len(names)
        assert vehicle["stand_ins"].keys() == set(names)
    elif target.name not in {"python", "latex"}:
        # Nothing else is missing: in limits of the body the stand-in cancels out.
        usual = read(target.name, export_model(make_full(known), target.name))
        found = read(target.name, text)
        gone = {path.rpartition(".")[2] for path in usual.keys() - found.keys()}
        dimensions = {"wheel_radius", "traction_wheels_radius", "wheel_separation", "RD_WHEEL_TRACK"}
        assert gone == {path.rpartition(".")[2] for path in usual} & dimensions - (
            set() if known is HUSKY else {"wheel_separation"}
        )


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


def test_a_vehicle_that_moves_sideways_is_late_in_three_directions() -> None:
    p = take("nav2", make(find_effect("transport_delay")(d=0.1), vehicle=MECANUM))
    assert {name.rpartition(".")[2]: value for name, value in p.items()} == {
        "model_delay_vx": 0.1,
        "model_delay_vy": 0.1,
        "model_delay_wz": 0.1,
    }


SLIPPING = (
    find_effect("effective_track")(k=1.8),
    find_effect("speed_track")(k=0.1),
    find_effect("speed_slip")(k=0.1),
    find_effect("drive_lag")(tau=0.3),
)


def test_the_steady_motion_at_each_speed_is_that_of_the_exported_function() -> None:
    response, turn = find_response(Facts(make(*SLIPPING))), 0.25
    for n, speed in enumerate(response.speeds.tolist()):
        half = turn * HUSKY.track_width_m / 2.0
        left, right = (speed - half) / HUSKY.wheel_radius_m, (speed + half) / HUSKY.wheel_radius_m
        rim = speed / HUSKY.wheel_radius_m
        straight = predict(make(*SLIPPING), [(-9.0, rim, rim)], 5.0)[-1]
        curved = predict(make(*SLIPPING), [(-9.0, left, right)], 5.0)[-1]
        assert response.linear[n] == pytest.approx(straight[4] / speed, rel=1e-3)
        assert response.angular[n] == pytest.approx(curved[6] / turn, rel=1e-3)


def test_a_multiplier_is_told_by_speed_where_one_does_not_fit() -> None:
    one = export_model(make(find_effect("effective_track")(k=1.8)), "ros2_control")
    assert "does not fit" not in one
    several = export_model(make(*SLIPPING), "ros2_control")
    response = find_response(Facts(make(*SLIPPING)))
    line = next(line for line in several.splitlines() if "wheel_separation_multiplier does not fit" in line)
    pairs = re.findall(r"([\d.]+) at ([\d.]+) m/s", line)
    told = [float(value) for value, _ in pairs]
    assert told == pytest.approx(response.separation.tolist(), abs=1e-3)
    assert [float(speed) for _, speed in pairs] == response.speeds.tolist()
    # The value of the track alone is another number than those of all effects: it says of what it is.
    assert f"of all effects together, at a yaw rate of {response.turn:.3g} rad/s" in several


def test_no_multiplier_is_told_of_a_speed_at_which_a_limit_clips_the_wheels() -> None:
    track, limit = find_effect("effective_track")(k=1.8), find_effect("wheel_speed_limit")(limit=4.0)
    response = find_response(Facts(make(track, limit)))
    assert 0 < response.is_clipped.sum() < response.speeds.size
    # What is left of the speeds is one track.
    assert "does not fit" not in export_model(make(track, limit), "ros2_control")
    text = export_model(make(*SLIPPING, limit), "ros2_control")
    (line,) = (one for one in text.splitlines() if "where a limit clips the wheels in that turn" in one)
    clipped = [f"{speed:g} m/s" for speed in response.speeds[response.is_clipped].tolist()]
    assert line == f"# Without {', '.join(clipped)}, where a limit clips the wheels in that turn."


def test_an_interval_says_of_which_run_it_is_and_what_another_one_would_show() -> None:
    ends = {"effective_track.k": (1.79, 1.82)}
    track = find_effect("effective_track")(k=1.8)
    (line,) = {
        line.strip("# ")
        for line in export_model(make(track, fit=FIT, intervals=ends), "ros2_control").splitlines()
        if "effective_track.k = " in line
    }
    found = re.fullmatch(r".*\(this run, 95 %: 1\.79 to 1\.82; another run: ([\d.]+) to ([\d.]+)\)", line)
    assert found is not None, line
    low, high = map(float, found.groups())
    assert low < ends["effective_track.k"][0] < ends["effective_track.k"][1] < high
    several = {**FIT, "runs": [*FIT["runs"], *FIT["runs"]]}  # type: ignore[misc]
    assert "(these runs, 95 %" in export_model(make(track, fit=several, intervals=ends), "ros2_control")


def test_an_expected_range_that_is_assumed_is_said_to_be() -> None:
    kinds = {kind.id: kind for kind in list_effects()}
    for name, said in {"effective_track": "", "body_turn_limit": ", assumed"}.items():
        effect = kinds[name](**{p.name: p.typical for p in kinds[name].parameters})
        (parameter,) = effect.parameters
        assert (parameter.between_runs is None) == bool(said)
        value = effect.values[parameter.name]
        ends = {f"{name}.{parameter.name}": (0.98 * value, 1.02 * value)}
        file = make(effect, fit=FIT, intervals=ends)
        expected = file.find_number(effect, parameter).elsewhere
        assert re.fullmatch(rf"another run: [\d.]+ to [\d.]+{said}", expected)
        assert f"# {expected}" in format_model(file)
        assert f"; {expected})" in export_model(file, "nav2" if said else "ros2_control")
        (told,) = json.loads(export_model(file, "json"))["effects"]
        number = told["parameters"][parameter.name]
        assert number["is_spread_measured"] == (not said)
        assert number["another_run"]["low"] < 0.98 * value < 1.02 * value < number["another_run"]["high"]


@pytest.mark.parametrize("name", sorted({target.name for target in list_targets()} - {"json"}))
def test_every_text_says_which_version_and_recording_its_values_come_from(name: str) -> None:
    (run,) = FIT["runs"]  # type: ignore[misc]
    fit = {**FIT, "runs": [{**run, "sha256": "8be38fc23b7a246891"}]}  # type: ignore[misc]
    vehicle = F1TENTH if name in {"autoware", "vesc"} else HUSKY
    ends = {"drive_lag.tau": (0.2, 0.4)}
    text = export_model(
        make(find_effect("drive_lag")(tau=0.3), vehicle=vehicle, fit=fit, intervals=ends), name
    )
    assert f"Written by {PACKAGE} {read_version()}." in text
    assert "Fitted from wheel encoders of 'yard/monday' (SHA-256 8be38fc23b7a)." in text
    assert "drive_lag.tau = 0.3 s (this run, 95 %: 0.2 to 0.4; another run: " in text


def test_a_table_for_latex_has_the_values_of_the_screen_and_a_mark_at_each_doubt() -> None:
    ends = {"effective_track.k": (1.79, 1.8206), "turn_acceleration_limit.limit": (1.9, 2.1)}
    file = make(
        find_effect("effective_track")(k=1.8053),
        find_effect("turn_acceleration_limit")(limit=2.0),
        find_effect("wheel_asymmetry")(e=-0.05),
        intervals=ends,
        doubts={"turn_acceleration_limit.limit": ("too_short", 0), "wheel_asymmetry.e": ("too_short", 0)},
    )
    text = export_model(file, "latex")
    body = [line for line in text.splitlines() if not line.startswith("%")]
    rows = [line.removesuffix(r" \\").split(" & ") for line in body if " & " in line]
    assert [row[0] for row in rows] == ["Effect", *(name_term(effect.id) for effect in file.model)]
    value, *ends_shown = split_interval(1.8053, *ends["effective_track.k"])
    known, limit, asymmetry = (
        next(row for row in rows if row[0] == name_term(name))
        for name in ("effective_track", "turn_acceleration_limit", "wheel_asymmetry")
    )
    assert known[2:] == [f"${value}$", f"${ends_shown[0]}$ to ${ends_shown[1]}$", ""]
    assert limit[2:] == [r"$2.00$\textsuperscript{a}", "$1.90$ to $2.10$", r"rad/s\textsuperscript{2}"]
    assert asymmetry[2:] == [r"$-0.05$\textsuperscript{a}", "--", ""]
    (note,) = [line for line in body if line.startswith(r"\multicolumn")]
    assert file.list_doubtful()["wheel_asymmetry.e"].reason in note
    assert (body[0], body[-1]) == (r"\begin{tabular}{llrll}", r"\end{tabular}")


def test_a_clock_of_poses_is_no_parameter_of_a_controller_and_is_said_not_to_be() -> None:
    (run,) = FIT["runs"]  # type: ignore[misc]
    late = {**FIT, "runs": [{**run, "pose_delay_s": 0.42}]}  # type: ignore[misc]
    text = export_model(make(find_effect("effective_track")(k=1.8), fit=late), "ros2_control")
    _, _, rest = text.partition("Not covered by these parameters:")
    assert "clock_offset.d = 0.42 s: the heading of the poses of 'yard/monday' is late" in rest


def test_a_parameter_that_no_effect_tells_is_named_as_one_that_is_not_written() -> None:
    text = export_model(make(find_effect("drive_lag")(tau=0.3)), "nav2")
    _, _, unknown = text.partition("Not written, as no effect of the model determines it:")
    assert "FollowPath.vx_max" in unknown.partition("controller_server:")[0]
    assert "vx_max" not in unknown.partition("controller_server:")[2]


def test_a_length_alone_makes_no_deadband() -> None:
    text = export_model(make(find_effect("wheel_radius")(k=0.93)), "nav2")
    _, _, unknown = text.partition("Not written, as no effect of the model determines it:")
    assert "VelocityDeadbandCritic.deadband_velocities" in unknown
    assert "deadband_velocities:" not in text


def test_a_dimension_that_the_runs_contradict_is_a_comment_until_it_is_changed() -> None:
    """A radius that was twice the true one was told of, and went into the controller without a word."""
    file = make(fit={**FIT, "contradicted": {"wheel_radius_m": HUSKY.wheel_radius_m}})
    said = "in doubt: findings of the runs of the fit contradict it"
    assert f"# wheel_radius_m is {said}" in format_model(file)
    text = export_model(file, "ros2_control")
    assert f"# vehicle husky_a200: wheel_radius_m, {said}\n    # wheel_radius: 0.165" in text
    assert "\n    wheel_separation: 0.55" in text
    other = make(vehicle=msgspec.structs.replace(HUSKY, wheel_radius_m=0.17), fit=file.fit)
    assert "\n    wheel_radius: 0.17" in export_model(other, "ros2_control")


def test_a_fit_notes_the_dimensions_that_its_run_contradicts(tmp_path: Path) -> None:
    log, model = tmp_path / "log.mcap", tmp_path / "m.toml"
    simulate_case("ideal_husky", {"effective_track": 1.6}, out=log, duration_s=100.0)
    (tmp_path / "run.toml").write_text('[vehicle]\npreset = "husky_a200"\nwheel_radius_m = 0.2\n')
    run_verb("diagnose", log, "--apply", model, "--results", tmp_path / "results")
    file = read_model(model)
    assert file.contradicted == ["wheel_radius_m"]
    (run,) = file.list_fitted("runs")
    assert 0.5 < run[REACHED_ACCELERATION] < 20.0  # type: ignore[operator]


def test_an_acceleration_is_exported_as_the_robot_reaches_it() -> None:
    """A limit of commands, which slow motors follow late, was higher than any acceleration of the drive."""
    (run,) = FIT["runs"]  # type: ignore[misc]
    slow = {**FIT, "runs": [{**run, REACHED_ACCELERATION: 3.1}]}  # type: ignore[misc]
    limit = find_effect("body_acceleration_limit")(limit=5.35)
    known = {"body_acceleration_limit.limit": (5.1, 5.6)}
    text = export_model(make(limit, fit=slow, intervals=known), "ros2_control")
    assert "no more than was driven: 3.1 m/s^2" in text
    assert "max_acceleration: 3.1\n" in text
    assert "max_acceleration: 5.35\n" in export_model(make(limit, fit=FIT, intervals=known), "ros2_control")


@pytest.mark.parametrize(("turned", "drove"), [(0.108, 1.97), (0.9, 0.05)])
def test_the_delay_of_a_motion_that_was_hardly_driven_is_in_doubt(turned: float, drove: float) -> None:
    run = {**FIT["runs"][0], "driven_speed_mps": drove, "driven_yaw_rate_radps": turned}  # type: ignore[index]
    fit = {**FIT, "runs": [run], "noise_floor": {"velocity_rms": [0.036, 0.035, 0.038]}}
    delay, ends = find_effect("transport_delay")(d=0.29), {"transport_delay.d": (0.26, 0.32)}
    text = export_model(make(delay, fit=fit, intervals=ends), "nav2")
    hardly_turned = turned < drove
    known, assumed = ("vx", "wz") if hardly_turned else ("wz", "vx")
    assert f"\n      model_delay_{known}: 0.29" in text
    assert f"\n      # model_delay_{assumed}: 0.29" in text
    said = ("turned", "driving") if hardly_turned else ("drove ahead", "turning")
    assert text.count(f"# the run hardly {said[0]}: the delay is assumed equal to that of {said[1]}") == 1
    assert "# What depends on a value in doubt is commented out." in text


def test_a_delay_that_depends_on_the_step_is_told_by_step() -> None:
    servo = find_effect("wheel_servo")(tau=0.2, bound=1.5, no_load=4.0, scrub=1.2, reset=0.35)
    fit = {**FIT, "runs": [{**FIT["runs"][0], "driven_speed_mps": 2.0, "driven_yaw_rate_radps": 3.0}]}  # type: ignore[index]
    ends = {f"wheel_servo.{name}": (0.9 * value, 1.1 * value) for name, value in servo.values.items()}
    text = export_model(make(servo, fit=fit, intervals=ends), "nav2")
    above, _, _ = text.partition("model_delay_wz")
    told = re.findall(r"([\d.]+) s after a step of ([\d.]+) rad/s", above)
    assert [float(step) for _, step in told] == [3.0, 1.5, 0.75]
    for late, step in told:
        motion = predict_step(HUSKY, (servo,), 0.0, float(step), 20.0).w  # type: ignore[arg-type]
        true = np.flatnonzero(motion >= 0.632 * motion[-1])[0] * 0.02
        assert float(late) == pytest.approx(true, abs=0.02, rel=0.05)
    lates = [float(late) for late, _ in told]
    assert max(lates) > 1.5 * min(lates)
    assert "# one delay does not fit these steps" in above
    assert "\n      # model_delay_wz: " in text


def test_limits_of_the_body_name_the_correction_that_they_presuppose() -> None:
    limit, track = find_effect("body_turn_limit")(limit=0.63), find_effect("effective_track")(k=1.7)
    said = "is corrected for effective_track: slip model export MODEL --to ros2_control."
    assert said in export_model(make(limit, track), "nav2")
    assert "is corrected for" not in export_model(make(limit), "nav2")
    assert "is corrected for" not in export_model(make(track), "nav2")


@pytest.mark.parametrize("dead_s", [0.0, 0.1])
def test_mppi_is_told_the_step_response_that_the_motors_have(dead_s: float) -> None:
    # Its time constant is that of a motor without load: on the ground it is later, most of all in a turn.
    servo = find_effect("wheel_servo")(tau=0.2, bound=1.5, no_load=4.0, scrub=1.2, reset=0.35)
    fit = {**FIT, "runs": [{**FIT["runs"][0], "driven_speed_mps": 2.0, "driven_yaw_rate_radps": 3.0}]}  # type: ignore[index]
    ends = {f"wheel_servo.{name}": (0.9 * value, 1.1 * value) for name, value in servo.values.items()}
    ends["transport_delay.d"] = (0.09, 0.11)
    delay = find_effect("transport_delay")(d=dead_s)
    text = export_model(make(servo, delay, fit=fit, intervals=ends), "nav2")
    told = re.findall(r"model_delay_(vx|wz): ([\d.]+)", text)
    p = {axis: float(value) for axis, value in told}
    for axis, asked in (("vx", (2.0, 0.0)), ("wz", (0.0, 3.0))):
        moved = predict_step(HUSKY, (servo,), *asked, 20.0)  # type: ignore[arg-type]
        motion = moved.w if asked[1] else moved.x
        late = np.flatnonzero(motion >= 0.632 * motion[-1])[0] * 0.02
        assert late > 0.2
        assert p[axis] == pytest.approx(dead_s + late, abs=0.02)


def test_a_motion_that_grows_slowly_is_no_delay() -> None:
    lag = find_effect("turn_lag")(tau_mean=0.2, tau_diff=2.7)
    ends = {"turn_lag.tau_mean": (0.19, 0.21), "turn_lag.tau_diff": (2.6, 2.8)}
    text = export_model(make(lag, fit=FIT, intervals=ends), "nav2")
    assert "\n      model_delay_vx: 0.2" in text
    assert "# no delay describes a motion that grows for more than 2 s" in text
    assert "\n      # model_delay_wz: 2.69" in text


def test_what_several_parameters_come_from_is_said_once() -> None:
    ends = {"body_speed_limit.limit": (0.89, 0.91), "body_turn_limit.limit": (1.09, 1.11)}
    limits = [find_effect("body_speed_limit")(limit=0.9), find_effect("body_turn_limit")(limit=1.1)]
    file = make(*limits, fit=FIT, intervals=ends)
    text = export_model(file, "nav2")
    sources = [line for line in text.splitlines() if " = " in line or "no more than was driven: " in line]
    assert len(sources) == len(set(sources)) > 1
    values = [
        line for line in text.splitlines() if line.lstrip().startswith(("vx_m", "wz_m", "max_", "min_"))
    ]
    assert len(values) > len(sources)


@pytest.mark.parametrize(
    ("gate", "applied", "mode"), [("off", False, "off"), ("on", True, "off"), ("auto", True, "auto")]
)
def test_a_steering_offset_has_a_gate_and_the_condition_of_its_learning(
    gate: str,
    applied: bool,  # noqa: FBT001 - a case
    mode: str,
) -> None:
    file = make(
        find_effect("steering_offset")(o=0.03),
        vehicle=CAR,
        fit=FIT,
        intervals={"steering_offset.o": (0.026, 0.034)},
    )
    text = export_model(file, "autoware", gate=gate)
    found = {path.rpartition("ros__parameters.")[2]: value for path, value in read("autoware", text).items()}
    assert found["steering_offset.enable_auto_steering_offset_removal"] is applied
    assert found["calibration.mode"] == mode
    assert found.get("steer_offset") == (0.03 if applied else None)
    assert f"steer_offset = 0.03 rad with gate {gate}" in text
    assert "learned mostly at 0.5 to 90 m/s, up to 90 rad/s, on 'gravel'" in text
    learning = {"initial_offset": 0.03, "initial_covariance": (0.004 / 1.96) ** 2, "min_velocity": 0.5}
    if gate == "auto":
        assert {name: found[name] for name in learning} == pytest.approx(learning, rel=1e-3)
        assert text == export_model(file, "autoware")
    else:
        assert not found.keys() & learning.keys()


def test_a_gate_is_refused_where_there_is_none() -> None:
    with pytest.raises(MotionError, match="nav2 has no gate 'on'"):
        export_model(make(), "nav2", gate="on")
    with pytest.raises(MotionError, match="no gate 'perhaps'"):
        export_model(make(vehicle=CAR), "autoware", gate="perhaps")


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


def test_the_verb_writes_the_file_or_nothing(tmp_path: Path) -> None:
    model = tmp_path / "m.toml"
    model.write_text(
        '[vehicle]\npreset = "husky_a200"\n[[effect]]\nid = "effective_track"\nk = 1.8\n', "utf-8"
    )
    out = tmp_path / "p.yaml"
    export = ("model", "export", model, "--to")
    assert run_verb(*export, "ros2_control", "--file", out).returncode == 0
    assert "wheel_separation_multiplier: 1.8" in out.read_text(encoding="utf-8")
    done = run_verb(*export, "px4", "--file", tmp_path / "no" / "p")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
