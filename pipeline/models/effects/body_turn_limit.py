"""Body turn limit: the controller clips the commanded yaw rate before it reaches the wheels.

f_w is the commanded yaw rate, kept within +-limit. limit [rad/s], 1 on a Husky, 4 to 5 on a Warthog. On a
car the steering angle is held to what gives that yaw rate at the commanded speed. A limit that no command
reaches is only bounded from below.

Source: velocity limits of a ros2_control diff_drive_controller; measured on the DRIVE recordings.
"""

from pipeline.models.effects.turn_droop import TurnDroop
from pipeline.models.families import (
    INF,
    Effect,
    Excitation,
    Largest,
    Level,
    Parameter,
    Place,
    Quantity,
    declare,
    never_reached,
)


def _list_softer(effect: Effect, largest: Largest) -> tuple[Effect, ...]:
    """A droop with a typical gain, for runs with only one turn command above the limit."""
    return (TurnDroop().make_usual(largest).fix("gain"),)


BodyTurnLimit = declare(
    "body_turn_limit",
    __doc__,
    {"": "f_w = clip(f_w, limit)", "ackermann": "delta = clip(delta, atan2(limit * l, abs(f_x)))"},
    Parameter(
        "limit",
        "rad/s",
        (0.01, 50.0),
        INF,
        "largest commanded yaw rate",
        0.6,
        starts=(0.3, 0.5, 0.7, 0.85, 0.95),
        relative_to="turn",
        step=1e-3,
        quantities=(Quantity.TURN_LIMIT,),
        level=Level.VEHICLE,
    ),
    rank=20,
    needs=(Excitation.LARGE, Excitation.TURNING),
    place=Place.COMMAND,
    is_degenerate=never_reached,
    list_softer=_list_softer,
)
