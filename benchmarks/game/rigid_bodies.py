"""A four-wheel skid-steer of rigid bodies and friction: slip comes out of contact, not of a formula.

No effect of the catalogue is switched on here; the physical causes are: a wide
effective track from scrubbing wheels, late motion from little grip, drift from a slope or a payload.
Wheels are heavy to turn (armature) and stiffly driven, contacts are explicit pairs with an elliptic friction
cone and a soft tangential constraint: without these a simulated skid-steer scrubs far too much.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pipeline.core import (
    GRAVITY_MPS2,
    Floats,
    invert_quaternions,
    multiply_quaternions,
    rotate,
    rotation_vectors,
)
from pipeline.simulate.drivetrain import apply_ideal_model
from pipeline.simulate.facts import Effects, SimulateError, Vehicle, resolve_effects
from pipeline.simulate.path import Path
from pipeline.simulate.run import SimulatedRun, Truth, ask_wheels, record_truth
from pipeline.simulate.scenario import BodyMotion, Drive, Scenario

_STEP_S = 0.002
_SETTLE_STEPS = 500
_ALLOWED = (
    "body_speed_limit",
    "body_turn_limit",
    "deadband",
    "transport_delay",
    "wheel_speed_limit",
    "acceleration_limit",
    "drive_lag",
    "turn_lag",
    "turn_droop",
    "heading_skew",
    "yaw_misalignment",
    "lever_arm",
    "clock_offset",
)
_WHEELS = ("front_left", "front_right", "rear_left", "rear_right")


@dataclass(frozen=True)
class SkidSteer:
    """The physical vehicle and its ground.

    Attributes:
        mass_kg: chassis without wheels and payload.
        wheel_mass_kg: each wheel.
        friction: coefficient between wheels and ground; 0.8 is tarmac, 0.1 is ice.
        payload_kg, payload_x_m, payload_y_m: a load on the chassis and where it stands.
        left_radius_scale: true radius of the left wheels over the nominal one (soft or worn tyres).
        servo_nms: stiffness of the wheel speed servo [N m s/rad].
        torque_nm: most that a wheel's motor can give.
        armature_kgm2: inertia of a geared motor, seen at the wheel.
        slip_time_s: time constant of the tangential contact constraint; larger creeps more.
    """

    mass_kg: float = 50.0
    wheel_mass_kg: float = 5.0
    friction: float = 0.6
    payload_kg: float = 0.0
    payload_x_m: float = 0.0
    payload_y_m: float = 0.0
    left_radius_scale: float = 1.0
    servo_nms: float = 300.0
    torque_nm: float = 200.0
    armature_kgm2: float = 2.0
    slip_time_s: float = 0.02


MACHINES: dict[str, SkidSteer] = {
    "husky": SkidSteer(),
    "warthog": SkidSteer(
        mass_kg=390.0, wheel_mass_kg=20.0, servo_nms=2000.0, torque_nm=1500.0, armature_kgm2=20.0
    ),
}


def simulate_skid_steer(scenario: Scenario, machine: SkidSteer) -> SimulatedRun:
    """Drive a rigid-body skid-steer through a scenario.

    Args:
        scenario: vehicle geometry, program, slope, sensors and recording; of its effects only those between
            command and wheels and those of the localization.
        machine: masses, grip and motors.

    Raises:
        SimulateError: ``wrong_vehicle`` for a car,
            ``not_physical`` for a ground effect, hills or odd physics.
    """
    vehicle = scenario.vehicle
    effects = resolve_effects(scenario.effects, vehicle.kind)
    _refuse_formulas(scenario, effects)
    commands, asked = ask_wheels(scenario, effects, _STEP_S)
    position, quaternion, wheels = _step_world(scenario, machine, asked)
    tilt = scenario.ground.tilt
    count = position.shape[0]
    position = rotate(tilt, position)
    quaternion = multiply_quaternions(np.broadcast_to(tilt, (count, 4)), quaternion)
    time = np.arange(count, dtype=np.float64) * _STEP_S
    path = Path(time, position, quaternion, _differentiate(position, quaternion))
    drive = Drive(_STEP_S, wheels[:, 0], wheels[:, 1], np.zeros(count - 1))
    v0, w0 = apply_ideal_model(vehicle, drive.left, drive.right, drive.steering)
    turning = (np.abs(wheels).max(axis=1) > 0.0).astype(np.float64)
    return record_truth(
        scenario, Truth(commands, drive, BodyMotion(v0, w0, path.velocity, turning), path, effects)
    )


def _refuse_formulas(scenario: Scenario, effects: Effects) -> None:
    if scenario.vehicle.kind != "differential":
        what = "only skid-steer vehicles are built of rigid bodies"
        hint = "Choose a differential vehicle"
        raise SimulateError("wrong_vehicle", what, where=scenario.vehicle.name, hint=hint)
    wrong = [name for name in effects.asked if name not in _ALLOWED]
    if scenario.extra is not None:
        wrong.append("extra")
    if scenario.ground.hill_m > 0.0:
        wrong.append("hills")
    if wrong:
        what = f"{', '.join(wrong)} cannot be switched on where contact decides"
        hint = "Change the machine (friction, payload, radius) or the slope instead"
        raise SimulateError("not_physical", what, where="effects", hint=hint)


def _step_world(scenario: Scenario, machine: SkidSteer, asked: Drive) -> tuple[Floats, Floats, Floats]:
    """Positions (n + 1, 3) and quaternions (n + 1, 4) in the plane's frame, wheel speeds (n, 2)."""
    model = mujoco.MjModel.from_xml_string(_write_world(scenario, machine))
    data = mujoco.MjData(model)
    x, y, yaw = scenario.start_pose
    data.qpos[:7] = x, y, data.qpos[2], math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)
    for _ in range(_SETTLE_STEPS):
        mujoco.mj_step(model, data)
    # The suspension settles by sliding a little downhill; the run begins where it was told to.
    data.qpos[0], data.qpos[1] = x, y
    count = asked.left.size
    pose = np.empty((count + 1, 7))
    speed = np.empty((count, 4))
    pose[0] = data.qpos[:7]
    targets = np.stack((asked.left, asked.right, asked.left, asked.right), axis=1)
    for index in range(count):
        data.ctrl[:] = targets[index]
        mujoco.mj_step(model, data)
        pose[index + 1] = data.qpos[:7]
        speed[index] = data.qvel[6:10]
    sides = np.stack((speed[:, [0, 2]].mean(axis=1), speed[:, [1, 3]].mean(axis=1)), axis=1)
    return pose[:, :3], pose[:, [4, 5, 6, 3]], sides


def _write_world(scenario: Scenario, machine: SkidSteer) -> str:
    vehicle = scenario.vehicle
    down = rotate(invert_quaternions(scenario.ground.tilt), np.array([0.0, 0.0, -GRAVITY_MPS2])).tolist()
    radius = vehicle.wheel_radius_m
    wheels = "".join(_write_wheel(name, vehicle, machine) for name in _WHEELS)
    pairs = "".join(
        f'<pair geom1="ground" geom2="{name}" condim="3" friction="{machine.friction} {machine.friction} '
        f'0.005 0.0001 0.0001" solreffriction="{machine.slip_time_s} 1"/>'
        for name in _WHEELS
    )
    servos = "".join(
        f'<velocity joint="{name}" kv="{machine.servo_nms}" '
        f'forcerange="-{machine.torque_nm} {machine.torque_nm}"/>'
        for name in _WHEELS
    )
    payload = ""
    if machine.payload_kg > 0.0:
        payload = (
            f'<geom type="box" size="0.1 0.1 0.1" pos="{machine.payload_x_m} {machine.payload_y_m} {radius}" '
            f'mass="{machine.payload_kg}" contype="0" conaffinity="0"/>'
        )
    return f"""<mujoco><compiler angle="radian"/>
    <option timestep="{_STEP_S}" cone="elliptic" impratio="10" integrator="implicitfast"
      gravity="{down[0]} {down[1]} {down[2]}"/>
    <worldbody><geom name="ground" type="plane" size="0 0 1" contype="0" conaffinity="0"/>
    <body name="chassis" pos="0 0 {radius}"><freejoint/>
    <geom type="box" size="{0.5 * vehicle.wheelbase_m} {0.3 * vehicle.track_width_m} {0.4 * radius}"
      mass="{machine.mass_kg}" contype="0" conaffinity="0"/>{payload}{wheels}</body></worldbody>
    <contact>{pairs}</contact><actuator>{servos}</actuator></mujoco>"""


def _write_wheel(name: str, vehicle: Vehicle, machine: SkidSteer) -> str:
    x = (0.5 if name.startswith("front") else -0.5) * vehicle.wheelbase_m
    is_left = name.endswith("left")
    y = (0.5 if is_left else -0.5) * vehicle.track_width_m
    radius = vehicle.wheel_radius_m * (machine.left_radius_scale if is_left else 1.0)
    return (
        f'<body pos="{x} {y} 0"><joint name="{name}" type="hinge" axis="0 1 0" '
        f'armature="{machine.armature_kgm2}"/><geom name="{name}" type="ellipsoid" '
        f'size="{radius} {0.35 * radius} {radius}" mass="{machine.wheel_mass_kg}" '
        'contype="0" conaffinity="0"/></body>'
    )


def _differentiate(position: Floats, quaternion: Floats) -> Floats:
    """Body velocity (v_x, v_y, v_w) between neighbouring poses, in the middle attitude, shape (n, 3)."""
    turned = rotation_vectors(multiply_quaternions(invert_quaternions(quaternion[:-1]), quaternion[1:]))
    middle = (
        quaternion[:-1]
        + np.where(np.sum(quaternion[:-1] * quaternion[1:], axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        * quaternion[1:]
    )
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    velocity: Floats = rotate(invert_quaternions(middle), np.diff(position, axis=0)) / _STEP_S
    velocity[:, 2] = turned[:, 2] / _STEP_S
    return velocity
