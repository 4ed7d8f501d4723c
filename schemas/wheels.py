"""What the encoders measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

if TYPE_CHECKING:
    import polars as pl


class Wheels(Table):
    """One row an encoder message."""

    VERSION: ClassVar[int] = 3

    t = fields.seconds()
    stamp = fields.stamp()
    log_time = fields.log_time()
    left = fields.optional("rad/s", "measured speed of the left wheels, mean of the side")
    right = fields.optional("rad/s", "measured speed of the right wheels, mean of the side")
    speed = fields.body("m/s", "measured speed (Ackermann)", nullable=True)
    steering = fields.body("rad", "measured steering angle (Ackermann), left positive", nullable=True)
    sideways = fields.optional("rad/s", "measured speed of the wheels that moves to the left (mecanum, omni)")
    latency = fields.number("s", "how late the encoders are: they speak of t - latency", frame="log clock")
    active = fields.flag("inside an interval in which commands are live")

    @dy.rule()
    def drive_is_complete(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        return fields.drive_is_complete()
