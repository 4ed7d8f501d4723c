"""Side lag: one side follows its commands more slowly than the other, as with a weak motor.

    tau_left * dOmega_l/dt = u_l - Omega_l,  tau_right * dOmega_r/dt = u_r - Omega_r

tau_left, tau_right [s]. Every change of speed turns the vehicle towards the weak side for a moment, and back.
Change speed often, straight ahead too.

Source: loss of effectiveness of one actuator; Blanke et al., Diagnosis and Fault-Tolerant Control, chapter 3.
"""

from dataclasses import replace

from pipeline.models.effect import Excitation
from pipeline.models.effects.drive_lag import TwoLags, time_constant
from pipeline.models.filters import lag_signal
from pipeline.run.signals import RunContext, Wheels


class SideLag(TwoLags):
    """Side lag: one side follows its commands more slowly than the other."""

    id = "side_lag"
    rank = 35
    kinds = ("differential",)
    apart, least_apart_s = 0.15, 0.03
    parameters = (
        time_constant("tau_left", "time constant of the left side", 0.5, (0.4,)),
        time_constant("tau_right", "time constant of the right side", 0.2, (0.4,)),
    )
    motion = "Side lag: time constant {tau_left:.2f} s on the left, {tau_right:.2f} s on the right"
    clause = "follows with time constants of {tau_left:.2g} s on the left and {tau_right:.2g} s on the right"
    needs = (Excitation.CHANGES,)
    confused_with = ("drive_lag", "turn_lag", "icr_lateral")
    # If the ground disturbs the wheels, a second time constant always reduces the error a little.
    python_state = ("weak_left", "weak_right")
    python = """
        keep = math.exp(-step_s / {tau_left}) if {tau_left} > 0.0 else 0.0
        left = weak_left = left + (weak_left - left) * keep
        keep = math.exp(-step_s / {tau_right}) if {tau_right} > 0.0 else 0.0
        right = weak_right = right + (weak_right - right) * keep"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        (left, right), resets, step = self.taus, context.wheels, context.step_s
        return replace(
            wheels,
            left=lag_signal(wheels.left, left, step, resets, resets.start[:, 0]),
            right=lag_signal(wheels.right, right, step, resets, resets.start[:, 1]),
        )
