"""Pull: the vehicle turns by a constant angle per metre ahead.

v_x is the forward velocity of the model. c [rad/m], 0.02 to 0.3: modules out of line, wheels or rollers of
unequal size, a load on one side. Drive straight forward and backward; turning at a constant rate is a drift.

Source: unequal wheel diameters (Borenstein and Feng, IEEE T-RA 1996, UMBmark), for bases without sides.
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, declare

YawPull = declare(
    "yaw_pull",
    __doc__,
    "v_w += c * v_x",
    Parameter(
        "c",
        "rad/m",
        (-3.0, 3.0),
        0.0,
        "turning to the left per metre ahead",
        0.1,
        least=Least(0.003, Least.MOUNTING),
        plausible=Plausible(-0.5, 0.5, "a curve of 2 m radius where a straight line is commanded"),
    ),
    rank=10,
    kinds=("mecanum", "omni"),
    needs=(Excitation.BOTH_SIGNS, Excitation.SPEED_SPREAD),
)
