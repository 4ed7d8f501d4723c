"""What a run comes to: medians, root mean squares, the split into drivetrain and ground."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table

SUBSETS = ("all", "transitory", "steady")


class Aggregates(Table):
    """One row an input and subset of the samples."""

    VERSION: ClassVar[int] = 2

    input = fields.source()
    subset = fields.choice(SUBSETS, "all samples, or only transitory or steady ones")
    samples = fields.count("time steps counted")
    windows = fields.count("2 s windows counted")
    median_modulus = fields.optional("m/s", "median slip modulus")
    median_residual_modulus = fields.optional(
        "m/s", "median modulus of what is left of the model given with --model"
    )
    median_window_norm = fields.optional("m/s", "median 2 s window norm")
    rms_x = fields.optional("m/s", "root mean square of g_x")
    rms_y = fields.optional("m/s", "root mean square of g_y")
    rms_w = fields.optional("rad/s", "root mean square of g_w")
    mean_square = fields.optional("m^2/s^2", "mean square of the modulus")
    drivetrain_mean_square = fields.optional("m^2/s^2", "of f(command) - f(measured wheels)")
    ground_mean_square = fields.optional("m^2/s^2", "of f(measured wheels) - v")
    cross_mean_square = fields.optional("m^2/s^2", "twice the mean product of the two parts")
    distance = fields.optional("m", "distance driven")
    duration = fields.optional("s", "time covered by the samples")
    height_rate = fields.optional("m/s", "height variation per second")
    largest_kinetic_energy = fields.optional("J", "largest 1/2 m v^2; null without a mass")
    length_scale = fields.number("m", "L that turns yaw rate into speed in the modulus")
