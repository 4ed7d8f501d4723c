"""Contact friction: sliding wheels push the body with a bounded force.

    each side i rolls at u_i and touches the ground at (x, y) = (+-L/2, +-b/2), L = aspect * b:
    s_x = u_i - (v_x - y*w),  s_y = -(v_y + x*w),  f = friction * g / 4 * s / sqrt(abs(s)^2 + slide^2),
    dv_x/dt = sum(f_x) + v_y*w,  dv_y/dt = sum(f_y) - v_x*w,
    dw/dt = sum(x*f_y - y*f_x) / (gyration * b/2)^2

friction [1] is the friction coefficient of the ground, slide [m/s] the sliding speed at which the force comes
to 71 % of its bound, aspect [1] the distance between the front and the rear contacts over the track width b,
gyration [1] the radius of gyration over half the track width. Where wheels slide by much less than slide the
robot turns at 1 / (1 + aspect^2) of the ideal rate and follows its wheels with a time constant of
slide / (friction * g); where they slide by more, its acceleration is bounded by friction * g. On a Warthog
friction 0.11 on ice and 0.6 to 0.7 on gravel, sand and asphalt, slide 0.03 on ice and 1.0 to 1.3 m/s, aspect
0.7 to 0.9, gyration 0.8 to 1.1. Change speed while turning, and turn quickly and slowly.

Source: Coulomb friction of skid-steered wheels, Caracciolo, De Luca and Iannitti, Trajectory tracking control
of a four-wheel differentially driven mobile robot, 1999, with a bound that is approached smoothly; measured
on the DRIVE recordings.
"""

import math

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.machine_code import compiled
from pipeline.models.effect import INF, BodyEffect, Excitation, Parameter, Plausible, Search
from pipeline.models.parameter import Level
from pipeline.run.signals import Rolling, RunContext, Velocity

_GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
_LEAST_SLIDE = 1e-3
"""Sliding speed [m/s] in the place of zero, at which the force has no direction."""
_STEP_S = 0.02
"""Longest step of the integration [s]: with half of it velocities change by less than 2 mm/s."""


class ContactFriction(BodyEffect):
    """Contact friction: sliding wheels push the body with a bounded force."""

    id = "contact_friction"
    rank = -10
    kinds = ("differential",)
    parameters = (
        Parameter(
            "friction",
            "1",
            (0.01, 5.0),
            INF,
            "friction coefficient of the ground",
            0.6,
            search=Search.STARTS,
            step=1e-2,
            plausible=Plausible(0.02, 1.5, "wider than ice and dry asphalt"),
            level=Level.TERRAIN,
        ),
        Parameter(
            "slide",
            "m/s",
            (0.0, 20.0),
            0.0,
            "sliding speed at which the force comes to 71 % of its bound",
            1.0,
            search=Search.STARTS,
            step=1e-2,
            level=Level.TERRAIN,
        ),
        Parameter(
            "aspect",
            "1",
            (0.0, 5.0),
            0.0,
            "distance between front and rear contacts over the track width",
            0.85,
            search=Search.STARTS,
            step=5e-3,
            plausible=Plausible(0.2, 3.0, "wider than robots are long for their width"),
            level=Level.VEHICLE,
        ),
        Parameter(
            "gyration",
            "1",
            (0.0, 10.0),
            0.0,
            "radius of gyration over half the track width",
            1.0,
            search=Search.STARTS,
            step=1e-2,
            plausible=Plausible(0.2, 4.0, "wider than robots are"),
            level=Level.VEHICLE,
        ),
    )
    starts = (
        {"friction": 0.11, "slide": 0.05, "aspect": 0.8, "gyration": 0.9},
        {"friction": 0.3, "slide": 0.15, "aspect": 1.2, "gyration": 1.8},
        {"friction": 0.65, "slide": 1.1, "aspect": 0.85, "gyration": 1.0},
    )
    motion = (
        "Contact friction: coefficient {friction:.2g}, sliding speed {slide:.2g} m/s, aspect {aspect:.2g}, "
        "gyration {gyration:.2g}"
    )
    clause = "slides on a friction coefficient of {friction:.2g}"
    needs = (Excitation.CHANGES, Excitation.TURNING)
    confused_with = ("body_inertia", "effective_track", "lateral_skid", "turning_resistance")
    contains = ("effective_track", "body_inertia")
    python_state = ("body_x", "body_y", "body_w")
    python = """
        push_x = push_y = push_w = stiffness = 0.0
        for aside, rolled in ((B / 2.0, v0 - w0 * B / 2.0), (-B / 2.0, v0 + w0 * B / 2.0)):
            for ahead in (-{aspect} * B / 2.0, {aspect} * B / 2.0):
                slip_x, slip_y = rolled - body_x + aside * body_w, -body_y - ahead * body_w
                share = 9.80665 / 4.0 * {friction} / math.sqrt(slip_x**2 + slip_y**2 + {slide} ** 2)
                push_x, push_y = push_x + share * slip_x, push_y + share * slip_y
                push_w += (ahead * slip_y - aside * slip_x) * share / ({gyration} * B / 2.0) ** 2
                stiffness += share
        damped = 1.0 + stiffness * step_s / 2.0
        ahead = body_x + push_x * step_s / damped
        aside = body_y + push_y * step_s / damped
        body_w += push_w * step_s / (1.0 + stiffness * step_s / 2.0 * (1.0 + {aspect} ** 2) / {gyration} ** 2)
        turn = body_w * step_s
        body_x = ahead * math.cos(turn) + aside * math.sin(turn)
        body_y = aside * math.cos(turn) - ahead * math.sin(turn)
        v_x, v_y, v_w = body_x, body_y, body_w"""

    def move_body(self, rolling: Rolling, context: RunContext) -> Velocity:
        """See the formula above."""
        if not math.isfinite(self.values["friction"]):
            return rolling.velocity
        half, resets = 0.5 * context.track_m, context.body
        states = np.full((rolling.v0.size, 3), np.nan)
        states[resets.first] = np.column_stack((rolling.v0, np.zeros_like(rolling.v0), rolling.w0))[
            resets.first
        ]
        known = np.isfinite(resets.start).all(axis=1)
        states[resets.at[known]] = resets.start[known]
        numbers = np.array(
            (
                0.25 * _GRAVITY * self.values["friction"],
                max(self.values["slide"], _LEAST_SLIDE) ** 2,
                half * self.values["aspect"],
                half,
                (half * self.values["gyration"]) ** 2,
            )
        )
        moved = np.empty((3, rolling.v0.size))
        steps = max(1, math.ceil(context.step_s / _STEP_S - 1e-6))
        _slide(rolling.v0, rolling.w0, states, numbers, context.step_s, steps, moved)
        return Velocity(*moved)


@compiled("float64[:], float64[:], float64[:, :], float64[:], float64, int64, float64[:, :]")
def _slide(
    v0: Floats, w0: Floats, states: Floats, numbers: Floats, step_s: float, steps: int, moved: Floats
) -> None:
    """Cell means of the body's velocity, by the implicit midpoint rule at the forces of each step's start.

    Args:
        v0: rolling speed [m/s], shape (n,).
        w0: rolling yaw rate [rad/s], shape (n,).
        states: velocities that are set before a cell, NaN elsewhere; the first one is set, shape (n, 3).
        numbers: bound of the force of one contact [m/s^2], square of the sliding speed [m^2/s^2], half the
            distance of the contacts along and across [m], and the radius of gyration squared [m^2].
        step_s: width of a cell [s].
        steps: steps of a cell.
        moved: the result [m/s, m/s, rad/s], shape (3, n).
    """
    bound, least, ahead, aside, inertia = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    step = step_s / steps
    half = 0.5 * step
    x, y, w = states[0, 0], states[0, 1], states[0, 2]
    for cell in range(v0.size):
        if not math.isnan(states[cell, 0]):
            x, y, w = states[cell, 0], states[cell, 1], states[cell, 2]
        left, right = v0[cell] - aside * w0[cell], v0[cell] + aside * w0[cell]
        mean_x, mean_y, mean_w = 0.0, 0.0, 0.0
        for _ in range(steps):
            # The body turns under its velocity, half before the wheels push and half after.
            before_x, before_y, turn = x, y, half * w
            shrunk = 1.0 / math.sqrt(1.0 + turn * turn)
            x, y = (x + y * turn) * shrunk, (y - x * turn) * shrunk
            left_x, right_x = left - x + aside * w, right - x - aside * w
            front_y, rear_y = -y - ahead * w, -y + ahead * w
            front_left = bound / math.sqrt(left_x * left_x + front_y * front_y + least)
            rear_left = bound / math.sqrt(left_x * left_x + rear_y * rear_y + least)
            front_right = bound / math.sqrt(right_x * right_x + front_y * front_y + least)
            rear_right = bound / math.sqrt(right_x * right_x + rear_y * rear_y + least)
            on_left, on_right = front_left + rear_left, front_right + rear_right
            front, rear = front_left + front_right, rear_left + rear_right
            total = on_left + on_right
            # How the forces change with the yaw rate, and the torque with the speeds.
            along, across = aside * (on_left - on_right), ahead * (front - rear)
            turning = (aside * aside + ahead * ahead) * total
            force_x = on_left * left_x + on_right * right_x
            force_y = front * front_y + rear * rear_y
            torque = ahead * (front * front_y - rear * rear_y) - aside * (
                on_left * left_x - on_right * right_x
            )
            # The linear equations of the midpoint, solved for the change of each speed.
            stiff = 1.0 + half * total
            crossed = half / stiff
            change_w = (
                step
                * (torque + crossed * (along * force_x - across * force_y))
                / (inertia + half * (turning - crossed * (along * along + across * across)))
            )
            change_x = (step * force_x + half * along * change_w) / stiff
            change_y = (step * force_y - half * across * change_w) / stiff
            x, y, turn = x + change_x, y + change_y, half * (w + change_w)
            shrunk = 1.0 / math.sqrt(1.0 + turn * turn)
            x, y = (x + y * turn) * shrunk, (y - x * turn) * shrunk
            mean_x, mean_y = mean_x + 0.5 * (before_x + x), mean_y + 0.5 * (before_y + y)
            mean_w += w + 0.5 * change_w
            w += change_w
        moved[0, cell], moved[1, cell], moved[2, cell] = mean_x / steps, mean_y / steps, mean_w / steps
