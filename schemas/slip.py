"""How far the motion was from the ideal model, step by step."""

from typing import ClassVar

import dataframely as dy
import polars as pl

from schemas import fields
from schemas.contract import Table


class Slip(Table):
    """One row a time step and input: g = f(u) - v."""

    VERSION: ClassVar[int] = 2

    input = fields.source()
    t = fields.seconds()
    stamp = fields.stamp()
    segment = fields.segment()
    step = fields.step()
    transitory = fields.flag("within the transitory span after a change of command")
    f_x = fields.body("m/s", "ideal velocity forward")
    f_y = fields.body("m/s", "ideal velocity to the left")
    f_w = fields.body("rad/s", "ideal yaw rate")
    v_x = fields.body("m/s", "measured velocity forward")
    v_y = fields.body("m/s", "measured velocity to the left")
    v_w = fields.body("rad/s", "measured yaw rate")
    g_x = fields.body("m/s", "slip forward")
    g_y = fields.body("m/s", "slip to the left")
    g_w = fields.body("rad/s", "slip in yaw rate")
    modulus = dy.Float64(
        min=0.0,
        check=lambda value: value.is_finite(),
        metadata={"unit": "m/s", "frame": "base_link", "description": "norm of (g_x, g_y, L g_w)"},
    )

    model_x = fields.body("m/s", "velocity forward of the model given with --model", nullable=True)
    model_y = fields.body("m/s", "velocity to the left of that model", nullable=True)
    model_w = fields.body("rad/s", "yaw rate of that model", nullable=True)
    residual_modulus = fields.body(
        "m/s", "norm of (model_x - v_x, model_y - v_y, L (model_w - v_w))", nullable=True
    )
    suspect = fields.flag("in a stretch with a rotated heading or a frozen position; left out of medians")

    @dy.rule()
    def slip_is_ideal_minus_measured(cls) -> pl.Expr:  # noqa: N805 - dataframely rules receive the class
        wrong = [(pl.col(f"f_{c}") - pl.col(f"v_{c}") - pl.col(f"g_{c}")).abs() for c in "xyw"]
        return pl.sum_horizontal(wrong) < 1e-9  # noqa: PLR2004 - rounding of three differences
