"""Turning resistance: a skid-steered vehicle loses forward speed while it turns.

k [s], about 0.24 on a Husky in snow. Drive the same speed straight and in turns of both signs.

Source: DRIVE, Baril et al. 2024, learned slip terms; its other form is k sign(v0) abs(w0).
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare

TurningResistance = declare(
    "turning_resistance",
    __doc__,
    "v_x += -k * v0 * abs(w0)",
    Parameter(
        "k",
        "s",
        (-1.0, 1.0),
        0.0,
        "share of speed lost per yaw rate",
        0.24,
        plausible=Plausible(-0.05, 0.6, "wider than the 0.24 of a Husky in snow"),
        one_sign=True,
    ),
    needs=(Excitation.TURNING, Excitation.SPEED_SPREAD),
)
