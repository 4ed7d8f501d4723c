"""Wheel asymmetry: the wheels of one side are larger than those of the other.

e is a plain number, 1 to 5 %; 8 % with one soft side. Drive straight forward and backward.

Source: unequal wheel diameters; Borenstein and Feng, IEEE T-RA 1996 (UMBmark).
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, Quantity, Spread, declare

WheelAsymmetry = declare(
    "wheel_asymmetry",
    __doc__,
    ("v0 = v0 + e * b / 4 * w0\nw0 = w0 + e / b * v0"),
    Parameter(
        "e",
        "1",
        (-1.5, 1.5),
        0.0,
        "right minus left radius over their mean",
        0.04,
        least=Least(0.003, Least.DATA_SHEET),
        plausible=Plausible(-0.2, 0.2, "wider than the 8 % of one soft side"),
        quantities=(Quantity.RADIUS_DIFFERENCE,),
        between_runs=Spread(0.016),
        of_sides=True,
    ),
    rank=10,
    kinds=("differential", "mecanum"),
    needs=(Excitation.BOTH_SIGNS, Excitation.SPEED_SPREAD),
)
