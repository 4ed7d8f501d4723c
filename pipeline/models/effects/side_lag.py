"""Side lag: one side follows its commands more slowly than the other, as with a weak motor.

    tau_left * dOmega_l/dt = u_l - Omega_l,  tau_right * dOmega_r/dt = u_r - Omega_r

tau_left, tau_right [s]. Every change of speed turns the vehicle towards the weak side for a moment, and back.
Change speed often, straight ahead too.

Source: loss of effectiveness of one actuator; Blanke et al., Diagnosis and Fault-Tolerant Control, chapter 3.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.models.effect import DriveEffect, Excitation, Parameter, Plausible, Search
from pipeline.models.effects.drive_lag import DriveLag
from pipeline.models.filters import lag_signal

if TYPE_CHECKING:
    from pipeline.models.effect import Effect
    from pipeline.models.evidence import Evidence
    from pipeline.runs.signals import RunContext, Wheels
    from pipeline.vehicles import Vehicle

_PLAUSIBLE = Plausible(0.0, 3.0, "as of a drive lag")
# Closer together, as a share of the slower one or in seconds, both time constants are one.
_APART = 0.15
_LEAST_APART_S = 0.03


class SideLag(DriveEffect):
    """Side lag: one side follows its commands more slowly than the other."""

    id = "side_lag"
    rank = 35
    kinds = ("differential",)
    parameters = (
        Parameter(
            "tau_left",
            "s",
            (0.0, 10.0),
            0.0,
            "time constant of the left side",
            0.5,
            search=Search.STARTS,
            starts=(0.4,),
            step=5e-3,
            plausible=_PLAUSIBLE,
        ),
        Parameter(
            "tau_right",
            "s",
            (0.0, 10.0),
            0.0,
            "time constant of the right side",
            0.2,
            search=Search.STARTS,
            starts=(0.4,),
            step=5e-3,
            plausible=_PLAUSIBLE,
        ),
    )
    needs = (Excitation.CHANGES,)
    confused_with = ("drive_lag", "turn_lag", "icr_lateral")
    contains = ("drive_lag",)
    # Where ground disturbs the wheels a second time constant always helps a little.
    price = 0.1
    python_state = ("weak_left", "weak_right")
    python = """
        keep = math.exp(-step_s / {tau_left}) if {tau_left} > 0.0 else 0.0
        left = weak_left = left + (weak_left - left) * keep
        keep = math.exp(-step_s / {tau_right}) if {tau_right} > 0.0 else 0.0
        right = weak_right = right + (weak_right - right) * keep"""

    def describe_motion(self, vehicle: Vehicle) -> str:
        """The effect as what the vehicle does."""
        del vehicle
        left, right = self.values["tau_left"], self.values["tau_right"]
        return f"follows its commands {left:.2f} s late on the left and {right:.2f} s on the right"

    def drive_wheels(self, wheels: Wheels, around: RunContext) -> Wheels:
        """See the formula above."""
        resets, step = around.wheels, around.step_s
        return replace(
            wheels,
            left=lag_signal(wheels.left, self.values["tau_left"], step, resets, resets.start[:, 0]),
            right=lag_signal(wheels.right, self.values["tau_right"], step, resets, resets.start[:, 1]),
        )

    def is_degenerate(self, evidence: Evidence) -> bool:
        """With equal time constants it is a drive lag."""
        left, right = self.values["tau_left"], self.values["tau_right"]
        least = max(evidence.least_delay_s, _LEAST_APART_S)
        return abs(left - right) <= max(_APART * max(left, right), least)

    def collapse(self) -> Effect | None:
        """A drive lag of the mean time constant."""
        return DriveLag(tau=0.5 * (self.values["tau_left"] + self.values["tau_right"]))
