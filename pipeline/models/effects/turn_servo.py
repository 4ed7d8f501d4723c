"""Turn servo: a speed loop with an integral part and bounded effort turns the vehicle against scrub.

    D = r (Omega_r - Omega_l) / b, the yaw rate of the wheels,  e = D_u - D,  R = abs(v / D), the radius:
    dD/dt = u - S sign(D),  u = clip((e + z) / tau, effort),  dz/dt = reset * e while abs(u) < effort,
    abs(z) <= windup,  z = 0 while D_u = 0,
    S = scrub / tau / (1 + 0.15 R / b);  D stays at 0 while abs(u) <= S

tau [s] is one over the proportional gain, reset [1/s] the integral gain over the proportional one (the reset
time is 1 / reset), windup [rad/s] the largest integral part over the proportional gain, effort [rad/s^2] the
largest angular acceleration that the drive can give. scrub [rad/s] is the turning resistance on the spot over
the proportional gain: a smaller turn begins only when the integral part has grown enough, so that it seems to
have a lag of many seconds. While no turn is commanded the controller clears its integral part. On a Warthog
0.2 to 1.2 s, 0.1 to 0.35 1/s, 0.1 (ice) to 1.2 rad/s, 2.2 to 5.6 rad/s^2, and 0.1 (ice) to 1.4 rad/s. Turn
slowly and quickly, for seconds, on the spot and while driving.

Source: Steeds, Tracked Vehicles, 1950, and Wong, Theory of Ground Vehicles: turning resistance falls with the
radius; anti-windup of Astrom and Murray, Feedback Systems, chapter 10; measured on the DRIVE recordings.
"""

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipeline.models.effect import INF, DriveEffect, Effect, Excitation, Least, Parameter, Plausible, Search
from pipeline.models.effects.drive_lag import TIME_CONSTANT
from pipeline.models.filters import ServoNumbers, follow_servo
from pipeline.models.parameter import Conditions, Level, Quantity
from pipeline.run.signals import RunContext, Wheels
from pipeline.sources import Vehicle

_FALL = 0.15
"""Decrease of the turning resistance with the radius over the track, see the formula."""


_LEAST_SCRUB = 0.03
"""Smallest friction to report [rad/s]: a smaller one is within the tolerance of a data sheet."""


class TurnServo(DriveEffect):
    """Turn servo: a speed loop with an integral part and bounded effort turns the vehicle against scrub."""

    id = "turn_servo"
    rank = 32
    kinds = ("differential",)
    parameters = (
        replace(
            TIME_CONSTANT,
            about="one over the proportional gain",
            typical=0.6,
            starts=(),
            search=Search.STARTS,
            plausible=Plausible(0.0, 5.0, "wider than the 0.2 to 1.2 s of a Warthog"),
            quantities=(Quantity.TURN_LAG,),
            level=Level.VEHICLE,
        ),
        Parameter(
            "reset",
            "1/s",
            (0.0, 20.0),
            0.0,
            "integral over proportional gain",
            0.3,
            search=Search.STARTS,
            step=5e-3,
            level=Level.VEHICLE,
        ),
        Parameter(
            "scrub",
            "rad/s",
            (0.0, 20.0),
            0.0,
            "turning resistance on the spot over the proportional gain",
            0.5,
            search=Search.STARTS,
            step=1e-2,
            least=Least(_LEAST_SCRUB, Least.DATA_SHEET),
            plausible=Plausible(0.0, 5.0, "wider than the 0.1 to 1.4 rad/s of a Warthog"),
            level=Level.TERRAIN,
        ),
        Parameter(
            "windup",
            "rad/s",
            (0.0, 20.0),
            0.0,
            "largest integral part over the proportional gain",
            0.3,
            search=Search.STARTS,
            step=1e-2,
            level=Level.VEHICLE,
        ),
        Parameter(
            "effort",
            "rad/s^2",
            (0.05, 100.0),
            INF,
            "largest angular acceleration of the drive",
            2.5,
            search=Search.STARTS,
            step=1e-2,
            level=Level.VEHICLE,
        ),
    )
    starts = (
        {"tau": 0.45, "reset": 0.3, "scrub": 1.15, "windup": 0.95, "effort": 3.4},
        {"tau": 0.25, "reset": 0.3, "scrub": 1.1, "windup": 0.9, "effort": 5.0},
        {"tau": 1.1, "reset": 0.12, "scrub": 0.8, "windup": 0.55, "effort": 2.0},
        {"tau": 0.9, "reset": 0.03, "scrub": 0.4, "windup": 0.2, "effort": 2.5},
        {"tau": 0.45, "reset": 0.02, "scrub": 0.1, "windup": 0.05, "effort": 2.8},
    )
    motion = (
        "Turn servo: lag {tau:.2f} s, integral {reset:.2g} 1/s up to {windup:.2g} rad/s, "
        "limit {effort:.3g} rad/s^2, friction {scrub:.2g} rad/s"
    )
    clause = "answers turns {tau:.2g} s late against friction"
    needs = (Excitation.TURNING, Excitation.SMALL, Excitation.CHANGES)
    confused_with = ("turn_lag", "turn_droop", "acceleration_limit")
    python_state = ("turned", "integral")
    python = """
        asked, ahead = (right - left) * R / B, (left + right) / 2.0
        tau, before, across = max({tau}, 1e-9), turned, 0.15 * abs(ahead) * R / B
        is_driven = abs(asked) >= 1e-6
        integral = integral if is_driven else 0.0
        pull = max(-{effort} * tau, min({effort} * tau, asked - turned + integral))
        moving = max(abs(turned), abs(pull) * step_s / tau)
        against = {scrub} * moving / (moving + across) if moving > 0.0 else 0.0
        if turned or abs(pull) > against:
            against = math.copysign(against, turned or pull)
            goal, pace = asked + integral - against, (pull - against) / tau
            turned = goal + (turned - goal) * math.exp(-step_s / tau)
            forth = pace * (turned - before) > 0.0
            turned = approach(before, turned, abs(pace) * step_s) if forth else before + pace * step_s
            if before * turned < 0.0 and abs(pull) <= abs(against):
                turned = 0.0
        if is_driven and abs(asked - before + integral) <= {effort} * tau:
            integral = max(-{windup}, min({windup}, integral + {reset} * (asked - before) * step_s))
        left, right = ahead - turned * B / R / 2.0, ahead + turned * B / R / 2.0"""

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers; an integral part that stays zero is omitted."""
        text = super().describe_motion(vehicle, beside)
        if self.values["reset"] * self.values["windup"] > 0.0:
            return text
        return re.sub(r", integral [^,]*", "", text)

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is a lag: neither friction nor integral, and more effort than the fastest turn needs."""
        reached = conditions.largest.turn
        tau, reset, scrub, windup, effort = (
            self.values[name] for name in ("tau", "reset", "scrub", "windup", "effort")
        )
        # The integral of the error during one time constant of the fastest turn.
        gathered = min(windup, reset * tau * reached) if reset > 0.0 else 0.0
        return max(scrub, gathered) < _LEAST_SCRUB and effort * tau >= reached

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        to_turn = context.vehicle.wheel_radius_m / context.track_m
        mean, resets = 0.5 * (wheels.left + wheels.right), context.wheels
        turned = follow_servo(
            to_turn * (wheels.right - wheels.left),
            ServoNumbers(**self.values),
            _FALL * to_turn * np.abs(mean),
            context.step_s,
            resets,
            to_turn * (resets.start[:, 1] - resets.start[:, 0]),
            wheels.straight,
        )
        half = 0.5 * turned / to_turn
        return replace(wheels, left=mean - half, right=mean + half)
