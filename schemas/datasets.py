"""Runs pooled into datasets."""

from __future__ import annotations

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS


class Datasets(Table):
    """One row a dataset and input; ``run`` is `*`, ``keys`` names the runs."""

    NAME: ClassVar[str] = "datasets"
    VERSION: ClassVar[int] = 1

    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    runs = dy.Int64(min=1, metadata={"description": "number of runs"})
    samples = dy.Int64(min=0, metadata={"description": "time steps of all runs"})
    median_modulus = fields.number("m/s", "median over runs of the runs' median modulus", nullable=True)
    median_window_norm = fields.number(
        "m/s", "median over runs of the runs' median window norm", nullable=True
    )
    keys = fields.text("run/generation of every run counted, separated by spaces")
