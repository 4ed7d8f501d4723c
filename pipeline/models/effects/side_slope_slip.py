"""Side slope slip: across a slope the vehicle slides downhill, in proportion to its speed.

roll > 0 is left side up. k [1], 0.3 to 1 on loose ground: the angle of the slide over the slope. Drive across
a slope both ways at several speeds.

Source: Seegmiller and Kelly, RSS 2014: slip in proportion to the components of gravity and to the speed.
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare

SideSlopeSlip = declare(
    "side_slope_slip",
    __doc__,
    "v_y += -k * cos(pitch) * sin(roll) * abs(v0)",
    Parameter(
        "k",
        "1",
        (-3.0, 3.0),
        0.0,
        "sideways travel over forward travel, over the sine of the slope",
        0.6,
        plausible=Plausible(-0.1, 2.5, "a slope of 20 degrees then turns the course by 40 degrees"),
        one_sign=True,
    ),
    needs=(Excitation.SLOPE, Excitation.SPEED_SPREAD),
)
