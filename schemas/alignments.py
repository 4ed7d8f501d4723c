"""How the clocks, scales and signs of a recording were put right, once for everyone who reads the run."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Alignments(Table):
    """One row a run."""

    VERSION: ClassVar[int] = 2

    hold_time = fields.number("s", "the controller stops this long after its last command", nullable=True)
    command_scale = fields.number("1", "by which the recorded command was multiplied")
    track_multiplier = fields.number(
        "1", "by which the controller multiplies the track width when it turns a body command into wheels"
    )
    gyro_scale = fields.number(
        "1",
        "yaw rate over the gyro's, negative where it turns the other way; null without a good gyro",
        nullable=True,
    )
    gyro_bias = fields.number(
        "rad/s", "yaw rate of the vehicle where the scaled gyro says zero", nullable=True
    )
    heading_delay = fields.number(
        "s",
        "how late the reported heading was against the gyro: part of every latency of the poses",
        nullable=True,
    )
    heading_delay_error = fields.number("s", "standard error of that delay", nullable=True)
    wheel_delay = fields.number("s", "how late the encoders were against the gyro: the latency of the wheels")
    gyro_residual = fields.number("1", "turning that the gyro leaves, as a share of it", nullable=True)
    latency_spread = fields.number("s", "standard deviation of the latencies that were taken off the poses")
    outlier_time = fields.number("s", "time in which the localization goes where the wheels did not")
    recorded_modulus_command = fields.number(
        "m/s",
        "median slip modulus (L = 1 m) on command as recorded, before anything was put right",
        nullable=True,
    )
    recorded_modulus_measured = fields.number("m/s", "the same on measured wheels", nullable=True)
