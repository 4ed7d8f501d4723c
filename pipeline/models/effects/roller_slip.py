"""Roller slip: the faster the vehicle drives sideways, the larger the share of that motion its rollers lose.

s0 is the speed to the left. k [s/m]: 0.3 loses 15 % at 0.5 m/s. Drive sideways at several speeds, both ways,
to tell it from a scale that is the same at every speed.

Source: slip growing with traction; see Wong, Theory of Ground Vehicles, chapter 2.
"""

from pipeline.models.families import SIDEWAYS, Excitation, Parameter, Plausible, declare

RollerSlip = declare(
    "roller_slip",
    __doc__,
    "v_y += -k * s0 * abs(s0)",
    Parameter(
        "k",
        "s/m",
        (-2.0, 2.0),
        0.0,
        "share of sideways speed lost per sideways speed",
        0.3,
        plausible=Plausible(-0.05, 1.5, "wider than losing half of one metre a second"),
        one_sign=True,
    ),
    kinds=SIDEWAYS,
    needs=(Excitation.SIDEWAYS, Excitation.SPEED_SPREAD),
)
