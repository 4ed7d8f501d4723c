"""Slope slip: uphill the wheels lose a share of their travel, downhill they gain it.

pitch > 0 is nose down. k [1], 0.5 to 1.5 on loose ground: the slip ratio over the slope. Drive up and down a
slope at several speeds.

Source: Seegmiller and Kelly, RSS 2014: slip in proportion to the components of gravity and to the speed.
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare

SlopeSlip = declare(
    "slope_slip",
    __doc__,
    "v_x += k * sin(pitch) * abs(v0)",
    Parameter(
        "k",
        "1",
        (-3.0, 3.0),
        0.0,
        "share of the travel that is lost, over the sine of the slope",
        1.0,
        plausible=Plausible(-0.1, 2.5, "a slope of 20 degrees then takes at most 86 % of the travel"),
        one_sign=True,
    ),
    needs=(Excitation.SLOPE, Excitation.SPEED_SPREAD),
)
