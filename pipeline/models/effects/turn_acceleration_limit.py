"""Turn acceleration limit: a velocity smoother limits the rate of change of the commanded yaw rate.

f_w = r (Omega_r - Omega_l) / b. limit [rad/s^2], 1 to 4 of the usual smoothers, of the yaw rate that the
wheels would give without skidding. Command large steps of the turn while driving: on the spot it is an
acceleration limit of the wheels.

Source: velocity smoothers of Nav2 and limits of a ros2_control diff_drive_controller, angular.z.
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

TurnAccelerationLimit = declare(
    "turn_acceleration_limit",
    __doc__,
    "abs(df_w/dt) <= limit",
    Parameter(
        "limit",
        "rad/s^2",
        (0.02, 100.0),
        INF,
        "largest yaw acceleration",
        2.0,
        starts=(0.8, 2.0, 5.0),
        step=1e-2,
        quantities=(Quantity.TURN_ACCELERATION_LIMIT,),
        level=Level.VEHICLE,
    ),
    rank=3,
    kinds=SIDES,
    needs=(Excitation.CHANGES, Excitation.LARGE, Excitation.TURNING),
    is_degenerate=is_short("turn"),
    list_usual=take_largest("turn"),
)
