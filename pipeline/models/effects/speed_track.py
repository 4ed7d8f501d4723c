"""Track at speed: the effective track of a skid-steered vehicle changes with its speed.

k [s/m], 0.035 to 0.053 on a Warthog on fast asphalt: the effective track is narrower at speed. w0 is the yaw
rate that the track leaves. Turn both ways, on the spot and at several speeds.

Source: Pentzer, Brennan and Reichard, Journal of Field Robotics 31 (2014): instantaneous centres of rotation
that move with speed.
"""

from pipeline.models.families import SIDES, Excitation, Least, Parameter, Plausible, declare

SpeedTrack = declare(
    "speed_track",
    __doc__,
    "v_w += k * abs(v0) * w0",
    Parameter(
        "k",
        "s/m",
        (-1.0, 1.0),
        0.0,
        "share of turning gained per speed",
        0.05,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(-0.3, 0.3, "wider than the 0.035 to 0.053 of a Warthog on asphalt"),
    ),
    kinds=SIDES,
    needs=(Excitation.TURNING, Excitation.SPEED_SPREAD),
)
