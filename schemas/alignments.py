"""How the clocks, scales and signs of a recording were put right, once for everyone who reads the run."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Alignments(Table):
    """One row a run."""

    VERSION: ClassVar[int] = 2

    hold_time = fields.optional("s", "the controller stops this long after its last command")
    command_scale = fields.number("1", "by which the recorded command was multiplied")
    track_multiplier = fields.number(
        "1", "by which the controller multiplies the track width when it turns a body command into wheels"
    )
    gyro_scale = fields.optional(
        "1", "yaw rate over the gyro's, negative where it turns the other way; null without a good gyro"
    )
    gyro_bias = fields.optional("rad/s", "yaw rate of the vehicle where the scaled gyro says zero")
    heading_delay = fields.optional(
        "s", "how late the reported heading was against the gyro: part of every latency of the poses"
    )
    heading_delay_error = fields.optional("s", "standard error of that delay")
    wheel_delay = fields.number("s", "how late the encoders were against the gyro: the latency of the wheels")
    gyro_residual = fields.optional("1", "turning that the gyro leaves, as a share of it")
    latency_spread = fields.number("s", "standard deviation of the latencies that were taken off the poses")
    outlier_time = fields.number("s", "time in which the localization goes where the wheels did not")
    recorded_modulus_command = fields.optional(
        "m/s", "median slip modulus (L = 1 m) on command as recorded, before anything was put right"
    )
    recorded_modulus_measured = fields.optional("m/s", "the same on measured wheels")
