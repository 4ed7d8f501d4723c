"""Brake lag: wheels speed up with one time constant and slow down with another.

    tau * dOmega/dt = u - Omega, each wheel:  tau = tau_brake where Omega is slowed down, else tau_drive

tau_drive, tau_brake [s]. A motor against a load speeds up slowly and is braked by it; one that coasts slows
down slowly. What turns over is braked until it stands. Ask for steps up and down, of several heights.

Source: hybrid speed response of a motor with a one-quadrant drive; Isermann, Mechatronic Systems, chapter 6.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.models.effect import WHEELED, DriveEffect, Excitation, Parameter, Plausible, Search
from pipeline.models.effects.drive_lag import DriveLag
from pipeline.models.filters import lag_unevenly

if TYPE_CHECKING:
    from pipeline.models.effect import Effect
    from pipeline.models.evidence import Evidence
    from pipeline.runs.signals import RunContext, Wheels
    from pipeline.vehicles import Vehicle

_PLAUSIBLE = Plausible(0.0, 3.0, "as of a drive lag")
# Closer together, as a share of the slower one or in seconds, both time constants are one.
_APART = 0.2
_LEAST_APART_S = 0.04


class BrakeLag(DriveEffect):
    """Brake lag: wheels speed up with one time constant and slow down with another."""

    id = "brake_lag"
    rank = 25
    kinds = WHEELED
    parameters = (
        Parameter(
            "tau_drive",
            "s",
            (0.0, 10.0),
            0.0,
            "time constant of speeding up",
            0.6,
            search=Search.STARTS,
            starts=(0.5,),
            step=5e-3,
            plausible=_PLAUSIBLE,
        ),
        Parameter(
            "tau_brake",
            "s",
            (0.0, 10.0),
            0.0,
            "time constant of slowing down",
            0.2,
            search=Search.STARTS,
            starts=(0.2,),
            step=5e-3,
            plausible=_PLAUSIBLE,
        ),
    )
    needs = (Excitation.CHANGES,)
    confused_with = ("drive_lag", "turn_lag", "acceleration_limit")
    contains = ("drive_lag",)
    # Where ground disturbs the wheels a second time constant always helps a little.
    price = 0.1
    python_state = ("braked",)
    python = """
        wheels, braked = split(left, right, sideways), braked or [0.0] * 4
        slows = [was * wheel < 0.0 or abs(wheel) < abs(was) for was, wheel in zip(braked, wheels)]
        keeps = [math.exp(-step_s / tau) if tau > 0.0 else 0.0 for tau in ({tau_drive}, {tau_brake})]
        braked = [wheel + (was - wheel) * keeps[slow] for was, wheel, slow in zip(braked, wheels, slows)]
        left, right, sideways = join(braked)"""

    def describe_motion(self, vehicle: Vehicle) -> str:
        """The effect as what the vehicle does."""
        del vehicle
        up, down = self.values["tau_drive"], self.values["tau_brake"]
        return f"speeds its wheels up {up:.2f} s late, and slows them down {down:.2f} s late"

    def drive_wheels(self, wheels: Wheels, around: RunContext) -> Wheels:
        """See the formula above."""
        if self.is_neutral:
            return wheels
        taus, resets = (self.values["tau_drive"], self.values["tau_brake"]), around.wheels
        return wheels.change_each_wheel(
            lambda speed, start: lag_unevenly(speed, taus, around.step_s, resets, start), resets.start
        )

    def is_degenerate(self, evidence: Evidence) -> bool:
        """With equal time constants it is a drive lag."""
        up, down = self.values["tau_drive"], self.values["tau_brake"]
        least = max(evidence.least_delay_s, _LEAST_APART_S)
        return abs(up - down) <= max(_APART * max(up, down), least)

    def collapse(self) -> Effect | None:
        """A drive lag of the mean time constant."""
        return DriveLag(tau=0.5 * (self.values["tau_drive"] + self.values["tau_brake"]))
