"""Side gain: one side reaches a larger share of its commanded speed than the other.

left and right are the speeds of the sides. e is a plain number. Drive straight forward and backward. Only
encoders tell it from wheels of unequal size.

Source: unequal motors under a proportional speed controller; Borenstein and Feng, IEEE T-RA 1996 (UMBmark).
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, declare, has_encoders

SideGain = declare(
    "side_gain",
    __doc__,
    ("left = (1 - e / 2) * left\nright = (1 + e / 2) * right"),
    Parameter(
        "e",
        "1",
        (-1.5, 1.5),
        0.0,
        "right minus left gain over their mean",
        0.05,
        least=Least(0.005, Least.DATA_SHEET),
        plausible=Plausible(-0.3, 0.3, "a larger difference is a fault of one motor"),
        of_sides=True,
    ),
    rank=1,
    kinds=("differential", "mecanum"),
    needs=(Excitation.BOTH_SIGNS, Excitation.SPEED_SPREAD),
    can_show=has_encoders,
)
