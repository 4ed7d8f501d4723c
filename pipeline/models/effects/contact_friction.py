"""Contact friction: sliding wheels push the body with a bounded force.

    four contacts at (x, y) = (+-L/2, +-b/2), L = b sqrt(k - 1), the wheels of a side roll at u:
    s_x = u - (v_x - y w),  s_y = -(v_y + x w),  f = g s / 4 / sqrt((creep u)^2 + (abs(s) / friction)^2),
    dv_x/dt = sum(f_x) + v_y w,  dv_y/dt = sum(f_y) - v_x w,
    dw/dt = sum(x f_y - y f_x) / (gyration b/2)^2

friction [1] is the friction coefficient of the ground: no acceleration exceeds friction g. creep [1] is the
slip ratio of a rolling wheel over the share of its load that it transmits, while it slips little: the
body follows its wheels with the time constant creep u / g. At rest wheels slip as at 0.1 m/s. Wheels that
slip little turn the body at 1 / k of the ideal rate, as an effective track k b. gyration [1] is the radius of
gyration over half the track width b. On a Warthog friction 0.1 on ice and 0.8 to 1.7 on gravel, sand, grass
and asphalt, creep 0.02 to 0.2 on asphalt and grass and 0.3 on gravel and sand, k 1.65 to 1.9, gyration 0.8 to
1.6. Effects of the ground act on this motion. Change speed while turning, and turn quickly and slowly.

Source: Coulomb friction of skid-steered wheels, Caracciolo, De Luca and Iannitti, Trajectory tracking control
of a four-wheel differentially driven mobile robot, 1999, with a bound that is approached smoothly; forces of
rolling tyres in proportion to slip ratio and slip angle, Pacejka, Tire and Vehicle Dynamics, chapter 3;
measured on the DRIVE recordings.
"""

import math
from collections.abc import Sequence
from typing import Self, cast

import numpy as np

from pipeline.core import GRAVITY_MPS2, LANES, Floats, Ints, compiled, deal_lanes
from pipeline.models.effect import INF, Effect, Excitation, Parameter, Plausible, Search
from pipeline.models.effects.body_inertia import LEAST_LAG_S
from pipeline.models.effects.effective_track import EffectiveTrack
from pipeline.models.model import JointBody
from pipeline.models.parameter import Conditions, Level, Quantity
from pipeline.run import Rolling, RunContext, Velocity

_LEAST_CREEP = 1e-3
"""Smallest creep [1]: without any, the friction of wheels that do not slip has no direction."""
_REST_MPS = 0.1
"""Speed [m/s] as at which wheels at rest slip: from 0.03 to 0.3 the loss of nine Warthog runs does not
change."""
_STEP_S = 0.02
"""Longest integration step [s]: velocities are within 4 mm/s rms of those by steps of 1 ms."""


class ContactFriction(JointBody):
    """Contact friction: sliding wheels push the body with a bounded force."""

    id = "contact_friction"
    rank = -10
    kinds = ("differential",)
    parameters = (
        Parameter(
            "friction",
            "1",
            (0.01, 20.0),
            INF,
            "friction coefficient, of the ground",
            0.6,
            search=Search.STARTS,
            step=1e-2,
            plausible=Plausible(0.02, 3.0, "wider than ice and dry asphalt"),
            level=Level.TERRAIN,
        ),
        Parameter(
            "creep",
            "1",
            (0.0, 20.0),
            0.0,
            "slip per load share, of a rolling wheel with little slip: its slip ratio over that share",
            0.2,
            search=Search.STARTS,
            step=5e-3,
            plausible=Plausible(0.0, 5.0, "wider than the 0.02 to 0.5 of a Warthog"),
            level=Level.TERRAIN,
        ),
        Parameter(
            "k",
            "1",
            (1.0, 20.0),
            1.0,
            "track factor, effective over nominal track while wheels slide little",
            1.75,
            search=Search.STARTS,
            step=1e-2,
            quantities=(Quantity.TRACK,),
            level=Level.VEHICLE,
        ),
        Parameter(
            "gyration",
            "1",
            (0.0, 10.0),
            0.0,
            "radius of gyration, over half the track width",
            1.0,
            search=Search.STARTS,
            step=1e-2,
            plausible=Plausible(0.2, 4.0, "wider than robots are"),
            level=Level.VEHICLE,
        ),
    )
    starts = (
        {"friction": 0.9, "creep": 0.25, "k": 1.75, "gyration": 1.1},
        {"friction": 0.11, "creep": 0.3, "k": 1.65, "gyration": 0.9},
        {"friction": 0.3, "creep": 0.5, "k": 2.5, "gyration": 1.8},
    )
    needs = (Excitation.CHANGES, Excitation.TURNING)
    is_kinematic = True

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is a wider track: even wheels that skid in the fastest turn make the body no later."""
        creep, friction, k = (self.values[name] for name in ("creep", "friction", "k"))
        sliding = math.sqrt(k - 1.0) / k / friction
        return conditions.largest.speed * math.hypot(creep, sliding) / GRAVITY_MPS2 < LEAST_LAG_S

    def collapse(self) -> Effect | None:
        """An effective track of the same ratio."""
        return cast("Effect", EffectiveTrack().change_within(k=self.values["k"]))

    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """See the formula above."""
        if self.is_neutral:
            return rolling.velocity
        return self.move_each([(self, rolling)], context)[0]

    @classmethod
    def move_each(cls, pairs: Sequence[tuple[Self, Rolling]], context: RunContext) -> list[Velocity]:
        """See `JointBody`."""
        resets = context.body
        inputs = list({id(rolling): rolling for _, rolling in pairs}.values())
        index_of = {id(rolling): index for index, rolling in enumerate(inputs)}
        rolled = np.array([(rolling.v0, rolling.w0) for rolling in inputs])
        # Where velocities are set: those of the wheels, or those that are measured.
        known = np.isfinite(resets.start).all(axis=1)
        at = np.unique(np.concatenate((resets.first, resets.at[known])))
        states = np.zeros((len(inputs), 3, at.size))
        states[:, ::2] = rolled[:, :, at]
        states[:, :, np.searchsorted(at, resets.at[known])] = resets.start[known].T
        moved = np.empty((len(pairs), 3, rolled.shape[2]))
        steps = max(1, math.ceil(context.step_s / _STEP_S - 1e-6))
        numbers = np.transpose([effect.list_numbers(context) for effect, _ in pairs])
        source = np.array([index_of[id(rolling)] for _, rolling in pairs], dtype=np.int64)
        for first, lanes, count in deal_lanes(len(pairs)):
            rows = np.zeros((_MEAN_W // LANES + 1, LANES))
            rows[: _X // LANES, : lanes.size] = numbers[:, lanes]
            given = np.ascontiguousarray(states[source[lanes]].transpose(2, 1, 0))
            _slide(
                rolled, source[lanes], at, given, context.step_s, steps, rows.ravel(), count, moved[first:]
            )
        return [Velocity(*one) for one in moved]

    def list_numbers(self, context: RunContext) -> tuple[float, ...]:
        """The numbers of `_slide`."""
        half = 0.5 * context.track_m
        return (
            (max(self.values["creep"], _LEAST_CREEP) / GRAVITY_MPS2) ** 2,
            (self.values["friction"] * GRAVITY_MPS2) ** -2,
            half * math.sqrt(self.values["k"] - 1.0),
            half,
            (half * self.values["gyration"]) ** 2,
        )


# Rows of what belongs to each body: numbers in the order of `list_numbers`, state, and what it has in a cell.
(
    _CREEP, _BOUND, _AHEAD, _ASIDE, _INERTIA, _X, _Y, _W,
    _LEFT, _RIGHT, _ROLLING_LEFT, _ROLLING_RIGHT, _STEP_X, _STEP_Y, _STEP_W, _MEAN_X, _MEAN_Y, _MEAN_W,
) = (LANES * row for row in range(18))  # fmt: skip


@compiled()
def _step(rows: Floats, lanes: int, step: float) -> None:
    """One step of every body, added to its means."""
    half = 0.5 * step
    for k in range(lanes):
        bound, ahead, aside = rows[_BOUND + k], rows[_AHEAD + k], rows[_ASIDE + k]
        rolling_left, rolling_right = rows[_ROLLING_LEFT + k], rows[_ROLLING_RIGHT + k]
        before_x, before_y, w = rows[_X + k], rows[_Y + k], rows[_W + k]
        # The body frame rotates relative to the velocity, half before the forces act and half after.
        turn = half * w
        shrunk = 1.0 / math.sqrt(1.0 + turn * turn)
        x, y = (before_x + before_y * turn) * shrunk, (before_y - before_x * turn) * shrunk
        # Friction is that at the middle of the step, if the state changes as in the last one.
        near_x, near_y, near_w = x + rows[_STEP_X + k], y + rows[_STEP_Y + k], w + rows[_STEP_W + k]
        left_x, right_x = (
            rows[_LEFT + k] - near_x + aside * near_w,
            rows[_RIGHT + k] - near_x - aside * near_w,
        )
        front_y, rear_y = -near_y - ahead * near_w, -near_y + ahead * near_w
        front_left = 0.25 / math.sqrt((left_x * left_x + front_y * front_y) * bound + rolling_left)
        rear_left = 0.25 / math.sqrt((left_x * left_x + rear_y * rear_y) * bound + rolling_left)
        front_right = 0.25 / math.sqrt((right_x * right_x + front_y * front_y) * bound + rolling_right)
        rear_right = 0.25 / math.sqrt((right_x * right_x + rear_y * rear_y) * bound + rolling_right)
        left_x, right_x = rows[_LEFT + k] - x + aside * w, rows[_RIGHT + k] - x - aside * w
        front_y, rear_y = -y - ahead * w, -y + ahead * w
        on_left, on_right = front_left + rear_left, front_right + rear_right
        front, rear = front_left + front_right, rear_left + rear_right
        total = on_left + on_right
        # Coefficients of the forces in the yaw rate, and of the torque in the speeds.
        along, across = aside * (on_left - on_right), ahead * (front - rear)
        turning = (aside * aside + ahead * ahead) * total
        force_x = on_left * left_x + on_right * right_x
        force_y = front * front_y + rear * rear_y
        torque = ahead * (front * front_y - rear * rear_y) - aside * (on_left * left_x - on_right * right_x)
        # Solution of the linear midpoint equations for the change of each speed.
        stiff = 1.0 + half * total
        crossed = half / stiff
        change_w = (
            step
            * (torque + crossed * (along * force_x - across * force_y))
            / (rows[_INERTIA + k] + half * (turning - crossed * (along * along + across * across)))
        )
        change_x = (step * force_x + half * along * change_w) / stiff
        change_y = (step * force_y - half * across * change_w) / stiff
        rows[_STEP_X + k], rows[_STEP_Y + k], rows[_STEP_W + k] = (
            0.5 * change_x,
            0.5 * change_y,
            0.5 * change_w,
        )
        x, y, turn = x + change_x, y + change_y, half * (w + change_w)
        shrunk = 1.0 / math.sqrt(1.0 + turn * turn)
        x, y = (x + y * turn) * shrunk, (y - x * turn) * shrunk
        rows[_MEAN_X + k] += 0.5 * (before_x + x)
        rows[_MEAN_Y + k] += 0.5 * (before_y + y)
        rows[_MEAN_W + k] += w + 0.5 * change_w
        rows[_X + k], rows[_Y + k], rows[_W + k] = x, y, w + change_w


@compiled(
    "void(float64[:, :, ::1], int64[::1], int64[::1], float64[:, :, ::1], float64, int64, float64[::1], "
    "int64, float64[:, :, ::1])"
)
def _slide(
    rolled: Floats,
    source: Ints,
    at: Ints,
    states: Floats,
    step_s: float,
    steps: int,
    rows: Floats,
    count: int,
    moved: Floats,
) -> None:
    """Cell means of the body velocity by the implicit midpoint rule, with a friction that is extrapolated.

    Args:
        rolled: rolling speeds [m/s] and yaw rates [rad/s], shape (k, 2, n).
        source: index of these for each body, shape (lanes,).
        at: cells before which velocities are set, shape (e,); the first one is among them.
        states: these velocities, shape (e, 3, lanes).
        step_s: width of a cell [s].
        steps: number of integration steps per cell.
        rows: all that belongs to each body: its numbers, and zeros.
        count: number of bodies that are wanted.
        moved: the result [m/s, m/s, rad/s], shape (`count` or more, 3, n).
    """
    event, lanes = 0, source.size
    for cell in range(rolled.shape[2]):
        if event < at.size and at[event] == cell:
            for k in range(lanes):
                rows[_X + k], rows[_Y + k] = states[event, 0, k], states[event, 1, k]
                rows[_W + k] = states[event, 2, k]
                rows[_STEP_X + k], rows[_STEP_Y + k], rows[_STEP_W + k] = 0.0, 0.0, 0.0
            event += 1
        for k in range(lanes):
            v0, w0, creep = rolled[source[k], 0, cell], rolled[source[k], 1, cell], rows[_CREEP + k]
            left, right = v0 - rows[_ASIDE + k] * w0, v0 + rows[_ASIDE + k] * w0
            rows[_LEFT + k], rows[_RIGHT + k] = left, right
            rows[_ROLLING_LEFT + k] = creep * (left * left + _REST_MPS * _REST_MPS)
            rows[_ROLLING_RIGHT + k] = creep * (right * right + _REST_MPS * _REST_MPS)
            rows[_MEAN_X + k], rows[_MEAN_Y + k], rows[_MEAN_W + k] = 0.0, 0.0, 0.0
        for _ in range(steps):
            _step(rows, lanes, step_s / steps)
        for k in range(count):
            moved[k, 0, cell], moved[k, 1, cell] = rows[_MEAN_X + k] / steps, rows[_MEAN_Y + k] / steps
            moved[k, 2, cell] = rows[_MEAN_W + k] / steps
