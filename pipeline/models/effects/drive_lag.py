"""Drive lag: wheels follow the commanded speed like a first-order system.

    tau * dOmega/dt = u - Omega, each wheel

tau [s]: 0.55 to 0.64 on a Husky on tile, 1.0 in snow, 1.05 to 1.2 on a Warthog. Change commands often.

Source: the powertrain model of Samson et al. 2024 and of DRIVE, Baril et al. 2024.
"""

from dataclasses import replace
from typing import ClassVar

from pipeline.models.effect import DriveEffect, Effect, Excitation, Least, Parameter, Plausible, Spread
from pipeline.models.filters import lag_signal
from pipeline.models.parameter import WARTHOG_LAGS, Conditions, Quantity
from pipeline.run.signals import RunContext, Wheels

TIME_CONSTANT = Parameter(
    "tau",
    "s",
    (0.0, 10.0),
    0.0,
    "time constant",
    0.5,
    starts=(0.1, 0.3, 0.7, 1.4),
    step=5e-3,
    plausible=Plausible(0.0, 3.0, "as of a drive lag"),
)
"""Time constant of a generic first-order system; `replace` adds what is specific to an effect."""


class DriveLag(DriveEffect):
    """Drive lag: wheels follow the commanded speed like a first-order system."""

    id = "drive_lag"
    rank = 20
    parameters = (
        replace(
            TIME_CONSTANT,
            least=Least(0.015, Least.STAMPS, sampled=1.0),
            plausible=Plausible(0.0, 3.0, "wider than the 0.55 to 1.2 s of Husky and Warthog"),
            between_runs=Spread(0.125, WARTHOG_LAGS),
            quantities=(Quantity.SPEED_LAG, Quantity.TURN_LAG),
        ),
    )
    motion = "Lag of the drive: the wheels follow commands with a time constant of {tau:.2f} s"
    clause = "follows commands with a time constant of {tau:.2g} s"
    needs = (Excitation.CHANGES,)
    confused_with = ("transport_delay", "turn_lag", "acceleration_limit")
    equivalent_to = ("body_inertia",)
    equivalent_when = "if the run never turns, or only turns on the spot"
    same_in_one_motion = ("turn_lag",)
    python_state = ("lag_left", "lag_right", "lag_sideways")
    python = """
        keep = math.exp(-step_s / {tau}) if {tau} > 0.0 else 0.0
        lag_left = left + (lag_left - left) * keep
        lag_right = right + (lag_right - right) * keep
        lag_sideways = sideways + (lag_sideways - sideways) * keep
        left, right, sideways = lag_left, lag_right, lag_sideways"""

    def drive_wheels(self, wheels: Wheels, context: RunContext) -> Wheels:
        """See the formula above."""
        tau, resets, step = self.values["tau"], context.wheels, context.step_s
        sideways = wheels.sideways
        if sideways is not None:
            sideways = lag_signal(sideways, tau, step, resets, resets.start[:, 2])
        return replace(
            wheels,
            left=lag_signal(wheels.left, tau, step, resets, resets.start[:, 0]),
            right=lag_signal(wheels.right, tau, step, resets, resets.start[:, 1]),
            sideways=sideways,
        )

    def is_equivalent(self, conditions: Conditions) -> bool:
        """Encoders distinguish wheel from body; without them driving and turning in one run are needed."""
        return not (conditions.encoders or conditions.largest.moves_both_ways)


class TwoLags(DriveEffect):
    """A drive lag with two time constants; if they are equal, it is a drive lag.

    Attributes:
        apart: smallest difference of the time constants, as a share of the slower one.
        least_apart_s: smallest difference of the time constants [s].
    """

    apart: ClassVar[float]
    least_apart_s: ClassVar[float]
    contains = ("drive_lag",)

    @property
    def taus(self) -> tuple[float, float]:
        """Both time constants [s], in the order of the parameters."""
        one, other = self.values.values()
        return one, other

    def is_degenerate(self, conditions: Conditions) -> bool:
        """Whether the time constants are equal: it is a drive lag."""
        one, other = self.taus
        least = max(conditions.least_delay_s, self.least_apart_s)
        return abs(one - other) <= max(self.apart * max(one, other), least)

    def collapse(self) -> Effect | None:
        """A drive lag with the mean time constant."""
        return DriveLag().change_within(tau=0.5 * sum(self.taus))


def time_constant(name: str, about: str, typical: float, starts: tuple[float, ...]) -> Parameter:
    """One of the time constants of `TwoLags`."""
    return replace(TIME_CONSTANT, name=name, about=about, typical=typical, starts=starts)
