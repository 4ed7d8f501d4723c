"""Slope creep: while its wheels turn, the vehicle creeps backward uphill and forward downhill.

pitch > 0 is nose down; turning is one while the wheels turn. c [m/s], 0.4 to 0.8, whatever the speed. Drive
up and down a slope at several speeds.

Source: Seegmiller and Kelly, RSS 2014, the gravity term of the slip model.
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare, has_no_encoders

SlopeCreep = declare(
    "slope_creep",
    __doc__,
    "v_x += c * sin(pitch) * turning",
    Parameter(
        "c",
        "m/s",
        (-3.0, 3.0),
        0.0,
        "downhill speed at a slope of 90 degrees (c sin(slope))",
        0.6,
        plausible=Plausible(-0.1, 2.5, "wider than the 0.4 to 0.8 m/s that were seen"),
        one_sign=True,
    ),
    needs=(Excitation.SLOPE, Excitation.SPEED_SPREAD),
    is_equivalent=has_no_encoders,
)
