"""Runs pooled into datasets."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS


class Datasets(Table):
    """One row a dataset and input; ``run`` is `*`, ``keys`` names the runs.

    Runs are the unit: a number of a dataset is the median over its runs, however long they are. Columns that
    `slip compare` alone works out are null until it has run.
    """

    VERSION: ClassVar[int] = 3

    by = fields.text("columns that make a dataset, for example `dataset` or `vehicle,terrain`")
    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    runs = dy.Int64(min=1, metadata={"description": "number of runs"})
    samples = dy.Int64(min=0, metadata={"description": "time steps of all runs"})
    windows = dy.Int64(min=0, nullable=True, metadata={"description": "2 s windows of all runs"})
    distance = fields.number("m", "distance driven in all runs", nullable=True)
    duration = fields.number("s", "time covered by all runs", nullable=True)
    length_scale = fields.number("m", "L that turns yaw rate into speed in the modulus", nullable=True)
    median_modulus = fields.number("m/s", "median over runs of the runs' median modulus", nullable=True)
    low = fields.number("m/s", "lower end of the 95 % interval of the typical median modulus", nullable=True)
    high = fields.number("m/s", "upper end of it", nullable=True)
    interval = fields.text("what the interval says: over runs, or within this run only; empty without one")
    median_window_norm = fields.number(
        "m/s", "median over runs of the runs' median window norm", nullable=True
    )
    norm_low = fields.number(
        "m/s", "lower end of the 95 % interval of the typical window norm", nullable=True
    )
    norm_high = fields.number("m/s", "upper end of it", nullable=True)
    published_norm = fields.number("m/s", "median window norm of the published chain", nullable=True)
    transitory_median_modulus = fields.number("m/s", "after a change of command", nullable=True)
    steady_median_modulus = fields.number("m/s", "away from changes of command", nullable=True)
    drivetrain_mean_square = fields.number("m^2/s^2", "of f(command) - f(measured wheels)", nullable=True)
    ground_mean_square = fields.number("m^2/s^2", "of f(measured wheels) - v", nullable=True)
    cross_mean_square = fields.number("m^2/s^2", "twice the mean product of the two parts", nullable=True)
    height_rate = fields.number("m/s", "height variation per second", nullable=True)
    largest_kinetic_energy = fields.number("J", "largest 1/2 m v^2 of any run", nullable=True)
    relative_slip = fields.number("1", "median modulus over ideal speed, while it moves", nullable=True)
    slip_energy = fields.number("J", "median of 1/2 m |g_xy|^2 + 1/2 I g_w^2", nullable=True)
    lost_energy = fields.number(
        "1", "slip path over path driven: energy lost per metre and mass, over mu g", nullable=True
    )
    unpredictability = fields.number(
        "m/s", "rms slip that a fitted slip model leaves, held out", nullable=True
    )
    relative_unpredictability = fields.number("1", "unpredictability over rms ideal speed", nullable=True)
    transitory_slip = fields.number(
        "m", "slip path a change of command adds to the steady one", nullable=True
    )
    keys = fields.text("run/generation of every run counted, separated by spaces")
