"""The twin's files move as the model does, are what MuJoCo and Gazebo read, and say what they lack."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, cast
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
import pytest
from motion_runs import vehicle_of
from verbs import run_verb

from pipeline.export import export_model, twin_files
from pipeline.export.twin_body import build_twin_body, weigh_chassis, weigh_wheel
from pipeline.models import Model, ModelFile, Place, find_effect, list_effects, write_model
from pipeline.run import MotionError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from pipeline.models import Effect
    from pipeline.sources import Vehicle

HUSKY, WARTHOG, CAR, TURTLEBOT = map(vehicle_of, ("husky_a200", "warthog", "ackermann_car", "turtlebot4"))
CELL_S = 0.02

# Elements of gazebosim/sdformat sdf/1.9 (physics, link, inertial, joint, surface and geometry .sdf, in the
# newest file of each), as far as a base of wheels needs them: children by parent; ! marks required ones.
SDF_CHILDREN = {
    "sdf": "world",
    "world": "physics plugin model",
    "physics": "max_step_size! real_time_factor!",
    "model": "static pose link joint plugin",
    "link": "pose inertial collision visual",
    "inertial": "pose mass inertia",
    "inertia": "ixx iyy izz ixy ixz iyz",
    "collision": "pose geometry! surface",
    "visual": "pose geometry!",
    "geometry": "plane box sphere cylinder",
    "plane": "normal! size!",
    "box": "size!",
    "sphere": "radius!",
    "cylinder": "radius! length!",
    "surface": "friction",
    "friction": "ode",
    "ode": "mu mu2 fdir1 slip1 slip2",
    "joint": "parent! child! axis",
    "axis": "xyz! limit",
    "limit": "lower upper",
}
SDF_ATTRIBUTES = {
    "sdf": {"version"}, "world": {"name"}, "physics": {"name", "type"}, "model": {"name"}, "link": {"name"},
    "collision": {"name"}, "visual": {"name"}, "joint": {"name", "type"}, "plugin": {"name", "filename"},
}  # fmt: skip


def make(vehicle: Vehicle, **sizes: float | dict[str, float]) -> ModelFile:
    effects = []
    for name, size in sizes.items():
        effect = find_effect(name)()
        values = size if isinstance(size, dict) else {effect.parameters[0].name: size}
        effects.append(effect.change(**values))
    return ModelFile(Model(vehicle, tuple(effects)))


def make_full(vehicle: Vehicle) -> ModelFile:
    effects: list[Effect] = [
        kind().change(**{p.name: p.typical for p in kind.parameters if not p.instead_of})
        for kind in list_effects()
        if vehicle.kind in kind.kinds
    ]
    return ModelFile(Model(vehicle, tuple(effects)))


def drive(file: ModelFile, told: list[float], duration_s: float = 3.0) -> NDArray[np.float64]:
    """Velocity of base_link (v_x, v_y, v_w) every 0.02 s from standstill, shape (n, 3)."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
    model = mujoco.MjModel.from_xml_string(export_model(file, "mjcf"))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=200)
    poses = [data.qpos[:7].copy()]
    data.ctrl[:] = told
    for _ in range(round(duration_s / CELL_S)):
        mujoco.mj_step(model, data, nstep=round(CELL_S / model.opt.timestep))
        poses.append(data.qpos[:7].copy())
    found = np.array(poses)
    w, x, y, z = found[:, 3:].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    moved = np.diff(found[:, 0] + 1j * found[:, 1]) * np.exp(-0.5j * (yaw[1:] + yaw[:-1])) / CELL_S
    return np.column_stack((moved.real, moved.imag, np.diff(yaw) / CELL_S))


def ask(vehicle: Vehicle, v: float, w: float, track: float) -> list[float]:
    """Speeds of four wheels, or two, that give a body velocity on this effective track."""
    left, right = ((v + side * 0.5 * w * track) / vehicle.wheel_radius_m for side in (-1, 1))
    return [left, right, left, right] if vehicle.wheelbase_m else [left, right]


def find_rise(values: NDArray[np.float64]) -> float:
    """When a signal reaches 63 % of where it ends [s]."""
    return (int(np.argmax(np.abs(values) > (1.0 - math.exp(-1.0)) * abs(values[-1]))) + 0.5) * CELL_S


@pytest.mark.parametrize("vehicle", [HUSKY, WARTHOG, CAR, TURTLEBOT], ids=lambda vehicle: vehicle.id)
def test_mujoco_finds_the_mobility_that_the_contacts_were_computed_for(vehicle: Vehicle) -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
    file = make_full(vehicle)
    body = build_twin_body(file.model, twin_files.find_driven_speed(file))
    model = mujoco.MjModel.from_xml_string(export_model(file, "mjcf"))
    own = [float(model.body(wheel.name).invweight0[0]) for wheel in body.wheels]
    assert twin_files._find_mobilities(body) == pytest.approx(own, rel=1e-4)


@pytest.mark.parametrize(("v", "w"), [(0.0, 0.8), (0.8, 0.1), (0.8, 0.8), (-0.8, 0.5)])
def test_a_skid_steer_turns_and_slides_as_its_model_in_every_motion(v: float, w: float) -> None:
    file = make(HUSKY, effective_track=1.8, lateral_skid=0.06, icr_offset=0.1)
    track = 1.8 * (HUSKY.track_width_m or 0.0)
    ends = drive(file, ask(HUSKY, v, w, track), 1.5)[-1]
    assert ends == pytest.approx([v, -0.1 * w - 0.06 * v * w, w], rel=0.02, abs=0.008)


def test_lag_delay_gain_and_limit_of_the_servos_are_those_of_the_model() -> None:
    file = make(HUSKY, drive_lag=0.3, transport_delay=0.2, drive_gain=0.9, effective_track=1.7)
    speed = drive(file, [4.0] * 4)[:, 0]
    assert speed[-1] == pytest.approx(0.9 * 4.0 * HUSKY.wheel_radius_m, rel=0.01)
    assert np.abs(speed[: round(0.18 / CELL_S)]).max() < 1e-3
    assert find_rise(speed) == pytest.approx(0.5, abs=0.02)
    held = drive(make(HUSKY, wheel_speed_limit=3.0, effective_track=1.8), [6.0] * 4, 1.0)[-1, 0]
    assert held == pytest.approx(3.0 * HUSKY.wheel_radius_m, rel=0.01)


def test_smaller_wheels_on_one_side_pull_to_that_side() -> None:
    ends = drive(make(WARTHOG, wheel_asymmetry=0.04, effective_track=1.6), [5.0] * 4, 2.0)[-1]
    track = 1.6 * (WARTHOG.track_width_m or 0.0)
    assert ends[2] == pytest.approx(0.04 * 5.0 * WARTHOG.wheel_radius_m / track, rel=0.05)


def test_a_body_with_little_grip_follows_its_wheels_late_and_slides_on() -> None:
    file = make(HUSKY, body_inertia=0.4, effective_track=2.2)
    track = 2.2 * (HUSKY.track_width_m or 0.0)
    found = drive(file, ask(HUSKY, 0.8, 0.5, track))
    assert find_rise(found[:, 2]) == pytest.approx(0.4, abs=0.04)
    v_x = 0.8 / (1.0 + (0.4 * 0.5) ** 2)
    assert found[-1] == pytest.approx([v_x, -0.4 * 0.5 * v_x, 0.5], rel=0.03)


def test_a_base_on_castors_turns_by_its_effective_track() -> None:
    track = 1.1 * (TURTLEBOT.track_width_m or 0.0)
    ends = drive(make(TURTLEBOT, effective_track=1.1), ask(TURTLEBOT, 0.3, 1.0, track), 1.0)[-1]
    assert ends == pytest.approx([0.3, 0.0, 1.0], rel=0.01, abs=0.01)


def test_a_car_steers_late_off_centre_and_understeers() -> None:
    length, speed = CAR.wheelbase_m or 1.0, 3.0
    told = [speed / CAR.wheel_radius_m, 0.2]
    file = make(CAR, steering_gain=0.9, steering_offset=0.03, steering_lag=0.3)
    found = drive(file, told)
    assert found[-1] == pytest.approx([speed, 0.0, speed * math.tan(0.21) / length], rel=0.01, abs=0.02)
    rounded = ModelFile(
        make(CAR, understeer=0.05).model, fit={"runs": [{"run": "a", "driven_speed_mps": speed}]}
    )
    turn = drive(rounded, told)[-1, 2]
    assert turn == pytest.approx(speed * math.tan(0.2) / (length + 0.05 * speed**2), rel=0.02)
    turn = drive(make(CAR, effective_wheelbase=1.2), told)[-1, 2]
    assert turn == pytest.approx(speed * math.tan(0.2) / (1.2 * length), rel=0.02)


@pytest.mark.parametrize("to", ["mjcf", "sdf"])
@pytest.mark.parametrize("vehicle", [HUSKY, CAR, TURTLEBOT], ids=lambda vehicle: vehicle.id)
def test_every_effect_is_in_the_twin_or_said_not_to_be(vehicle: Vehicle, to: str) -> None:
    file = make_full(vehicle)
    body = build_twin_body(file.model)
    text = export_model(file, to)
    groups = (body.controller, body.reported, body.missing)
    outside = {effect.id for group in groups for effect in group}
    limits = {
        "body_speed_limit", "body_turn_limit", "wheel_speed_limit", "wheel_speed_scaling",
        "acceleration_limit", "body_acceleration_limit", "turn_acceleration_limit",
    }  # fmt: skip
    assert all(f"{name}(" in text for name in outside - (limits if to == "sdf" else set()))
    assert to == "mjcf" or ("<max_" in text and "acceleration>" in text)
    inside = {
        "transport_delay", "wheel_radius", "wheel_asymmetry", "effective_track", "icr_offset", "icr_lateral",
        "lateral_skid", "body_inertia", "understeer", "steering_sensor_offset", "steering_offset",
        "side_gain", "drive_gain", "contact_friction", "effective_wheelbase",
    }  # fmt: skip
    assert set(file.model.ids) - outside <= inside
    # Creep and track of wheels that slide are those of the contact.
    slides = "contact_friction" in file.model.ids
    assert slides == ({"effective_track", "body_inertia"} <= {effect.id for effect in body.missing})
    assert {"speed_slip", "yaw_drift", "slope_drift"} <= {effect.id for effect in body.missing}
    assert all(effect.place <= Place.DRIVE for effect in body.controller)


def test_ramps_of_commands_are_limits_of_the_plugin() -> None:
    ramps = make(HUSKY, body_acceleration_limit=0.9, turn_acceleration_limit=1.7, effective_track=1.8)
    text = export_model(ramps, "sdf")
    assert "<max_linear_acceleration>0.9<" in text
    assert "<max_angular_acceleration>1.7<" in text
    assert "acceleration_limit(" not in text


def test_servos_stand_for_the_end_of_the_drivetrain_only() -> None:
    """What a servo does happens last: a lag before a droop of the turn stays with the controller."""
    alone = build_twin_body(make(HUSKY, drive_lag=0.3, drive_gain=0.9).model)
    assert alone.controller == ()
    assert alone.servos["left"].lag_s == pytest.approx(0.3 - alone.creep_s)
    before = build_twin_body(
        make(HUSKY, drive_lag=0.3, turn_droop={"threshold": 1.0, "gain": 0.5}, drive_gain=0.9).model
    )
    assert [effect.id for effect in before.controller] == ["drive_gain", "drive_lag", "turn_droop"]
    assert before.servos["left"].lag_s == 0.0
    limited = build_twin_body(make(HUSKY, drive_gain=0.9, wheel_speed_limit=3.0, drive_lag=0.3).model)
    assert [effect.id for effect in limited.controller] == ["drive_gain"]
    assert limited.wheel_limit_radps == 3.0
    assert limited.servos["left"].gain == 1.0


def check_sdf(element: ET.Element) -> None:
    assert set(element.attrib) == SDF_ATTRIBUTES.get(element.tag, set()), element.tag
    if element.tag == "plugin":
        return
    allowed = SDF_CHILDREN.get(element.tag, "").split()
    present = {child.tag for child in element}
    assert present <= {name.rstrip("!") for name in allowed}, element.tag
    assert {name[:-1] for name in allowed if name.endswith("!")} <= present, element.tag
    for child in element:
        check_sdf(child)


@pytest.mark.parametrize("vehicle", [HUSKY, CAR, TURTLEBOT], ids=lambda vehicle: vehicle.id)
def test_the_world_of_gazebo_has_the_elements_of_sdformat_and_joints_that_exist(vehicle: Vehicle) -> None:
    root = ET.fromstring(export_model(make_full(vehicle), "sdf"))  # noqa: S314 - written just now
    check_sdf(root)
    model = next(one for one in root.iter("model") if one.get("name") == vehicle.id)
    joints = {joint.get("name") for joint in model.iter("joint")}
    links = {link.get("name") for link in model.iter("link")}
    plugin = cast("ET.Element", model.find("plugin"))
    named = {child.text for child in plugin if child.tag.endswith("_joint")}
    assert named == joints
    assert {
        end.text for joint in model.iter("joint") for end in joint if end.tag in {"parent", "child"}
    } == links


def test_wheels_of_gazebo_slip_as_those_of_mujoco_creep() -> None:
    file = make(HUSKY, effective_track=1.8, lateral_skid=0.06)
    root = ET.fromstring(export_model(file, "sdf"))  # noqa: S314 - written just now
    slips = [
        (float(ode.findtext("slip1", "0")), float(ode.findtext("slip2", "0"))) for ode in root.iter("ode")
    ]
    wheels = [slip for slip in slips if slip != (0.0, 0.0)]
    mass, long, wide = HUSKY.mass_kg or 0.0, HUSKY.wheelbase_m or 0.0, HUSKY.track_width_m or 0.0
    aside, along = wheels[0]
    assert len(wheels) == 4
    # v_y = -T v w, and 1 + (L / b)^2 T_along / T_aside is the effective track over the nominal one.
    assert mass * aside / 4.0 == pytest.approx(0.06, rel=1e-4)
    assert 1.0 + (long / wide) ** 2 * along / aside == pytest.approx(1.8, rel=1e-4)


def test_limits_of_gazebo_are_those_of_the_controller_with_its_own_geometry() -> None:
    """The ground of the world slows the turn itself: limits are not lowered by it again."""
    limits = {"wheel_speed_limit": 5.0, "body_turn_limit": 1.0}
    file = make(HUSKY, **limits, wheel_radius=0.8, effective_track=2.0)
    file = replace(file, fit={"runs": [{"driven_speed_mps": 0.3, "driven_yaw_rate_radps": 0.4}]})
    (plugin,) = (
        one
        for one in ET.fromstring(export_model(file, "sdf")).iter("plugin")  # noqa: S314 - written just now
        if one.find("wheel_radius") is not None
    )
    numbers = {child.tag: child.text or "" for child in plugin}
    assert float(numbers["wheel_radius"]) == pytest.approx(HUSKY.wheel_radius_m)
    assert float(numbers["max_linear_velocity"]) == pytest.approx(5.0 * HUSKY.wheel_radius_m)
    assert float(numbers["max_angular_velocity"]) == pytest.approx(1.0)


@pytest.mark.parametrize("gyration", [0.25, 0.4, 0.95])
def test_wheels_and_chassis_have_the_moment_of_inertia_of_the_model(gyration: float) -> None:
    sliding = {"friction": 0.1, "creep": 0.4, "k": 1.55, "gyration": gyration}
    body = build_twin_body(make(HUSKY, contact_friction=sliding).model)
    x, y = body.centre_m
    turning = weigh_chassis(body)[1][1]
    for wheel in body.wheels:
        mass, _, across = weigh_wheel(wheel, body)
        turning += across + mass * ((wheel.x_m - x) ** 2 + (wheel.y_m - y) ** 2)
    half = 0.5 * (HUSKY.track_width_m or 0.0)
    assert turning == pytest.approx((HUSKY.mass_kg or 0.0) * (gyration * half) ** 2)


def test_the_file_says_where_skid_makes_friction_uneven() -> None:
    sliding = {"friction": 0.1, "creep": 0.4, "k": 1.55, "gyration": 0.95}
    said = "Lengthwise they slide above"
    assert said not in export_model(make(HUSKY, contact_friction=sliding), "mjcf")
    text = export_model(make(HUSKY, contact_friction=sliding, lateral_skid=0.2), "mjcf")
    assert f"{said} 0.33" in text
    assert "constant of 0 s" not in text


def test_other_vehicles_and_unknown_geometry_are_one_clear_error() -> None:
    with pytest.raises(MotionError, match="a twin exists of differential and ackermann vehicles"):
        export_model(ModelFile(Model(vehicle_of("youbot"))), "mjcf")
    with pytest.raises(MotionError, match="track width of the vehicle is not known"):
        export_model(ModelFile(Model(msgspec.structs.replace(HUSKY, track_width_m=None))), "mjcf")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--twin", "a.toml", "--seed", 3), "--seed has no meaning with --twin"),
        (("--page", "a.html"), "--page is for"),
    ],
)
def test_options_that_would_do_nothing_are_refused(options: tuple[object, ...], said: str) -> None:
    refused = run_verb("simulate", *options)
    assert refused.returncode == 1
    assert said in refused.stderr


@pytest.mark.parametrize("to", ["mjcf", "sdf"])
def test_a_vehicles_name_stays_a_name_in_xml(to: str) -> None:
    hostile = msgspec.structs.replace(HUSKY, name="a --> <plugin/> <!-- b\n--", id='h"><plugin/>')
    text = export_model(make(hostile, effective_track=1.8), to)
    usual = export_model(make(HUSKY, effective_track=1.8), to)
    tags = [[part.tag for part in ET.fromstring(one).iter()] for one in (text, usual)]  # noqa: S314 - our own
    assert tags[0] == tags[1]


def test_files_are_written_without_mujoco_and_a_replay_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    path = tmp_path / "husky.toml"
    write_model(make(HUSKY, effective_track=1.8, lateral_skid=0.05), path)
    for to in ("mjcf", "sdf"):
        done = run_verb("model", "export", path, "--to", to, "--file", tmp_path / to)
        assert done.returncode == 0, done.stderr
        assert ET.parse(tmp_path / to).getroot().tag in {"mujoco", "sdf"}  # noqa: S314 - written just now
    refused = run_verb("simulate", "run.mcap", "--twin", path)
    assert refused.returncode == 1
    assert refused.stderr.count("\n") == 1
    assert "not installed" in refused.stderr
    assert "slip-pipeline[sim]" in refused.stderr
