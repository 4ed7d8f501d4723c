"""Motor imbalance: the motor of one side is weaker than that of the other, as with less voltage.

The largest force at rest of wheel_servo is bound (1 - e_m/2) on the left and bound (1 + e_m/2) on the right.
e is the voltage of the right motor minus that of the left one, over their mean: the force of a DC motor at
rest and its speed without load grow with the voltage. The weaker side is slower where the force is the
largest one, above all as the outer side of a turn on ground of high friction: turns to one side are slower
than to the other. Drive at large speeds and turn quickly both ways.

Source: DC motors of Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic Systems, chapter 2;
measured on five of nine recordings of a Warthog, whose left motor is weaker by 8 to 15 %.
"""

from pipeline.models.families import Excitation, Least, Level, Parameter, Plausible, declare, has_encoders

MotorImbalance = declare(
    "motor_imbalance",
    __doc__,
    "e_m = e",
    Parameter(
        "e",
        "1",
        (-1.0, 1.0),
        0.0,
        "right minus left voltage over their mean",
        0.1,
        least=Least(0.01, Least.DATA_SHEET),
        plausible=Plausible(-0.5, 0.5, "a larger difference is a fault of one motor"),
        level=Level.VEHICLE,
        of_sides=True,
    ),
    rank=30,
    kinds=("differential",),
    needs=(Excitation.BOTH_SIGNS, Excitation.LARGE),
    can_show=has_encoders,
)
