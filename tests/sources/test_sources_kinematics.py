"""Ideal motion of every kind of vehicle, and a new kind as one file."""

import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.sources import Vehicle, find_preset
from pipeline.sources.kinematics import find_kinematics, list_kinds

ROOT = Path(__file__).parents[2]
CRAB = """
\"\"\"Mecanum wheels: rollers at 45 degrees; the vehicle also moves sideways.\"\"\"

import numpy as np

from pipeline.sources.kinematics import Kinematics, Quantity

_SIDES = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4


class Crab(Kinematics):
    inputs = (
        Quantity("front_left", "rad/s", "a wheel"),
        Quantity("front_right", "rad/s", "a wheel"),
        Quantity("rear_left", "rad/s", "a wheel"),
        Quantity("rear_right", "rad/s", "a wheel"),
    )
    geometry = (
        Quantity("wheel_radius_m", "m", "r"),
        Quantity("track_width_m", "m", "b"),
        Quantity("wheelbase_m", "m", "l"),
    )

    def forward(self, inputs, vehicle):
        wheels = np.stack([inputs[quantity.name] for quantity in self.inputs])
        x, y, w = vehicle.wheel_radius_m * _SIDES @ wheels
        return x, y, w / self._reach_m(vehicle)

    def inverse(self, body, vehicle):
        x, y, w = body
        wheels = 4 * _SIDES.T @ np.stack((x, y, w * self._reach_m(vehicle))) / vehicle.wheel_radius_m
        return {quantity.name: wheel for quantity, wheel in zip(self.inputs, wheels, strict=True)}

    def _reach_m(self, vehicle):
        return (vehicle.track_width_m + vehicle.wheelbase_m) / 2
"""

speeds = st.floats(-20.0, 20.0)


def preset(name: str, **changes: float) -> Vehicle:
    found = find_preset(name)
    assert found is not None
    return msgspec.structs.replace(found, **changes)


HUSKY, CAR = preset("husky"), preset("car")


def one(value: float) -> NDArray[np.float64]:
    return np.array([value])


def predict(vehicle: Vehicle, **inputs: float) -> list[float]:
    body = vehicle.kinematics.forward({name: one(value) for name, value in inputs.items()}, vehicle)
    return [float(part[0]) for part in body]


def ask(vehicle: Vehicle, forward: float, turning: float) -> dict[str, float]:
    inputs = vehicle.kinematics.inverse((one(forward), one(0.0), one(turning)), vehicle)
    return {name: float(values[0]) for name, values in inputs.items()}


@given(speeds, speeds)
def test_the_ideal_differential_drive_is_the_published_one(left: float, right: float) -> None:
    found = predict(HUSKY, left=left, right=right)
    assert found == pytest.approx([0.165 * (left + right) / 2.0, 0.0, 0.165 * (right - left) / 0.55])


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_body_command_comes_back_from_its_wheels(forward: float, turning: float) -> None:
    asked = ask(HUSKY, forward, turning)
    assert predict(HUSKY, **asked) == pytest.approx([forward, 0.0, turning], abs=1e-12)
    assert (asked["right"] > asked["left"]) == (turning > 0.0) or abs(turning) < 1e-9


def test_a_controller_that_widens_the_track_asks_for_more_difference() -> None:
    wide = preset("husky", controller_track_multiplier=1.875)
    assert predict(wide, **ask(wide, 0.0, 1.0)) == pytest.approx([0.0, 0.0, 1.875])


@given(st.floats(0.1, 8.0), st.floats(-0.5, 0.5), st.floats(-2.0, 2.0))
def test_a_car_turns_about_its_rear_axle(speed: float, steering: float, ahead: float) -> None:
    car = preset("car", base_to_rear_axle_m=ahead)
    found = predict(car, speed=speed, steering=steering)
    turning = speed * np.tan(steering) / 2.6
    # The rear axle itself does not move sideways; base_link ahead of it swings out with the turn.
    assert found == pytest.approx([speed, ahead * turning, turning])
    assert found[1] - car.kinematics.lever_m(car) * found[2] == pytest.approx(0.0, abs=1e-12)


@given(st.floats(0.1, 8.0), st.floats(-1.0, 1.0))
def test_a_cars_body_command_comes_back_within_its_steering(speed: float, turning: float) -> None:
    asked = ask(CAR, speed, turning)
    assert abs(asked["steering"]) <= 0.6
    if abs(asked["steering"]) < 0.6:
        assert predict(CAR, **asked)[2] == pytest.approx(turning, abs=1e-9)


YOUBOT, OMNI = (
    preset("youbot"),
    Vehicle(id="omni", name="omni", kind="omni", wheel_radius_m=0.05, track_width_m=0.36),
)
# How ideal mecanum wheels turn for a motion of the body, wheel by wheel: front left, front right, rear left,
# rear right [rad/s] for ahead, left [m/s] and counterclockwise [rad/s]; (0.3 + 0.47) / 2 m is their lever.
WHEELS = np.array([[1, -1, -0.385], [1, 1, 0.385], [1, 1, -0.385], [1, -1, 0.385]]) / 0.0475


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0), speeds)
def test_four_mecanum_wheels_are_two_sides_and_a_way_sideways(
    ahead: float, aside: float, around: float, rubbing: float
) -> None:
    body = np.array([ahead, aside, around])
    # The fourth combination of the wheels moves nothing: the motion is the least-squares one.
    front_left, front_right, rear_left, rear_right = WHEELS @ body + rubbing * np.array([1, 1, -1, -1])
    found = predict(
        YOUBOT,
        left=(front_left + rear_left) / 2,
        right=(front_right + rear_right) / 2,
        sideways=(front_right + rear_left - front_left - rear_right) / 4,
    )
    assert found == pytest.approx(body.tolist(), abs=1e-9)
    assert found == pytest.approx((np.linalg.pinv(WHEELS) @ WHEELS @ body).tolist(), abs=1e-9)


@pytest.mark.parametrize("vehicle", [YOUBOT, OMNI], ids=["mecanum", "omni"])
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0), st.floats(0.5, 2.0))
def test_a_sideways_command_comes_back_from_its_wheels(
    vehicle: Vehicle, ahead: float, aside: float, around: float, multiplier: float
) -> None:
    vehicle = msgspec.structs.replace(vehicle, controller_track_multiplier=multiplier)
    body = (one(ahead), one(aside), one(around))
    inputs = vehicle.kinematics.inverse(body, vehicle)
    assert np.allclose(vehicle.kinematics.asked(inputs, vehicle), body, atol=1e-12)
    moved = np.array([ahead, aside, around * multiplier]).reshape(3, 1)
    assert np.allclose(vehicle.kinematics.forward(inputs, vehicle), moved, atol=1e-12)


@pytest.mark.parametrize("kind", list_kinds())
def test_every_kind_says_its_inputs_its_geometry_and_its_source(kind: str) -> None:
    found = find_kinematics(kind)
    page = inspect.getdoc(type(found))
    assert page is not None
    assert "v_x = " in page
    assert "Source: " in page
    assert found.inputs
    assert {quantity.unit for quantity in found.inputs} <= {"rad/s", "m/s", "rad", "m"}
    assert {quantity.name for quantity in found.geometry} <= set(Vehicle.__struct_fields__)
    assert all(quantity.about for quantity in (*found.inputs, *found.geometry))


@pytest.mark.parametrize("kind", list_kinds())
@given(forward=st.floats(0.2, 1.0), turning=st.floats(-0.3, 0.3), multiplier=st.floats(0.5, 2.0))
def test_what_a_controller_asked_comes_back_from_the_inputs_of_every_kind(
    kind: str, forward: float, turning: float, multiplier: float
) -> None:
    vehicle = Vehicle(
        id="any",
        name="any",
        kind=kind,
        wheel_radius_m=0.2,
        track_width_m=0.6,
        wheelbase_m=0.8,
        controller_track_multiplier=multiplier,
    )
    body = (one(forward), one(0.0), one(turning))
    inputs = vehicle.kinematics.inverse(body, vehicle)
    assert set(inputs) == {quantity.name for quantity in vehicle.kinematics.inputs}
    assert np.allclose(vehicle.kinematics.asked(inputs, vehicle), body, atol=1e-12)


ASK_THE_COPY = """
import sys
from pathlib import Path
import numpy as np
import polars as pl
from pipeline.stages.inputs import hold_commands
from pipeline.sources import ConfigurationError, load_configuration, resolve_vehicle
text = '[vehicle]\\nname = "crab"\\nkind = "crab"\\nwheel_radius_m = 0.1\\ntrack_width_m = 0.5\\n'
for more in ("", "wheelbase_m = 0.3\\n"):
    Path("run.toml").write_text(text + more)
    section = load_configuration(Path("log.mcap"), given=Path("run.toml")).vehicle
    try:
        vehicle = resolve_vehicle(section, recorded=None, where="log.mcap")
    except ConfigurationError as error:
        print(error)
turns = dict(front_left=[-2.0], front_right=[2.0], rear_left=[2.0], rear_right=[-2.0])
table = pl.DataFrame({"t": [0.0], "active": [True], **turns})
print(hold_commands(np.array([0.1]), table, vehicle, 0.5).velocity.round(9).tolist())
"""


def test_a_new_kind_needs_no_other_file_to_be_configured_and_predicted(tmp_path: Path) -> None:
    for room in ("pipeline", "schemas"):
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__"))
    with (tmp_path / "pipeline" / "sources" / "kinematics.py").open("a") as file:
        file.write(f"{CRAB}\n\nKINDS = (*KINDS, Crab)\n")
    done = subprocess.run(
        [sys.executable, "-c", ASK_THE_COPY],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    incomplete, velocity = done.stdout.splitlines()
    assert "a vehicle of kind 'crab' needs wheelbase_m" in incomplete
    assert velocity == "[[0.0, 0.2, 0.0]]"
