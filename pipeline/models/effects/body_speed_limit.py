"""Body speed limit: the controller clips the commanded forward speed before it reaches the wheels.

f_x is the commanded speed, kept within +-limit. limit [m/s], 1 on a Husky, 5 on a Warthog. A limit that no
command reaches is only bounded from below.

Source: velocity limits of a ros2_control diff_drive_controller; measured on the DRIVE recordings.
"""

from pipeline.models.families import INF, Excitation, Parameter, Place, Quantity, declare, never_reached

BodySpeedLimit = declare(
    "body_speed_limit",
    __doc__,
    "f_x = clip(f_x, limit)",
    Parameter(
        "limit",
        "m/s",
        (0.01, 50.0),
        INF,
        "largest commanded speed",
        0.7,
        starts=(0.3, 0.5, 0.7, 0.85, 0.95),
        relative_to="speed",
        step=1e-3,
        quantities=(Quantity.SPEED_LIMIT,),
    ),
    rank=10,
    needs=(Excitation.LARGE, Excitation.SPEED_SPREAD),
    place=Place.COMMAND,
    is_degenerate=never_reached,
)
