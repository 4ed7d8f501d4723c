"""Side lag: one side follows its commands more slowly than the other, as with a weak motor.

left and right are the speeds of the sides. tau_left, tau_right [s]. Every change of speed turns the vehicle
towards the weak side for a moment, and back. Change speed often, straight ahead too.

Source: loss of effectiveness of one actuator; Blanke et al., Diagnosis and Fault-Tolerant Control, chapter
3.
"""

from pipeline.models.effects.drive_lag import are_equal, time_constant, to_one_lag
from pipeline.models.families import Excitation, declare

SideLag = declare(
    "side_lag",
    __doc__,
    ("tau_left * dleft/dt = u - left\ntau_right * dright/dt = u - right"),
    time_constant("tau_left", "time constant of the left side", 0.5, (0.4,)),
    time_constant("tau_right", "time constant of the right side", 0.2, (0.4,)),
    rank=35,
    kinds=("differential",),
    needs=(Excitation.CHANGES,),
    is_degenerate=are_equal(0.15, 0.03),
    collapse=to_one_lag,
)
