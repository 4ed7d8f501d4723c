"""Brake lag: wheels speed up with one time constant and slow down with another.

    tau * dOmega/dt = u - Omega, each wheel:  tau = tau_brake where Omega is slowed down, else tau_drive

tau_drive, tau_brake [s]. A motor against a load speeds up slowly and is braked by it; one that coasts slows
down slowly. What turns over is braked until it stands. Command steps up and down, of several heights.

Source: hybrid speed response of a motor with a one-quadrant drive; Isermann, Mechatronic Systems, chapter 6.
"""

from pipeline.models.effect import WHEELED, Excitation
from pipeline.models.effects.drive_lag import TwoLags, time_constant
from pipeline.models.filters import lag_unevenly
from pipeline.run.signals import RunContext, Wheels


class BrakeLag(TwoLags):
    """Brake lag: wheels speed up with one time constant and slow down with another."""

    id = "brake_lag"
    rank = 25
    kinds = WHEELED
    apart, least_apart_s = 0.2, 0.04
    parameters = (
        time_constant("tau_drive", "time constant while speeding up", 0.6, (0.5,)),
        time_constant("tau_brake", "time constant while slowing down", 0.2, (0.2,)),
    )
    motion = "Brake lag: time constant {tau_drive:.2f} s speeding up, {tau_brake:.2f} s slowing down"
    clause = "speeds up and slows down with time constants of {tau_drive:.2g} s and {tau_brake:.2g} s"
    needs = (Excitation.CHANGES,)
    confused_with = ("drive_lag", "turn_lag", "acceleration_limit")
    # If the ground disturbs the wheels, a second time constant always reduces the error a little.
    python_state = ("braked",)
    python = """
        wheels, braked = split(left, right, sideways), braked or [0.0] * 4
        slows = [was * wheel < 0.0 or abs(wheel) < abs(was) for was, wheel in zip(braked, wheels)]
        keeps = [math.exp(-step_s / tau) if tau > 0.0 else 0.0 for tau in ({tau_drive}, {tau_brake})]
        braked = [wheel + (was - wheel) * keeps[slow] for was, wheel, slow in zip(braked, wheels, slows)]
        left, right, sideways = join(braked)"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        taus = self.taus
        return wheels.change_each_wheel(
            lambda speed, resets, start: lag_unevenly(speed, taus, context.step_s, resets, start), context
        )
