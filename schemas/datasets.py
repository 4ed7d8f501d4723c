"""Runs pooled into datasets."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Datasets(Table):
    """One row a dataset and input; ``run`` is `*`, ``keys`` names the runs.

    Runs are the unit: a number of a dataset is the median over its runs, however long they are. Columns that
    `slip compare` alone works out are null until it has run.
    """

    VERSION: ClassVar[int] = 3

    by = fields.text("columns that make a dataset, for example `dataset` or `vehicle,terrain`")
    input = fields.source()
    runs = fields.count("number of runs", 1)
    samples = fields.count("time steps of all runs")
    windows = fields.count("2 s windows of all runs", nullable=True)
    distance = fields.optional("m", "distance driven in all runs")
    duration = fields.optional("s", "time covered by all runs")
    length_scale = fields.optional("m", "L that turns yaw rate into speed in the modulus")
    median_modulus = fields.optional("m/s", "median over runs of the runs' median modulus")
    low = fields.optional("m/s", "lower end of the 95 % interval of the typical median modulus")
    high = fields.optional("m/s", "upper end of it")
    interval = fields.text("what the interval says: over runs, or within this run only; empty without one")
    median_window_norm = fields.optional("m/s", "median over runs of the runs' median window norm")
    norm_low = fields.optional("m/s", "lower end of the 95 % interval of the typical window norm")
    norm_high = fields.optional("m/s", "upper end of it")
    published_norm = fields.optional("m/s", "median window norm of the published chain")
    transitory_median_modulus = fields.optional("m/s", "after a change of command")
    steady_median_modulus = fields.optional("m/s", "away from changes of command")
    drivetrain_mean_square = fields.optional("m^2/s^2", "of f(command) - f(measured wheels)")
    ground_mean_square = fields.optional("m^2/s^2", "of f(measured wheels) - v")
    cross_mean_square = fields.optional("m^2/s^2", "twice the mean product of the two parts")
    height_rate = fields.optional("m/s", "height variation per second")
    largest_kinetic_energy = fields.optional("J", "largest 1/2 m v^2 of any run")
    relative_slip = fields.optional("1", "median modulus over ideal speed, while it moves")
    slip_energy = fields.optional("J", "median of 1/2 m |g_xy|^2 + 1/2 I g_w^2")
    lost_energy = fields.optional(
        "1", "slip path over path driven: energy lost per metre and mass, over mu g"
    )
    unpredictability = fields.optional("m/s", "rms slip that a fitted slip model leaves, held out")
    relative_unpredictability = fields.optional("1", "unpredictability over rms ideal speed")
    transitory_slip = fields.optional("m", "slip path a change of command adds to the steady one")
    keys = fields.text("run/generation of every run counted, separated by spaces")
