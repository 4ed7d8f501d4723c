"""Gain drift: the wheels' share of their commanded speed fades over a run, as with a falling battery.

T is the length of the run without standing at its ends, t the time since it begins to drive. k is a plain
number, about 10 % a run. A speed controller without integral part lets it through. Only encoders tell it from
a fading motion of the body.

Source: drift of an actuator's gain, a loss of effectiveness; Zhang and Jiang, Annual Reviews in Control 2008.
"""

from pipeline.models.effects.time_drift import FADE
from pipeline.models.families import WHEELED, Excitation, declare, has_encoders

GainDrift = declare(
    "gain_drift",
    __doc__,
    "Omega = (1 - k * t / T) * u",
    FADE,
    kinds=WHEELED,
    needs=(Excitation.LONG,),
    can_show=has_encoders,
)
