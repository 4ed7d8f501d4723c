"""Simulation of a vehicle's twin in MuJoCo with the commands of its servos."""

from __future__ import annotations

import importlib
import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline.core.arrays import Flags, Floats
from pipeline.export.targets.twin_files import STEP_S, write_world
from pipeline.export.twin_body import TwinBody
from pipeline.models.effect import AddedEffect, Effect, Place
from pipeline.run.recording import MotionError
from pipeline.run.signals import Resets, Rolling, RunContext, Velocity, Wheels

if TYPE_CHECKING:
    from types import ModuleType

_SETTLE_STEPS = 200
"""Steps until the wheels have settled on the ground under the weight: 0.4 s."""
_SEEN_S = 1.0
"""Additional lead time before a prediction to initialize the velocity of a sliding body from poses [s]."""
_FORGETS = 5.0
"""Time constants after which the initial state of a stretch has no influence."""


def load_mujoco() -> ModuleType:
    """Import the package that simulates the twin.

    Raises:
        MotionError: ``mujoco_needed``: it is not installed.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        what = "a twin is driven in MuJoCo, which is not installed"
        hint = (
            "Install the extra: pip install 'slip-pipeline[sim]'. The files of --to mjcf and sdf need none."
        )
        raise MotionError("mujoco_needed", what, where="slip simulate --twin", hint=hint) from None


class TwinGround(AddedEffect):
    """Twin: motion of the body from its wheels through contact, computed by MuJoCo.

    It replaces everything between the servos and base_link, at the end of the model's path to the centre.

    Args:
        body: the twin's body.
        wanted: cells whose velocity is needed, shape (n,); the others stay at rest.
    """

    id = "twin_ground"
    place = Place.CENTRE
    parameters = ()

    def __init__(self, body: TwinBody, wanted: Flags | None = None) -> None:
        super().__init__()
        self._body = body
        self._wanted = wanted

    def add_to(
        self,
        total: Velocity,  # noqa: ARG002 - an effect is asked so
        rolling: Rolling,
        velocity: Velocity,  # noqa: ARG002
        context: RunContext,
    ) -> Velocity:
        """The velocity from MuJoCo, which replaces the previous one."""
        moved = _Drive(self._body, context).follow(rolling.wheels, self._wanted)
        arm = context.vehicle.kinematics.lever_m(context.vehicle)
        # The model converts from the rear axle to base_link, and these values are already of base_link.
        return Velocity(
            moved[:, 0],
            moved[:, 1] - arm * moved[:, 2],
            moved[:, 2],
        )


def make_twin_effects(body: TwinBody, wanted: Flags | None = None) -> tuple[Effect, ...]:
    """The effects of a twin: its controller, MuJoCo, and the localization of the log."""
    return (*body.controller, TwinGround(body, wanted), *body.reported)


class _Drive:
    """A simulated world in which one body follows a run."""

    def __init__(self, body: TwinBody, context: RunContext) -> None:
        self.engine = load_mujoco()
        # Errors are reported by exceptions, without the file MUJOCO_LOG.TXT.
        self.engine.set_mju_user_warning(lambda _: None)
        self.body, self.context = body, context
        try:
            self.model = self.engine.MjModel.from_xml_string(write_world(body))
        except ValueError as error:
            what = f"MuJoCo {self.engine.__version__} does not read the twin: {' '.join(str(error).split())}"
            hint = "Install a newer one: pip install -U 'slip-pipeline[sim]'."
            raise MotionError("mujoco_old", what, where=body.vehicle.id, hint=hint) from None
        self.settled = self.engine.MjData(self.model)
        self.engine.mj_step(self.model, self.settled, nstep=_SETTLE_STEPS)
        self.data = self.engine.MjData(self.model)
        self.speeds = {name: self.model.joint(name).dofadr[0] for name in self._list_joints()}
        self.actuators = [self.model.actuator(number) for number in range(self.model.nu)]
        self.steps = max(round(context.step_s / STEP_S), 1)

    def _list_joints(self) -> list[str]:
        drive = ["drive"] if self.body.steering is not None else []
        return [*drive, *(wheel.name for wheel in self.body.wheels)]

    def follow(self, wheels: Wheels, wanted: Flags | None) -> Floats:
        """Velocity of base_link on cells (v_x, v_y, v_w), shape (n, 3)."""
        controls = self._list_controls(wheels)
        velocity = np.zeros((wheels.left.size, 3))
        known = _map_resets(self.context.wheels)
        moving = _map_resets(self.context.body) if self.body.slides else {}
        ends = np.append(self.context.spans.first[1:], wheels.left.size)
        for first, end in zip(self.context.spans.first.tolist(), ends.tolist(), strict=True):
            for begin, stop in self._cut(first, end, wanted):
                self._rest()
                self._turn(wheels.left[begin], wheels.right[begin])
                self._move(*self._roll(wheels.left[begin], wheels.right[begin]))
                before = self._read_pose()
                for cell in range(begin, stop):
                    row = known.get(cell)
                    if row is not None:
                        self._turn(row[0], row[1])
                        if not self.body.slides:
                            self._move(*self._roll(row[0], row[1]))
                    if cell in moving:
                        self._move(*moving[cell])
                    self.data.ctrl[:] = controls[cell]
                    self.engine.mj_step(self.model, self.data, nstep=self.steps)
                    after = self._read_pose()
                    velocity[cell] = _differentiate(before, after, self.context.step_s)
                    before = after
                self._check(velocity[begin:stop])
        return velocity

    def _cut(self, first: int, end: int, wanted: Flags | None) -> list[tuple[int, int]]:
        """Stretches of a span to simulate: the wanted cells, and the lead time that their state needs."""
        if wanted is None:
            return [(first, end)]
        lags = [
            servo.lag_s for servo in (*self.body.servos.values(), self.body.steering) if servo is not None
        ]
        before = self.body.delay_s + _FORGETS * (max(lags) + self.body.creep_s)
        before += _SEEN_S if self.body.slides else 0.0
        margin = math.ceil(before / self.context.step_s)
        near = np.flatnonzero(wanted[first:end]) + first
        stretches: list[tuple[int, int]] = []
        for cell in near.tolist():
            if stretches and cell - margin <= stretches[-1][1]:
                stretches[-1] = (stretches[-1][0], cell + 1)
            else:
                stretches.append((max(cell - margin, first), cell + 1))
        return stretches

    def _list_controls(self, wheels: Wheels) -> Floats:
        """Command of each servo on cells, shape (n, m)."""
        if self.body.steering is not None:
            return np.column_stack((0.5 * (wheels.left + wheels.right), wheels.steering))
        return np.column_stack([getattr(wheels, wheel.side) for wheel in self.body.wheels])

    def _rest(self) -> None:
        self.engine.mj_copyData(self.data, self.model, self.settled)

    def _turn(self, left: float, right: float) -> None:
        """Set the speed of the wheels [rad/s]."""
        speeds = {"left": left, "right": right, "drive": 0.5 * (left + right)}
        for wheel in self.body.wheels:
            shown = wheel.side if self.body.steering is None else "drive"
            self.data.qvel[self.speeds[wheel.name]] = speeds[shown]
        if self.body.steering is not None:
            self.data.qvel[self.speeds["drive"]] = speeds["drive"]
        servo = self.body.servos["left"]
        for number, actuator in enumerate(self.actuators):
            if actuator.actnum[0] and actuator.name != "steering":
                side = "drive" if self.body.steering is not None else self.body.wheels[number].side
                servo = self.body.servos.get(self.body.wheels[number].side, servo)
                self.data.act[actuator.actadr[0]] = speeds[side] / servo.gain

    def _move(self, v_x: float, v_y: float, turn: float) -> None:
        """Set the velocity of base_link [m/s, m/s, rad/s]."""
        yaw = self._read_pose()[2]
        self.data.qvel[0] = v_x * math.cos(yaw) - v_y * math.sin(yaw)
        self.data.qvel[1] = v_x * math.sin(yaw) + v_y * math.cos(yaw)
        self.data.qvel[5] = turn

    def _roll(self, left: float, right: float) -> tuple[float, float, float]:
        """Steady velocity of base_link for these wheel speeds; a car keeps its yaw rate."""
        rims = {
            wheel.side: wheel.radius_m * (left if wheel.side == "left" else right)
            for wheel in self.body.wheels
            if wheel.is_driven
        }
        forward = 0.5 * (rims["left"] + rims["right"])
        if self.body.steering is not None:
            return (
                forward,
                float(self.context.vehicle.base_to_rear_axle_m * self.data.qvel[5]),
                self.data.qvel[5],
            )
        scrub = sum(w.aside_nspm * (w.x_m - self.body.centre_m[0]) ** 2 for w in self.body.wheels)
        drive = sum(w.along_nspm for w in self.body.wheels) * (0.5 * self.body.track_m) ** 2
        turn = (rims["right"] - rims["left"]) / self.body.track_m / (1.0 + scrub / drive)
        x, y = self.body.centre_m
        return forward + y * turn, -x * turn, turn

    def _read_pose(self) -> tuple[float, float, float]:
        x, y, _, a, b, c, d = self.data.qpos[:7].tolist()
        return x, y, math.atan2(2.0 * (a * d + b * c), 1.0 - 2.0 * (c * c + d * d))

    def _check(self, velocity: Floats) -> None:
        bad = self.engine.mjtWarning.mjWARN_BADQACC
        if self.data.warning[bad].number or not np.isfinite(velocity).all():
            what = "MuJoCo could not compute the twin's motion: its wheels left the ground"
            hint = "Look at the model's numbers (slip model show), or drop the effect that is out of range."
            raise MotionError("twin_unstable", what, where=self.body.vehicle.id, hint=hint)


def _map_resets(resets: Resets) -> dict[int, tuple[float, float, float]]:
    """Known states, by the cell before which they are set."""
    good = np.isfinite(resets.start).all(axis=1)
    rows = zip(resets.at[good].tolist(), resets.start[good].tolist(), strict=True)
    return {cell: (one, two, three) for cell, (one, two, three) in rows}


def _differentiate(
    before: tuple[float, float, float], after: tuple[float, float, float], step_s: float
) -> tuple[float, float, float]:
    turned = math.remainder(after[2] - before[2], 2.0 * math.pi)
    middle = before[2] + 0.5 * turned
    x, y = after[0] - before[0], after[1] - before[1]
    ahead = x * math.cos(middle) + y * math.sin(middle)
    aside = y * math.cos(middle) - x * math.sin(middle)
    return ahead / step_s, aside / step_s, turned / step_s
