"""Speed servo: a speed loop of bounded effort drives the mean of the wheels against a drag.

    M = r (Omega_r + Omega_l) / 2:  dM/dt = clip((M_u - M) / tau, effort) - drag * M / tau

tau [s] is one over the proportional gain, effort [m/s^2] the largest acceleration that the drive can give.
drag is the resistance that grows with speed over the proportional gain, a plain number: 1 / (1 + drag) of a
steady command is reached. On a Warthog 0.1 to 0.6 s, 2.5 to 4.8 m/s^2 and 0 to 0.1. The difference of the
wheels stays as it is: see turn_servo. Ask for small and for large steps of speed.

Source: the powertrain model of DRIVE, Baril et al. 2024, with the torque limit of the motor; measured on the
DRIVE recordings.
"""

import math
from dataclasses import replace

import numpy as np

from pipeline.models.effect import INF, DriveEffect, Effect, Excitation, Least, Parameter, Plausible, Search
from pipeline.models.effects.body_acceleration_limit import LEAST_RAMP_S, BodyAccelerationLimit
from pipeline.models.effects.drive_lag import TIME_CONSTANT
from pipeline.models.filters import ServoNumbers, follow_servo
from pipeline.models.parameter import Conditions, Level, Quantity
from pipeline.run.signals import RunContext, Wheels

_LEAST_DRAG = 0.01
"""Smallest drag to report: a smaller one is within the tolerance of a data sheet."""


class SpeedServo(DriveEffect):
    """Speed servo: a speed loop of bounded effort drives the mean of the wheels against a drag."""

    id = "speed_servo"
    rank = 31
    kinds = ("differential",)
    parameters = (
        replace(
            TIME_CONSTANT,
            about="one over the proportional gain",
            typical=0.4,
            starts=(),
            search=Search.STARTS,
            least=Least(0.015, Least.STAMPS, sampled=1.0),
            plausible=Plausible(0.0, 3.0, "wider than the 0.1 to 0.6 s of a Warthog"),
            quantities=(Quantity.SPEED_LAG,),
            level=Level.VEHICLE,
        ),
        Parameter(
            "drag",
            "1",
            (0.0, 2.0),
            0.0,
            "resistance that grows with speed over the proportional gain",
            0.1,
            search=Search.STARTS,
            step=1e-3,
            level=Level.VEHICLE,
        ),
        Parameter(
            "effort",
            "m/s^2",
            (0.05, 100.0),
            INF,
            "largest acceleration of the drive",
            1.5,
            search=Search.STARTS,
            step=1e-2,
            level=Level.VEHICLE,
        ),
    )
    starts = (
        {"tau": 0.25, "drag": 0.02, "effort": 5.0},
        {"tau": 0.35, "drag": 0.04, "effort": 3.0},
        {"tau": 0.4, "drag": 0.04, "effort": 1.2},
    )
    motion = "Speed servo: lag {tau:.2f} s, limit {effort:.3g} m/s^2, drag {drag:.2g}"
    clause = "answers speed commands {tau:.2g} s late"
    needs = (Excitation.DRIVING, Excitation.CHANGES, Excitation.LARGE)
    confused_with = ("drive_lag", "acceleration_limit", "wheel_radius")
    contains = ("body_acceleration_limit",)
    python_state = ("sped",)
    python = """
        asked, before, tau = (left + right) * R / 2.0, sped, max({tau}, 1e-9)
        pull = max(-{effort} * tau, min({effort} * tau, asked - sped))
        goal, pace = asked / (1.0 + {drag}), (pull - {drag} * sped) / tau
        sped = goal + (sped - goal) * math.exp(-(1.0 + {drag}) * step_s / tau)
        forth = pace * (sped - before) > 0.0
        sped = approach(before, sped, abs(pace) * step_s) if forth else before + pace * step_s
        left, right = sped / R - (right - left) / 2.0, sped / R + (right - left) / 2.0"""

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether, without drag, it is a lag (the effort never saturates) or an acceleration limit."""
        never_bounded = self.values["effort"] * self.values["tau"] >= conditions.largest.speed
        return self.values["drag"] < _LEAST_DRAG and (never_bounded or self._is_limit)

    @property
    def _is_limit(self) -> bool:
        """Whether only the effort limits the speed; encoders round the ends of a ramp as a short lag does."""
        tau, drag, effort = self.values.values()
        return tau < LEAST_RAMP_S and drag < _LEAST_DRAG and math.isfinite(effort)

    def collapse(self) -> Effect | None:
        """An acceleration limit if it reduces to one, else None."""
        return BodyAccelerationLimit(limit=min(self.values["effort"], 50.0)) if self._is_limit else None

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        radius, resets = context.vehicle.wheel_radius_m, context.wheels
        zeros = np.zeros_like(wheels.left)
        mean = follow_servo(
            0.5 * radius * (wheels.left + wheels.right),
            ServoNumbers(**self.values),
            zeros,
            context.step_s,
            resets,
            0.5 * radius * (resets.start[:, 0] + resets.start[:, 1]),
            zeros,
        )
        mean /= radius
        half = 0.5 * (wheels.right - wheels.left)
        return replace(wheels, left=mean - half, right=mean + half)
