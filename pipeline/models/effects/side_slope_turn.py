"""Side slope turn: across a slope the front swings downhill, in proportion to the speed.

roll > 0 is left side up; below zero the front swings uphill. k [rad/m]: 0.4 turns a vehicle by 4 degrees a
metre across a slope of 10 degrees. Drive across a slope both ways.

Source: Seegmiller and Kelly, RSS 2014: slip of the yaw rate in proportion to gravity's lateral component.
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare

SideSlopeTurn = declare(
    "side_slope_turn",
    __doc__,
    "v_w += -k * cos(pitch) * sin(roll) * v0",
    Parameter(
        "k",
        "rad/m",
        (-3.0, 3.0),
        0.0,
        "curvature of the path at a slope of 90 degrees (k sin(slope))",
        0.4,
        plausible=Plausible(-1.5, 1.5, "a curve of 4 m radius on a slope of 10 degrees"),
    ),
    needs=(Excitation.SLOPE,),
)
