"""Time drift: speed and turning fade over a run, as with a falling battery or heating motors.

T is the length of the run without standing at its ends, t the time since it begins to drive. k is a plain
number, about 10 % a run.

Source: first-order drift of a gain; measured on long deployments.
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, declare

FADE = Parameter(
    "k",
    "1",
    (-0.9, 0.9),
    0.0,
    "share lost at the end of the run",
    0.1,
    least=Least(0.015, Least.DATA_SHEET),
    plausible=Plausible(-0.4, 0.4, "wider than the 10 % of long deployments"),
)

TimeDrift = declare(
    "time_drift",
    __doc__,
    ("v0 = (1 - k * t / T) * v0\ns0 = (1 - k * t / T) * s0\nw0 = (1 - k * t / T) * w0"),
    FADE,
    rank=50,
    needs=(Excitation.LONG,),
)
