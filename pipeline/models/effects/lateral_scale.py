"""Lateral scale: rollers lose a constant share of the sideways motion.

s0 is the speed to the left. k is a plain number: 1 for ideal rollers, less where they turn against friction
and slip along their axes; 0.88 is a "lateral multiplier" of 1.14 of competition robots. Drive sideways both
ways.

Source: Diegel, Badve, Bright, Potgieter and Tlale, ACRA 2002 (losses of mecanum wheels driving sideways).
"""

from pipeline.models.families import SIDEWAYS, Excitation, Least, Parameter, Plausible, declare

LateralScale = declare(
    "lateral_scale",
    __doc__,
    "s0 = k * s0",
    Parameter(
        "k",
        "1",
        (0.0, 2.0),
        1.0,
        "sideways speed over that of ideal rollers",
        0.8,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(0.3, 1.2, "wider than the lateral multipliers of 1 to 2 of competition robots"),
    ),
    rank=25,
    kinds=SIDEWAYS,
    needs=(Excitation.SIDEWAYS,),
)
