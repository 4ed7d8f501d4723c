"""Difference gain: the difference of the wheel speeds is a constant share of its command.

D = Omega_r - Omega_l. g is a plain number: below 1 where scrub holds back a controller without integral
part. Turn slowly and quickly. Only encoders tell it from the effective track; a share that falls with the
turn is a turn droop.

Source: steady state of a proportional speed controller; Astrom and Murray, Feedback Systems, chapter 10.
"""

from dataclasses import replace

from pipeline.models.effects.drive_gain import SHARE
from pipeline.models.families import SIDES, Excitation, declare, has_encoders

DifferenceGain = declare(
    "difference_gain",
    __doc__,
    "D = g * D",
    replace(SHARE, about="actual over commanded difference of the wheel speeds", typical=0.7),
    rank=1,
    kinds=SIDES,
    needs=(Excitation.TURNING,),
    can_show=has_encoders,
)
