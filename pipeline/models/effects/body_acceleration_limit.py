"""Body acceleration limit: a velocity smoother limits the rate of change of the commanded speed.

f_x = r (Omega_r + Omega_l) / 2. limit [m/s^2], 0.5 to 2.5 of the usual smoothers. Command large steps of
speed while turning: straight ahead it is an acceleration limit of the wheels.

Source: velocity smoothers of Nav2 and limits of a ros2_control diff_drive_controller, linear.x.
"""

from pipeline.models.families import (
    INF,
    SIDES,
    Excitation,
    Level,
    Parameter,
    Quantity,
    declare,
    is_short,
    take_largest,
)

BodyAccelerationLimit = declare(
    "body_acceleration_limit",
    __doc__,
    "abs(df_x/dt) <= limit",
    Parameter(
        "limit",
        "m/s^2",
        (0.02, 50.0),
        INF,
        "largest forward acceleration",
        1.0,
        starts=(0.4, 1.0, 2.5),
        step=1e-2,
        quantities=(Quantity.ACCELERATION_LIMIT,),
        level=Level.VEHICLE,
    ),
    rank=2,
    kinds=SIDES,
    needs=(Excitation.CHANGES, Excitation.LARGE),
    is_degenerate=is_short("speed"),
    list_usual=take_largest("speed"),
)
