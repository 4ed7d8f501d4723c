"""Lever arm: the reported pose is that of a point beside the axis of rotation.

v_w is the yaw rate of the model. l_x, l_y [m], 0 to 0.3: poses of a sensor or antenna that no transform moves
to base_link, a wrong transform, a base_link that is not between the driven wheels, or a load that moves the
axis. Check the transform first.

Source: rigid body motion of a point; see any text on mechanics.
"""

from pipeline.models.families import Excitation, Parameter, Part, Place, declare

LeverArm = declare(
    "lever_arm",
    __doc__,
    ("v_x += -l_y * v_w\nv_y += l_x * v_w"),
    Parameter("l_x", "m", (-10.0, 10.0), 0.0, "localized point ahead of the axis of rotation", 0.2),
    Parameter("l_y", "m", (-10.0, 10.0), 0.0, "localized point left of the axis of rotation", 0.08),
    rank=10,
    needs=(Excitation.TURNING,),
    parts=(Part("l_x", "icr_offset", "x_icr", -1.0), Part("l_y", "icr_lateral", "y_icr", -1.0)),
    place=Place.LOCALIZATION,
)
