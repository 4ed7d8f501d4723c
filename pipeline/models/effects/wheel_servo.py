"""Wheel servo: the speed controller of each side works against ground friction.

    each side at u = r Omega [m/s], commanded u_c, e = u_c - u; the body at v and w, a = b/2
    0.7 tau du/dt = 1.7 (p - drag sign(u)) - 2 F,  p = clip(e + z, +-m - bound u / no_load),
    m = bound (1 -+ e_m / 2),
    dz/dt = reset e while p is not clipped,  z = 0 while no side is commanded,
    s_x = u - (v -+ a w),  s_y = 0.87 a w,  (F, S) = (s_x, s_y) / 2 / sqrt((creep u)^2 + (abs(s) / scrub)^2),
    tau dv/dt = F_l + F_r,  a tau dw/dt = F_r - F_l - 0.87 (S_l + S_r)

tau [s] is the time constant of the speed straight ahead, and reset [1/s] the integral over the proportional
gain. Over the proportional gain, bound [m/s] is the largest force of the drive at rest, drag [m/s] the
rolling resistance of a side, and scrub [m/s] the friction of the ground: scrub / tau is the largest
acceleration that the ground gives, the friction coefficient times that of gravity. As the torque of a DC
motor, the largest force falls linearly with speed, to zero at no_load [m/s], so that wheels turn less fast
against the friction of a turn than straight ahead; e_m is the motor imbalance. creep [s/m] is the slip of a
rolling wheel over the force that it gives while it is small; at rest wheels slip by 0.01 of it. A slow turn
begins only when the integral part has grown enough to overcome the friction, so that it seems to have a lag
of many seconds; driving fast there is less of it, and on ice hardly any. The inertia of rotating parts is
0.7 of that of the vehicle (the error of the wheels hardly depends on it between 0.3 and 1.5), the contacts
are 0.87 b apart lengthwise, and the radius of gyration is a. On a Warthog tau 0.1 to 0.2 s, reset 0.2 to 0.4
1/s, bound 1.1 to 1.7 m/s, no_load 5 m/s, drag 0.03 to 0.1 m/s, scrub 0.1 m/s on ice and 0.8 to 1.9 m/s
elsewhere, and creep 0.06 s/m.
Drive and turn slowly and quickly, on the spot and while driving.

Source: speed controllers as in ros2_control; anti-windup of Astrom and Murray, Feedback Systems, chapter 10;
DC motors of Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, chapter 2; skid-steered
contacts of Caracciolo, De Luca and Iannitti, 1999; forces of rolling tyres in proportion to slip ratio and
slip angle, Pacejka, Tire and Vehicle Dynamics, chapter 3; measured on the DRIVE recordings.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from pipeline.core import Floats
from pipeline.models.effect import INF, Effect, Excitation, Least, Parameter, Place, Plausible, Search
from pipeline.models.families import TIME_CONSTANT
from pipeline.models.model import JointDrive
from pipeline.models.parameter import Asked, Conditions, Largest, Level, Quantity
from pipeline.models.servo_walk import ROTATING, walk_each
from pipeline.models.step import predict_step, time_rise
from pipeline.run import HORIZON_S, RunContext, Wheels
from pipeline.sources import Vehicle

_LEAST_TAU_S = 0.01
"""Smallest time constant [s]: a quarter of a cell at 25 Hz, within which the wheels follow at once."""
_REST = 0.01
"""Creep of wheels at rest [m/s]: without any, the friction of wheels that do not slip has no direction."""
_LEAST_SCRUB = 0.03
"""Smallest friction to report [m/s]: a smaller one is within the tolerance of a data sheet."""
_LEAST_DRAG = 0.01
"""Smallest resistance to report [m/s]: a smaller one is within the tolerance of a data sheet."""
_RIM_OF_STARTS = 5.0
"""Speed of the rim [m/s] of the Warthogs that have the values of the starts."""
_OTHER_RIM = 1.5
"""Ratio of speeds of rims from which starts are scaled: a bound that never acts has no derivative."""
_ALIKE_AT, _SLOPES = 3.0, (0.5, 0.7, 1.4, 2.0)
"""Speed [m/s] at which other motors have the same force, and how fast theirs falls, by that of this one."""
_STEP_MPS, _WATCHED_S = 1.0, 5.0
"""Step of the command that describes it without a run [m/s], and how long it is watched [s]."""
_NEARLY_ALL = 0.98
"""Share of a step after one time constant, and share that counts as all of it."""
_TINY = 1e-6
"""Friction [m/s] that counts as none: a divisor."""
_NO_COMMAND = 1e-6
"""Command [m/s] that counts as none: above the rounding of sums."""


class WheelServo(JointDrive):
    """Wheel servo: the speed controller of each side works against ground friction."""

    id = "wheel_servo"
    rank = 31
    has_state = True
    kinds = ("differential",)
    parameters = (
        replace(
            TIME_CONSTANT,
            bounds=(_LEAST_TAU_S, 10.0),
            about="time constant, straight ahead",
            typical=0.2,
            starts=(),
            search=Search.STARTS,
            plausible=Plausible(_LEAST_TAU_S, 3.0, "wider than the 0.15 to 0.2 s of a Warthog"),
            quantities=(Quantity.SPEED_LAG,),
            level=Level.VEHICLE,
        ),
        Parameter(
            "reset",
            "1/s",
            (0.0, 20.0),
            0.0,
            "integral gain, over the proportional gain",
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
            "rolling resistance, of a side over the proportional gain",
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
            "largest force, of the drive at rest over the proportional gain",
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
            "no-load speed, at which the drive has no force left",
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
            "ground friction, over the proportional gain",
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
            "slip per force, of a rolling wheel with little slip; the force is over the proportional gain",
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
    needs = (Excitation.DRIVING, Excitation.TURNING, Excitation.CHANGES)

    def list_starts(self, largest: Largest) -> list[dict[str, float]]:
        """The starts, and the same with speeds in proportion to the fastest rim where it is another one."""
        starts = super().list_starts(largest)
        share = largest.rim / _RIM_OF_STARTS or 1.0
        if max(share, 1.0 / share) < _OTHER_RIM:
            return starts
        factors = {p.name: {"m/s": share, "s/m": 1.0 / share}.get(p.unit, 1.0) for p in self.parameters}
        scaled = ({name: factors[name] * start[name] for name in start} for start in starts)
        return starts + [dict(self.change_within(**one).values) for one in scaled]

    def list_alike(self) -> list[Self]:
        """The same force near the speed of the starts by other motors: another valley, or the same one."""
        bound, slope = self.values["bound"], self._slope
        if not slope:
            return []
        forces = [(bound + (share - 1.0) * slope * _ALIKE_AT, share * slope) for share in _SLOPES]
        return [
            self.change_within(bound=force, no_load=force / fall) for force, fall in forces if force > 0.0
        ]

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
        return wheels if self.is_neutral else self.drive_each([(self, wheels)], context)[0]

    @classmethod
    def drive_each(cls, pairs: Sequence[tuple[Self, Wheels]], context: RunContext) -> list[Wheels]:
        """See `JointDrive`."""
        radius, resets = context.vehicle.wheel_radius_m, context.wheels
        inputs = list({id(wheels): wheels for _, wheels in pairs}.values())
        index_of = {id(wheels): index for index, wheels in enumerate(inputs)}
        asked = np.empty((len(inputs), 3, inputs[0].left.size))
        for wheels, (left, right, idle) in zip(inputs, asked, strict=True):
            np.multiply(radius, wheels.left, out=left)
            np.multiply(radius, wheels.right, out=right)
            if wheels.idle is None:
                idle[:] = np.maximum(np.abs(left), np.abs(right)) < _NO_COMMAND
            else:
                idle[:] = wheels.idle
        # Where speeds are set: those of the input, or those that are measured.
        at = np.unique(np.concatenate((resets.first, resets.at)))
        states = np.zeros((len(inputs), 3, at.size))
        states[:, :2] = asked[:, :2, at]
        known, start = np.searchsorted(at, resets.at), radius * resets.start[:, :2].T
        states[:, :2, known] = np.where(np.isfinite(start), start, states[:, :2, known])
        states[:, 2, known] = np.isfinite(start).all(axis=0)
        states[:, 2, np.searchsorted(at, context.spans.first)] = 0.0
        numbers = [effect.list_numbers(context.track_m, wheels.imbalance) for effect, wheels in pairs]
        source = [index_of[id(wheels)] for _, wheels in pairs]
        rolled = walk_each(numbers, source, asked, at, states, context.step_s)
        rolled /= radius
        return [
            replace(wheels, left=left, right=right)
            for (_, wheels), (left, right) in zip(pairs, rolled, strict=True)
        ]

    def list_seen(
        self, vehicle: Vehicle, beside: Iterable[Effect] = (), asked: Asked | None = None
    ) -> dict[str, float]:
        """What the whole drive makes of a step of the command from rest, straight ahead and on the spot.

        The steps are the largest that the run asks for; without a run, one speed of either side.

        Returns:
            ``asked``, the speed of the step [m/s]; ``rise``, time to 63 % of it straight ahead [s], NaN where
            it is not reached; ``turn``, the yaw rate of the step on the spot [rad/s]; ``turned``, the share
            of it that the wheels have after two seconds, NaN where it is nearly all, or where the run does
            not turn on the spot.
        """
        step = min(_STEP_MPS, vehicle.max_speed_mps or math.inf)
        turn = 2.0 * step / vehicle.kinematics.turning_width_m(vehicle)
        if asked is not None:
            step, turn = asked.speed_mps, asked.turn_radps
        seen = {"asked": step, "rise": math.nan, "turn": turn, "turned": math.nan}
        if self.is_neutral or any(map(math.isnan, self.values.values())):
            return seen
        drive = [one for one in beside if one.place <= Place.DRIVE and one.id != self.id]
        if step > 0.0:
            seen["rise"] = time_rise(predict_step(vehicle, [*drive, self], step, 0.0, _WATCHED_S).x / step)
        if turn > 0.0:
            turned = float(predict_step(vehicle, [*drive, self], 0.0, turn, HORIZON_S).w[-1]) / turn
            seen |= {"turned": turned} if turned < _NEARLY_ALL else {}
        return seen

    def list_numbers(self, track_m: float, imbalance: float) -> Floats:
        """The numbers of `walk_each`."""
        tau, scrub = max(self.values["tau"], _LEAST_TAU_S), self.values["scrub"]
        gain = 0.5 * (1.0 + ROTATING) / tau
        return np.array(
            (
                gain,
                self.values["reset"] * gain,
                self.values["drag"] * gain,
                (1.0 - 0.5 * imbalance) * self.values["bound"] * gain,
                (1.0 + 0.5 * imbalance) * self.values["bound"] * gain,
                (self.values["creep"] * tau) ** 2,
                (_REST * tau) ** 2 if scrub > 0.0 else math.inf,
                (tau / max(scrub, _TINY)) ** 2,
                0.5 * track_m,
                self._slope * gain,
            )
        )
