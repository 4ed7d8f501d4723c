"""Datasets compared pair by pair."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS

UNITS = ("runs", "blocks")


class Comparisons(Table):
    """One row a pair; ``run``, ``vehicle`` and ``terrain`` are `*`, ``dataset`` names both sides."""

    VERSION: ClassVar[int] = 1

    by = fields.text("columns that make a dataset")
    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    quantity = fields.text("what is compared: median_modulus, or published_norm with --as-published")
    a = fields.text("one dataset")
    b = fields.text("the other")
    runs_a = dy.Int64(min=1, metadata={"description": "runs of a"})
    runs_b = dy.Int64(min=1, metadata={"description": "runs of b"})
    shift = fields.number("m/s", "Hodges-Lehmann shift b - a of the units")
    low = fields.number("m/s", "lower end of its 95 % interval", nullable=True)
    high = fields.number("m/s", "upper end of it", nullable=True)
    cliffs_delta = fields.bounded("1", "Cliff's delta of the units; above 0: b is larger", -1.0, 1.0)
    size = fields.text("Cliff's delta in a word")
    p = fields.bounded("1", "two-sided permutation p of this pair", 0.0, 1.0)
    p_adjusted = fields.bounded("1", "the same corrected over the family of pairs", 0.0, 1.0)
    smallest_p = fields.bounded("1", "smallest corrected p that the counts allow", 0.0, 1.0)
    method = fields.text("test and correction")
    unit_of_analysis = dy.Enum(
        UNITS, metadata={"description": "what is permuted: runs, or blocks of single runs"}
    )
    p_uncorrected = fields.bounded(
        "1", "plain Mann-Whitney of all samples: not valid, they are correlated", 0.0, 1.0
    )
    note = fields.text("what must be known to read the row; may be empty")
    keys = fields.text("run/generation of every run counted, separated by spaces")
