"""Brake lag: wheels speed up with one time constant and slow down with another.

tau_drive, tau_brake [s]. A motor against a load speeds up slowly and is braked by it; one that coasts slows
down slowly. What turns over is braked until it stands. Command steps up and down, of several heights.

Source: hybrid speed response of a motor with a one-quadrant drive; Isermann, Mechatronic Systems, chapter 6.
"""

from collections.abc import Mapping

from pipeline.models.effects.drive_lag import are_equal, time_constant, to_one_lag
from pipeline.models.families import WHEELED, Excitation, Floats, Resets, declare
from pipeline.models.filters import lag_unevenly


def _walk(
    values: Mapping[str, float], signal: Floats, step_s: float, resets: Resets, start: Floats
) -> Floats:
    return lag_unevenly(signal, (values["tau_drive"], values["tau_brake"]), step_s, resets, start)


BrakeLag = declare(
    "brake_lag",
    __doc__,
    "tau * dOmega/dt = u - Omega, each wheel: tau = tau_brake where Omega is slowed down, else tau_drive",
    time_constant("tau_drive", "time constant while speeding up", 0.6, (0.5,)),
    time_constant("tau_brake", "time constant while slowing down", 0.2, (0.2,)),
    rank=25,
    kinds=WHEELED,
    needs=(Excitation.CHANGES,),
    walk=_walk,
    is_degenerate=are_equal(0.2, 0.04),
    collapse=to_one_lag,
)
