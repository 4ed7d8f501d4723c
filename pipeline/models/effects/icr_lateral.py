"""Lateral ICR offset: turning drags the vehicle forward or backward, as with a load on one side.

v_w is the yaw rate of the model. y_icr [m], positive to the left. Spin on the spot both ways.

Source: Mandow et al., IROS 2007, the lateral coordinates of the instantaneous centres of rotation.
"""

from pipeline.models.families import Excitation, Least, Parameter, Place, Plausible, declare

IcrLateral = declare(
    "icr_lateral",
    __doc__,
    "v_x += y_icr * v_w",
    Parameter(
        "y_icr",
        "m",
        (-10.0, 10.0),
        0.0,
        "centre of rotation left of base_link",
        0.08,
        least=Least(0.004, Least.MOUNTING),
        plausible=Plausible(-0.5, 0.5, "further out it lies beside the wheels of a Warthog"),
    ),
    needs=(Excitation.TURNING,),
    place=Place.CENTRE,
)
