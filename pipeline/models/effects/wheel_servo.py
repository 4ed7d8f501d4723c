"""Wheel servo: the speed controller of each side works against ground friction.

    each side at u = r Omega [m/s], commanded u_c, e = u_c - u; the body at v and w, a = b/2
    0.7 tau du/dt = 1.7 (p - drag sign(u)) - 2 F,  p = clip(e + z, +-bound - bound u / no_load),
    dz/dt = reset e while p is not clipped,  z = 0 while no side is commanded,
    s_x = u - (v -+ a w),  s_y = 0.87 a w,  (F, S) = (s_x, s_y) / 2 / sqrt((creep u)^2 + (abs(s) / scrub)^2),
    tau dv/dt = F_l + F_r,  a tau dw/dt = F_r - F_l - 0.87 (S_l + S_r)

tau [s] is the time constant of the speed straight ahead, and reset [1/s] the integral over the proportional
gain. Over the proportional gain, bound [m/s] is the largest force of the drive at rest, drag [m/s] the
rolling resistance of a side, and scrub [m/s] the friction of the ground: scrub / tau is the largest
acceleration that the ground gives, the friction coefficient times that of gravity. As the torque of a DC
motor, the largest force falls linearly with speed, to zero at no_load [m/s], so that wheels turn less fast
against the friction of a turn than straight ahead. creep [s/m] is the slip of a rolling wheel over the force
that it gives while it is small; at rest wheels slip by 0.01 of it. A slow turn begins only when the integral
part has grown enough to overcome the friction, so that it seems to have a lag of many seconds; driving fast
there is less of it, and on ice hardly any. The inertia of rotating parts is 0.7 of that of the vehicle (the
error of the wheels hardly depends on it between 0.3 and 1.5), the contacts are 0.87 b apart lengthwise, and
the radius of gyration is a. On a Warthog tau 0.1 to 0.2 s, reset 0.2 to 0.4 1/s, bound 1.1 to 1.7 m/s,
no_load 5 m/s, drag 0.03 to 0.1 m/s, scrub 0.1 m/s on ice and 0.8 to 1.9 m/s elsewhere, and creep 0.06 s/m.
Drive and turn slowly and quickly, on the spot and while driving.

Source: speed controllers as in ros2_control; anti-windup of Astrom and Murray, Feedback Systems, chapter 10;
DC motors of Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, chapter 2; skid-steered
contacts of Caracciolo, De Luca and Iannitti, 1999; forces of rolling tyres in proportion to slip ratio and
slip angle, Pacejka, Tire and Vehicle Dynamics, chapter 3; measured on the DRIVE recordings.
"""

import math
from dataclasses import replace

import numpy as np

from pipeline.core.arrays import Floats
from pipeline.core.machine_code import compiled
from pipeline.models.effect import INF, DriveEffect, Excitation, Least, Parameter, Plausible, Search
from pipeline.models.effects.drive_lag import TIME_CONSTANT
from pipeline.models.filters import set_states
from pipeline.models.parameter import Conditions, Level, Quantity
from pipeline.run.signals import RunContext, Wheels

_ROTATING = 0.7
"""Inertia of the rotating parts over that of the vehicle: the loss of nine Warthog runs on five grounds
together changes by 3 % from 0.3 to 3."""
_LENGTHWISE = 0.75
"""Squared distance of the contacts lengthwise over that across: that of a track 1.75 times as wide."""
_LEAST_TAU_S = 0.01
"""Smallest time constant [s]: a quarter of a cell at 25 Hz, within which the wheels follow at once."""
_REST = 0.01
"""Creep of wheels at rest [m/s]: without any, the friction of wheels that do not slip has no direction."""
_LEAST_SCRUB = 0.03
"""Smallest friction to report [m/s]: a smaller one is within the tolerance of a data sheet."""
_LEAST_DRAG = 0.01
"""Smallest resistance to report [m/s]: a smaller one is within the tolerance of a data sheet."""
_SLOW = 0.05
"""Speed [m/s] below which the rolling resistance fades: wheels that stop would chatter otherwise."""
_OBSERVED = 0.5
"""Share of a deviation of the wheels' difference at the start of a prediction that the integral part takes:
with 0.4 to 0.8 the errors of nine Warthog runs over 2 s are smallest."""
_TINY = 1e-6
"""Friction [m/s] that counts as none: a divisor."""
_NO_COMMAND = 1e-6
"""Command [m/s] that counts as none: above the rounding of sums."""


class WheelServo(DriveEffect):
    """Wheel servo: the speed controller of each side works against ground friction."""

    id = "wheel_servo"
    rank = 31
    kinds = ("differential",)
    parameters = (
        replace(
            TIME_CONSTANT,
            about="time constant of the speed straight ahead",
            typical=0.2,
            starts=(),
            search=Search.STARTS,
            plausible=Plausible(0.0, 3.0, "wider than the 0.15 to 0.2 s of a Warthog"),
            quantities=(Quantity.SPEED_LAG,),
            level=Level.VEHICLE,
        ),
        Parameter(
            "reset",
            "1/s",
            (0.0, 20.0),
            0.0,
            "integral over proportional gain",
            0.4,
            search=Search.STARTS,
            step=5e-3,
            level=Level.VEHICLE,
        ),
        Parameter(
            "drag",
            "m/s",
            (0.0, 5.0),
            0.0,
            "rolling resistance of a side over the proportional gain",
            0.08,
            search=Search.STARTS,
            step=1e-3,
            level=Level.TERRAIN,
        ),
        Parameter(
            "bound",
            "m/s",
            (0.01, 20.0),
            INF,
            "largest force of the drive at rest over the proportional gain",
            1.3,
            search=Search.STARTS,
            step=5e-3,
            level=Level.VEHICLE,
        ),
        Parameter(
            "no_load",
            "m/s",
            (0.1, 100.0),
            INF,
            "speed at which the largest force of the drive has fallen to zero",
            5.0,
            search=Search.STARTS,
            step=2e-2,
            level=Level.VEHICLE,
        ),
        Parameter(
            "scrub",
            "m/s",
            (0.0, 20.0),
            0.0,
            "friction of the ground over the proportional gain",
            1.3,
            search=Search.STARTS,
            step=5e-3,
            least=Least(_LEAST_SCRUB, Least.DATA_SHEET),
            plausible=Plausible(0.0, 5.0, "wider than the 0.2 to 1.8 m/s of a Warthog"),
            level=Level.TERRAIN,
        ),
        Parameter(
            "creep",
            "s/m",
            (0.0, 20.0),
            0.0,
            "slip of a rolling wheel over the force, over the proportional gain, that it gives while small",
            0.07,
            search=Search.STARTS,
            step=2e-3,
            plausible=Plausible(0.0, 10.0, "wider than the 0.05 to 0.9 s/m of a Warthog"),
            level=Level.TERRAIN,
        ),
    )
    starts = (
        {
            "tau": 0.17,
            "reset": 0.37,
            "drag": 0.08,
            "bound": 1.3,
            "no_load": 5.0,
            "scrub": 1.4,
            "creep": 0.065,
        },
        {"tau": 0.17, "reset": 0.37, "drag": 0.08, "bound": 1.3, "no_load": 5.0, "scrub": 0.2, "creep": 0.3},
        {"tau": 0.4, "reset": 0.1, "drag": 0.05, "bound": 0.6, "no_load": 5.0, "scrub": 0.5, "creep": 0.065},
    )
    motion = "Wheel servo: ground friction slows the wheels below their commanded speed"
    clause = "has its wheels slowed by ground friction (time constant {tau:.2g} s)"
    needs = (Excitation.DRIVING, Excitation.TURNING, Excitation.CHANGES)
    confused_with = ("turn_droop", "acceleration_limit", "wheel_radius")
    contains = ("deadband", "drive_lag", "turn_lag")
    companions = (
        "transport_delay",
        "body_turn_limit",
        "body_acceleration_limit",
        "turn_acceleration_limit",
        "wheel_speed_limit",
    )
    python_state = (
        *("rolled_left", "rolled_right", "load_v", "load_w", "push_left", "push_right"),
        *("more_left", "more_right", "more_v", "more_w"),
    )
    python = """
        rate, aside, tau = 2.0 / step_s, B / 2.0, max({tau}, 0.01)
        gain, asked, rolled = 0.85 / tau, (left * R, right * R), (rolled_left, rolled_right)
        widest, slope = max({scrub}, 1e-6) / tau, {bound} / {no_load} if {bound} < math.inf else 0.0
        is_driven = max(abs(left), abs(right)) * R >= 1e-6
        pushes = (push_left, push_right) if is_driven else (0.0, 0.0)
        near = (rolled_left + more_left, rolled_right + more_right)
        near_v, near_w = load_v + more_v, load_w + more_w
        most = [[gain * max({bound} - way * slope * u, 0.0) for way in (1.0, -1.0)] for u in near]
        grip = [
            0.5 * ({scrub} > 0.0) / math.hypot(
                {creep} * tau * u, 0.01 * tau,
                math.hypot(u - near_v - way * aside * near_w, 0.75**0.5 * aside * near_w) / widest)
            for u, way in zip(near, (-1.0, 1.0))
        ]
        bound = [0.0, 0.0]
        for _ in range(3):
            held = [
                0.35 * rate + gain * ({drag} / math.hypot(u, 0.05) + 1.0 - abs(s)) + f
                for u, f, s in zip(near, grip, bound)
            ]
            free = [
                (0.35 * rate * u + (s * m[s < 0.0] if s else gain * c + z)) / h
                for u, c, z, s, h, m in zip(rolled, asked, pushes, bound, held, most)
            ]
            firm = [f * (1.0 - f / h) for f, h in zip(grip, held)]
            a, b, c = rate + sum(firm), aside * (firm[1] - firm[0]), aside ** 2 * (
                rate + sum(firm) + 0.75 * sum(grip))
            p = rate * load_v + grip[0] * free[0] + grip[1] * free[1]
            q = aside ** 2 * rate * load_w + aside * (grip[1] * free[1] - grip[0] * free[0])
            turn = (q * a - b * p) / (a * c - b * b)
            ahead = (p - b * turn) / a
            reached = [
                u + f / h * (ahead + way * aside * turn)
                for u, f, h, way in zip(free, grip, held, (-1.0, 1.0))
            ]
            pull = [gain * (c - u) + z for c, u, z in zip(asked, reached, pushes)]
            more = [
                s or (math.copysign(1.0, g) if abs(g) > m[g < 0.0] else 0.0)
                for g, s, m in zip(pull, bound, most)
            ]
            if more == bound:
                break
            bound = more
        grown = [{reset} * gain * (c - u) * step_s * is_driven for c, u in zip(asked, reached)]
        room = [max(m[g < 0.0] - abs(g), 0.0) for g, m in zip(pull, most)]
        grown = [max(-d, min(d, n)) if n * g > 0.0 else n for n, d, g in zip(grown, room, pull)]
        push_left, push_right = (z + n for z, n in zip(pushes, grown))
        more_left, more_right = (m - u for m, u in zip(reached, rolled))
        more_v, more_w = ahead - load_v, turn - load_w
        rolled_left, rolled_right = reached[0] + more_left, reached[1] + more_right
        load_v, load_w = ahead + more_v, turn + more_w
        left, right = reached[0] / R, reached[1] / R"""

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is a lag: neither ground nor resistance loads it, and its force is never bounded."""
        drag, scrub, speed = self.values["drag"], self.values["scrub"], conditions.largest.speed
        return (
            scrub < _LEAST_SCRUB
            and drag < _LEAST_DRAG
            and self.values["bound"] - self._slope * speed >= speed
        )

    @property
    def _slope(self) -> float:
        """How fast the largest force falls with speed, over the proportional gain."""
        bound = self.values["bound"]
        return bound / self.values["no_load"] if math.isfinite(bound) else 0.0

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        radius, resets = context.vehicle.wheel_radius_m, context.wheels
        left, right = radius * wheels.left, radius * wheels.right
        start = radius * resets.start
        is_measured = np.zeros_like(left)
        is_measured[resets.at] = np.isfinite(start[:, :2]).all(axis=1)
        is_measured[context.spans.first] = 0.0
        states = np.column_stack(
            (set_states(left, resets, start[:, 0]), set_states(right, resets, start[:, 1]), is_measured)
        )
        idle = wheels.idle
        if idle is None:
            idle = (np.maximum(np.abs(left), np.abs(right)) < _NO_COMMAND).astype(np.float64)
        tau, scrub = max(self.values["tau"], _LEAST_TAU_S), self.values["scrub"]
        gain = 0.5 * (1.0 + _ROTATING) / tau
        numbers = np.array(
            (
                gain,
                self.values["reset"] * gain,
                self.values["drag"] * gain,
                self.values["bound"] * gain,
                (self.values["creep"] * tau) ** 2,
                (_REST * tau) ** 2 if scrub > 0.0 else math.inf,
                (tau / max(scrub, _TINY)) ** 2,
                0.5 * context.track_m,
                self._slope * gain,
            )
        )
        rolled = np.empty((2, left.size))
        _roll(left, right, states, idle, numbers, context.step_s, rolled)
        rolled /= radius
        return replace(wheels, left=rolled[0], right=rolled[1])


@compiled("float64[:], float64[:], float64[:, :], float64[:], float64[:], float64, float64[:, :]")
def _roll(
    left: Floats,
    right: Floats,
    states: Floats,
    idle: Floats,
    numbers: Floats,
    step_s: float,
    rolled: Floats,
) -> None:
    """Cell means of the speeds of both sides by the implicit midpoint rule, with a grip that is extrapolated.

    Args:
        left: commanded speed of the left side [m/s], shape (n,).
        right: that of the right side [m/s], shape (n,).
        states: speeds of both sides set before a cell, NaN elsewhere, and whether they are those at the start
            of a prediction; the first one is set, shape (n, 3).
        idle: share of each cell without a command, shape (n,).
        numbers: proportional gain [1/s], integral gain [1/s^2], drag [m/s^2], largest push at rest [m/s^2],
            squared slip over acceleration of rolling wheels [s^4/m^2] and of those at rest [s^2], inverse
            square of the largest acceleration [s^4/m^2], half the track width [m], and by how much the
            largest push falls with speed [1/s].
        step_s: width of a cell [s].
        rolled: the result [m/s], shape (2, n).
    """
    gain, reset, drag, aside = numbers[0], numbers[1], numbers[2], numbers[7]
    rate, inertia = 2.0 / step_s, _ROTATING / step_s
    on_left, on_right, ahead, turn, push_left, push_right = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    step_left, step_right, step_v, step_w = 0.0, 0.0, 0.0, 0.0
    for cell in range(left.size):
        if not math.isnan(states[cell, 0]):
            new_left, new_right = states[cell, 0] - on_left, states[cell, 1] - on_right
            on_left, on_right = states[cell, 0], states[cell, 1]
            # The body moves along: its slip is not measured.
            ahead += 0.5 * (new_left + new_right)
            turn += 0.5 * (new_right - new_left) / (aside * (1.0 + _LENGTHWISE))
            # The integral part balances the friction at the measured difference of the wheels.
            held = 0.5 * _OBSERVED * gain * (new_right - new_left) * states[cell, 2]
            push_left, push_right = push_left - held, push_right + held
        driven = 1.0 - idle[cell]
        start_left, start_right = (push_left, push_right) if driven == 1.0 else (0.0, 0.0)
        push_left, push_right = driven * push_left, driven * push_right
        asked_left, asked_right = gain * left[cell] + push_left, gain * right[cell] + push_right
        # The state at the middle of the cell, if it changes as in the last one.
        near_left, near_right = on_left + step_left, on_right + step_right
        near_v, near_w = ahead + step_v, turn + step_w
        across = _LENGTHWISE * (aside * near_w) ** 2
        grip_left = _grip(near_left, near_left - near_v + aside * near_w, across, numbers)
        grip_right = _grip(near_right, near_right - near_v - aside * near_w, across, numbers)
        held_left = inertia + drag / math.sqrt(near_left * near_left + _SLOW * _SLOW) + grip_left
        held_right = inertia + drag / math.sqrt(near_right * near_right + _SLOW * _SLOW) + grip_right
        is_free_left, is_free_right = True, True
        for _ in range(3):
            stiff_left = held_left + (gain if is_free_left else 0.0)
            stiff_right = held_right + (gain if is_free_right else 0.0)
            free_left = (inertia * on_left + asked_left) / stiff_left
            free_right = (inertia * on_right + asked_right) / stiff_right
            v, w = _move(
                ahead, turn, free_left, free_right, grip_left, grip_right,
                grip_left / stiff_left, grip_right / stiff_right, rate, aside,
            )  # fmt: skip
            mean_left = free_left + grip_left / stiff_left * (v - aside * w)
            mean_right = free_right + grip_right / stiff_right * (v + aside * w)
            pull_left = gain * (left[cell] - mean_left) + push_left
            pull_right = gain * (right[cell] - mean_right) + push_right
            was_left, was_right = is_free_left, is_free_right
            most_left = _find_most(pull_left, near_left, numbers)
            is_free_left = was_left and abs(pull_left) <= most_left
            most_right = _find_most(pull_right, near_right, numbers)
            is_free_right = was_right and abs(pull_right) <= most_right
            if is_free_left == was_left and is_free_right == was_right:
                break
            asked_left = asked_left if is_free_left else math.copysign(most_left, pull_left)
            asked_right = asked_right if is_free_right else math.copysign(most_right, pull_right)
        rolled[0, cell], rolled[1, cell] = mean_left, mean_right
        grown = reset * step_s * driven
        push_left = start_left + _hold(grown * (left[cell] - mean_left), pull_left, most_left)
        push_right = start_right + _hold(grown * (right[cell] - mean_right), pull_right, most_right)
        step_left, step_right, step_v, step_w = (
            mean_left - on_left,
            mean_right - on_right,
            v - ahead,
            w - turn,
        )
        on_left, on_right = mean_left + step_left, mean_right + step_right
        ahead, turn = v + step_v, w + step_w


@compiled()
def _grip(speed: float, slip: float, across: float, numbers: Floats) -> float:
    """Force of a side over its slip [1/s], from its speed, its slip [m/s] and the squared slip sideways."""
    rolling = numbers[4] * speed * speed + numbers[5]
    return 0.5 / math.sqrt((slip * slip + across) * numbers[6] + rolling)


@compiled()
def _move(
    ahead: float,
    turn: float,
    left: float,
    right: float,
    grip_left: float,
    grip_right: float,
    part_left: float,
    part_right: float,
    rate: float,
    aside: float,
) -> tuple[float, float]:
    """Speed and yaw rate of the body at the middle of a cell, from those at its start.

    Args:
        ahead: speed of the body [m/s].
        turn: its yaw rate [rad/s].
        left: speed that the left side would have beside a body at rest [m/s].
        right: that of the right side [m/s].
        grip_left: force of the left side over its slip [1/s].
        grip_right: that of the right side [1/s].
        part_left: share of the body's speed that the left side takes over.
        part_right: that of the right side.
        rate: two over the width of a cell [1/s].
        aside: half the track width [m].
    """
    firm_left, firm_right = grip_left * (1.0 - part_left), grip_right * (1.0 - part_right)
    straight, mixed = rate + firm_left + firm_right, aside * (firm_right - firm_left)
    turning = aside * aside * (straight + _LENGTHWISE * (grip_left + grip_right))
    push = rate * ahead + grip_left * left + grip_right * right
    twist = aside * (aside * rate * turn + grip_right * right - grip_left * left)
    w = (twist * straight - mixed * push) / (straight * turning - mixed * mixed)
    return (push - mixed * w) / straight, w


@compiled()
def _find_most(pull: float, speed: float, numbers: Floats) -> float:
    """Largest push of a side [m/s^2] in the direction of a pull, at its speed [m/s]."""
    most: float = max(numbers[3] - math.copysign(numbers[8] * speed, pull * speed), 0.0)
    return most


@compiled()
def _hold(grown: float, pull: float, most: float) -> float:
    """What an integral part grows by: not beyond the largest push."""
    if grown * pull <= 0.0:
        return grown
    room = max(most - abs(pull), 0.0)
    return min(max(grown, -room), room)
