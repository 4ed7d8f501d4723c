"""What a run comes to: medians, root mean squares, the split into drivetrain and ground."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS

SUBSETS = ("all", "transitory", "steady")


class Aggregates(Table):
    """One row an input and subset of the samples."""

    VERSION: ClassVar[int] = 2

    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    subset = dy.Enum(SUBSETS, metadata={"description": "all samples, or only transitory or steady ones"})
    samples = dy.Int64(min=0, metadata={"description": "time steps counted"})
    windows = dy.Int64(min=0, metadata={"description": "2 s windows counted"})
    median_modulus = fields.number("m/s", "median slip modulus", nullable=True)
    median_residual_modulus = fields.number(
        "m/s", "median modulus of what is left of the model given with --model", nullable=True
    )
    median_window_norm = fields.number("m/s", "median 2 s window norm", nullable=True)
    rms_x = fields.number("m/s", "root mean square of g_x", nullable=True)
    rms_y = fields.number("m/s", "root mean square of g_y", nullable=True)
    rms_w = fields.number("rad/s", "root mean square of g_w", nullable=True)
    mean_square = fields.number("m^2/s^2", "mean square of the modulus", nullable=True)
    drivetrain_mean_square = fields.number("m^2/s^2", "of f(command) - f(measured wheels)", nullable=True)
    ground_mean_square = fields.number("m^2/s^2", "of f(measured wheels) - v", nullable=True)
    cross_mean_square = fields.number("m^2/s^2", "twice the mean product of the two parts", nullable=True)
    distance = fields.number("m", "distance driven", nullable=True)
    duration = fields.number("s", "time covered by the samples", nullable=True)
    height_rate = fields.number("m/s", "height variation per second", nullable=True)
    largest_kinetic_energy = fields.number("J", "largest 1/2 m v^2; null without a mass", nullable=True)
    length_scale = fields.number("m", "L that turns yaw rate into speed in the modulus")
