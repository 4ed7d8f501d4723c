"""Load droop: under load every wheel turns slower than commanded by a constant speed.

clip(u, d / r) is the part of u within +-d / r, so that wheels stand for smaller commands. d [m/s] at the rim
is the force of rolling over the gain of the speed controller, so that a controller with an integral part
shows it for moments only; 0.01 to 0.03 on an indoor robot, more on softer ground, in proportion to the
current of its motors. Only encoders show it. Drive at several steady speeds: at one speed a gain or a limit
does the same.

Source: steady state of a proportional speed controller under load; Astrom and Murray, Feedback Systems,
chapter 10.
"""

from pipeline.models.families import (
    ANY,
    Excitation,
    Least,
    Parameter,
    Plausible,
    declare,
    has_timed_encoders,
)

LoadDroop = declare(
    "load_droop",
    __doc__,
    "Omega = u - clip(u, d / r)",
    Parameter(
        "d",
        "m/s",
        (0.0, 1.0),
        0.0,
        "rim speed lost at any command",
        0.03,
        step=2e-3,
        least=Least(0.005, Least.DATA_SHEET),
        plausible=Plausible(0.0, 0.5, "twenty times what an indoor robot loses on a carpet"),
    ),
    rank=12,
    kinds=ANY,
    needs=(Excitation.SPEED_SPREAD,),
    can_show=has_timed_encoders,
)
