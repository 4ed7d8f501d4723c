"""Drive gain: all wheels reach a constant share of their commanded speed.

g is a plain number: 1 with an integral part in the speed controller, below it without. Drive at several
steady speeds. Only encoders tell it from the wheel radius; a speed that no command exceeds is a limit.
Gains come first in the drive: ramps and limits behind them are those of the measured wheels.

Source: steady state of a proportional speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, declare, has_timed_encoders

SHARE = Parameter(
    "g",
    "1",
    (0.05, 3.0),
    1.0,
    "actual over commanded wheel speed",
    0.9,
    least=Least(0.01, Least.DATA_SHEET),
    plausible=Plausible(
        0.2, 1.3, "a controller without integral part reaches less, a wrong scale is a finding"
    ),
)

DriveGain = declare(
    "drive_gain",
    __doc__,
    "Omega = g * u",
    SHARE,
    scale_role="gain",
    needs=(Excitation.SPEED_SPREAD,),
    can_show=has_timed_encoders,
)
