"""Lateral pull: the vehicle moves sideways by a constant share of its way ahead.

v_x is the forward velocity of the model. c is a plain number: rollers or modules out of line. A misaligned
sensor turns motion to the side into motion ahead as well, this does not. Drive straight forward and backward,
and to both sides.

Source: steered modules out of line, as yaw_pull.
"""

from pipeline.models.families import Excitation, Least, Parameter, Plausible, declare

LateralPull = declare(
    "lateral_pull",
    __doc__,
    "v_y += c * v_x",
    Parameter(
        "c",
        "1",
        (-2.0, 2.0),
        0.0,
        "way to the left over way ahead",
        0.05,
        least=Least(0.003, Least.MOUNTING),
        plausible=Plausible(-0.35, 0.35, "as of a yaw misalignment"),
    ),
    rank=21,
    kinds=("mecanum", "omni"),
    needs=(Excitation.BOTH_SIGNS,),
)
