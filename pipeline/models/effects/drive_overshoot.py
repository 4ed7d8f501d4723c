"""Drive overshoot: wheels swing past the commanded speed before they settle.

    tau^2 * d2Omega/dt2 + 2 * damping * tau * dOmega/dt = u - Omega, each wheel

tau [s] is one over the natural frequency, damping a plain number: 1 and more is a lag, 0.5 overshoots a step
by 16 %. Change commands often, in steps.

Source: second-order systems; Astrom and Murray, Feedback Systems, chapter 7.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

from pipeline.core import format_share
from pipeline.models.effect import (
    NAN,
    WHEELED,
    DriveEffect,
    Effect,
    Excitation,
    Least,
    Parameter,
    Plausible,
    Search,
)
from pipeline.models.effects.drive_lag import TIME_CONSTANT, DriveLag
from pipeline.models.filters import swing_signal
from pipeline.models.parameter import Conditions
from pipeline.run.signals import RunContext, Wheels
from pipeline.sources import Vehicle

LEAST_OVERSHOOT = 0.03
"""Share of a step: the settling tolerance of a controller."""


def measure_overshoot(damping: float) -> float:
    """Overshoot of a second-order system as a share of the step."""
    return math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2)) if damping < 1.0 else 0.0


class DriveOvershoot(DriveEffect):
    """Drive overshoot: wheels swing past the commanded speed before they settle."""

    id = "drive_overshoot"
    rank = 26
    kinds = WHEELED
    parameters = (
        replace(
            TIME_CONSTANT,
            about="one over the natural frequency",
            typical=0.2,
            starts=(),
            search=Search.STARTS,
            least=Least(0.03, Least.STAMPS, sampled=1.0),
            plausible=Plausible(0.0, 1.5, "wheels swing slower than 0.1 Hz on no controller"),
        ),
        Parameter(
            "damping",
            "1",
            (0.02, 1.5),
            NAN,
            "damping ratio",
            0.4,
            search=Search.STARTS,
            step=5e-3,
        ),
    )
    starts = ({"tau": 0.1, "damping": 0.4}, {"tau": 0.25, "damping": 0.4}, {"tau": 0.6, "damping": 0.4})
    needs = (Excitation.CHANGES,)
    confused_with = ("drive_lag", "transport_delay", "wheel_servo")
    contains = ("drive_lag",)
    python_state = ("swung",)
    python = """
        wheels, swung = split(left, right, sideways), swung or [(0.0, 0.0)] * 4
        swung = [swing(was, wheel, {tau}, {damping}, step_s) for was, wheel in zip(swung, wheels)]
        left, right, sideways = join([speed for speed, _ in swung])"""

    def describe_motion(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """What the vehicle does, with numbers."""
        return f"Drive overshoot: {format_swing(self)}"

    def describe_clause(self, vehicle: Vehicle, beside: Iterable[Effect] = ()) -> str:
        """The effect as a clause of a sentence."""
        return f"overshoots a step of its speed by {format_share(measure_overshoot(self.values['damping']))}"

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        tau, damping = self.numbers
        return wheels.change_each_wheel(
            lambda speed, resets, start: swing_signal(speed, tau, damping, context.step_s, resets, start),
            context,
        )

    def can_show(self, conditions: Conditions) -> bool:
        """Never in a search, which confuses it with a lag of the servos; it can be added by hand."""
        return False

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the overshoot is negligible: it is a lag."""
        return measure_overshoot(self.numbers[1]) < LEAST_OVERSHOOT

    def collapse(self) -> Effect | None:
        """A lag with the same delay."""
        tau, damping = self.numbers
        return DriveLag.of_delay(2.0 * damping * tau)

    @property
    def numbers(self) -> tuple[float, float]:
        """One over the natural frequency [s], and the damping, critical if not given."""
        tau, damping = self.values.values()
        return tau, 1.0 if math.isnan(damping) else damping


def format_swing(effect: Effect) -> str:
    """Overshoot, natural frequency and damping of a second-order effect as text."""
    tau, damping = effect.values["tau"], effect.values["damping"]
    frequency = 0.5 / (math.pi * tau) if tau > 0.0 else math.inf
    beyond = measure_overshoot(damping)
    return (
        f"{format_share(beyond)} beyond a step, natural frequency {frequency:.2g} Hz, damping {damping:.2g}"
    )
