"""Speed slip: the faster the wheels turn, the larger the share of their motion that is lost.

k [s/m], about 0.08 on loose ground. Drive at several speeds, forward and backward.

Source: longitudinal slip growing with traction; see Wong, Theory of Ground Vehicles, chapter 2.
"""

from pipeline.models.families import Excitation, Parameter, Plausible, declare

SpeedSlip = declare(
    "speed_slip",
    __doc__,
    "v_x += -k * v0 * abs(v0)",
    Parameter(
        "k",
        "s/m",
        (-0.5, 0.5),
        0.0,
        "share of speed lost per speed",
        0.08,
        plausible=Plausible(-0.02, 0.4, "wider than the 0.08 of loose ground"),
        one_sign=True,
    ),
    needs=(Excitation.SPEED_SPREAD,),
)
