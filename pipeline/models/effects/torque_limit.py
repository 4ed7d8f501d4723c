"""Torque limit: wheels follow the commanded speed with a lag and a limited acceleration.

    dOmega/dt = (u - Omega) / tau within +-limit, each wheel

tau [s] and limit [rad/s^2]. After a small step the wheels follow like a drive lag; after a large one the
motors give their maximum, and the lag begins where limit tau remains. A commanded ramp is different: there
the lag follows the ramp. Command small and large steps of speed.

Source: saturation of a speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from dataclasses import replace

from pipeline.models.effect import (
    WHEELED,
    DriveEffect,
    Effect,
    Excitation,
    Least,
    Plausible,
    Search,
    Spread,
)
from pipeline.models.effects.acceleration_limit import AccelerationLimit
from pipeline.models.effects.body_acceleration_limit import LEAST_RAMP_S
from pipeline.models.effects.drive_lag import TIME_CONSTANT, DriveLag
from pipeline.models.filters import lag_within
from pipeline.models.parameter import WARTHOG_LAGS, Conditions, Largest, Quantity
from pipeline.run.signals import RunContext, Wheels


class TorqueLimit(DriveEffect):
    """Torque limit: wheels follow the commanded speed with a lag and a limited acceleration."""

    id = "torque_limit"
    rank = 22
    kinds = WHEELED
    parameters = (
        replace(
            TIME_CONSTANT,
            typical=0.3,
            starts=(),
            search=Search.STARTS,
            least=Least(0.015, Least.STAMPS, sampled=1.0),
            plausible=Plausible(0.0, 3.0, "as of a drive lag"),
            between_runs=Spread(0.125, WARTHOG_LAGS),
            quantities=(Quantity.SPEED_LAG, Quantity.TURN_LAG),
        ),
        replace(AccelerationLimit.parameters[0], starts=(), search=Search.STARTS),
    )
    starts = (
        {"tau": 0.15, "limit": 4.0},
        {"tau": 0.5, "limit": 4.0},
        {"tau": 0.15, "limit": 12.0},
        {"tau": 0.5, "limit": 12.0},
    )
    motion = "Torque limit: {limit:.3g} rad/s^2 at every wheel, time constant {tau:.2f} s below it"
    clause = "follows commands with a lag of {tau:.2g} s and at most {limit:.2g} rad/s^2"
    needs = (Excitation.CHANGES, Excitation.LARGE, Excitation.SMALL)
    confused_with = ("drive_lag", "acceleration_limit", "wheel_servo")
    contains = ("drive_lag", "acceleration_limit")
    python_state = ("pulled",)
    python = """
        wheels, pulled = split(left, right, sideways), pulled or [0.0] * 4
        pulled = [saturate(was, wheel, {tau}, {limit}, step_s) for was, wheel in zip(pulled, wheels)]
        left, right, sideways = join(pulled)"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        tau, limit = self.values.values()
        return wheels.change_each_wheel(
            lambda speed, resets, start: lag_within(speed, tau, limit, context.step_s, resets, start), context
        )

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether it is a lag, within the limit after the largest step, or a ramp without a lag."""
        tau, limit = self.values.values()
        lags = tau > conditions.least_delay_s
        return not lags or limit * max(tau, LEAST_RAMP_S) >= conditions.largest.wheel

    def collapse(self) -> Effect | None:
        """The lag, or the ramp."""
        tau, limit = self.values.values()
        if tau > LEAST_RAMP_S:
            return DriveLag().change_within(tau=tau)
        return AccelerationLimit().change_within(limit=limit)

    def _list_usual(self, largest: Largest) -> dict[str, float]:
        return {"tau": self.parameters[0].typical, "limit": largest.wheel}
