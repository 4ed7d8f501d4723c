"""What was asked of the drive."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

if TYPE_CHECKING:
    import polars as pl


class Commands(Table):
    """One row a command message, held until the next one or until it is stale."""

    VERSION: ClassVar[int] = 3

    t = fields.seconds()
    stamp = fields.stamp()
    log_time = fields.log_time()
    left = fields.optional("rad/s", "commanded speed of the left wheels")
    right = fields.optional("rad/s", "commanded speed of the right wheels")
    speed = fields.body("m/s", "commanded speed (Ackermann)", nullable=True)
    steering = fields.body("rad", "commanded steering angle (Ackermann), left positive", nullable=True)
    sideways = fields.optional(
        "rad/s", "commanded speed of the wheels that moves to the left (mecanum, omni)"
    )
    body_x = fields.body("m/s", "commanded forward speed where the command is a Twist", nullable=True)
    body_y = fields.body(
        "m/s", "commanded speed to the left where the command is a Twist (mecanum, omni)", nullable=True
    )
    body_w = fields.body("rad/s", "commanded yaw rate where the command is a Twist", nullable=True)
    left_aligned = fields.optional("rad/s", "speed of the left wheels after corrections")
    right_aligned = fields.optional("rad/s", "speed of the right wheels after corrections")
    sideways_aligned = fields.optional(
        "rad/s", "speed of the wheels that moves to the left after corrections"
    )
    speed_aligned = fields.body("m/s", "speed after corrections (Ackermann)", nullable=True)
    active = fields.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return fields.drive_is_complete()
