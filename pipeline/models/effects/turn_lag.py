"""Turn lag: the difference of the wheels follows its command more slowly than their mean.

    D = Omega_r - Omega_l,  M = (Omega_r + Omega_l)/2:
    tau_mean * dM/dt = u_M - M,  tau_diff * dD/dt = u_D - D

tau_mean, tau_diff [s]: friction on the ground brakes turning, so 0.4 and 1.1 to 1.6 s on a Warthog (0.55
on ice), 0.1 and 0.35 s on a Husky. What moves a vehicle sideways follows like the mean. Change speed and
turning separately.

Source: measured on the DRIVE recordings; the powertrain model of DRIVE, Baril et al. 2024, split in two.
"""

from dataclasses import replace

from pipeline.models.effect import SIDES, Excitation, Plausible, Spread
from pipeline.models.effects.drive_lag import TwoLags, time_constant
from pipeline.models.filters import lag_signal
from pipeline.models.parameter import Quantity
from pipeline.run.signals import RunContext, Wheels

_SEEN = Plausible(0.0, 3.0, "wider than the 0.1 to 1.6 s of Husky and Warthog")


class TurnLag(TwoLags):
    """Turn lag: the difference of the wheels follows its command more slowly than their mean."""

    id = "turn_lag"
    rank = 30
    kinds = SIDES
    apart, least_apart_s = 0.08, 0.02
    parameters = (
        replace(
            time_constant("tau_mean", "time constant of the mean", 0.3, (0.1, 0.4)),
            plausible=_SEEN,
            quantities=(Quantity.SPEED_LAG,),
            between_runs=Spread(0.12),
        ),
        replace(
            time_constant("tau_diff", "time constant of the difference", 1.0, (0.3, 1.2)),
            plausible=_SEEN,
            quantities=(Quantity.TURN_LAG,),
            between_runs=Spread(0.24),
        ),
    )
    motion = "Turning lag: time constant {tau_diff:.2f} s for turning, {tau_mean:.2f} s for speed"
    clause = "follows turns with a time constant of {tau_diff:.2g} s"
    needs = (Excitation.CHANGES, Excitation.TURNING)
    confused_with = ("drive_lag", "transport_delay", "turn_droop")
    same_in_one_motion = ("drive_lag",)
    python_state = ("lag_mean", "lag_difference", "lag_aside")
    python = """
        keep = math.exp(-step_s / {tau_mean}) if {tau_mean} > 0.0 else 0.0
        lag_mean = (left + right) / 2.0 + (lag_mean - (left + right) / 2.0) * keep
        sideways = lag_aside = sideways + (lag_aside - sideways) * keep
        keep = math.exp(-step_s / {tau_diff}) if {tau_diff} > 0.0 else 0.0
        lag_difference = right - left + (lag_difference - (right - left)) * keep
        left, right = lag_mean - lag_difference / 2.0, lag_mean + lag_difference / 2.0"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        fast, slow = self.taus
        if slow <= 0.0 and fast <= 0.0:
            # Avoids the rounding of a conversion to mean and difference and back.
            return wheels
        resets, step = context.wheels, context.step_s
        left, right = resets.start[:, 0], resets.start[:, 1]
        mean = lag_signal(0.5 * (wheels.left + wheels.right), fast, step, resets, 0.5 * (left + right))
        difference = lag_signal(wheels.right - wheels.left, slow, step, resets, right - left)
        sideways = wheels.sideways
        if sideways is not None:
            sideways = lag_signal(sideways, fast, step, resets, resets.start[:, 2])
        return replace(wheels, left=mean - 0.5 * difference, right=mean + 0.5 * difference, sideways=sideways)
