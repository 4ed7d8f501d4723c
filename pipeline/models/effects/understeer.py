"""Understeer: the faster a car drives, the less it turns for the same steering.

w0 = v0 * tan(delta) / l without it. K [s^2/m], about 0.03. Take the same curve at several speeds.

Source: Gillespie, Fundamentals of Vehicle Dynamics, steady-state cornering.
"""

from pipeline.models.families import ACKERMANN, Excitation, Parameter, Plausible, declare

Understeer = declare(
    "understeer",
    __doc__,
    "w0 = w0 / max(1 + K / l * v0**2, 0.05)",
    Parameter(
        "K",
        "s^2/m",
        (-0.05, 1.0),
        0.0,
        "understeer gradient",
        0.03,
        plausible=Plausible(-0.02, 0.5, "wider than the 0.03 of a road car"),
    ),
    rank=40,
    kinds=ACKERMANN,
    needs=(Excitation.SPEED_SPREAD, Excitation.STEERING),
)
