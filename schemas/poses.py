"""Where the localization says the vehicle was."""

from typing import ClassVar

import dataframely as dy
import polars as pl

from schemas import fields
from schemas.contract import Table

UNIT_TOLERANCE = 1e-6


class Poses(Table):
    """One row a pose message of base_link in a fixed frame."""

    VERSION: ClassVar[int] = 2

    t = fields.seconds()
    stamp = fields.stamp()
    log_time = fields.log_time()
    segment = fields.segment()
    x, y, z = fields.vector("m", "position of base_link", "map")
    q_x, q_y, q_z, q_w = fields.vector("1", "quaternion of base_link", "map", 4)
    latency = fields.number(
        "s", "how late this pose is against the gyro: it belongs to t - latency", frame="log clock"
    )
    outlier = fields.flag("the localization is at fault here: left out of medians and of comparisons")
    held = fields.flag("repeats the pose before it: an old estimate sampled again")
    active = fields.flag("inside an interval in which commands are live")

    @dy.rule()
    def quaternion_has_unit_length(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        squared = sum((pl.col(name) ** 2 for name in ("q_x", "q_y", "q_z", "q_w")), pl.lit(0.0))
        return (squared - 1.0).abs() < UNIT_TOLERANCE
