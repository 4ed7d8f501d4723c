"""Datasets compared pair by pair."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table

UNITS = ("runs", "blocks")


class Comparisons(Table):
    """One row a pair; ``run``, ``vehicle`` and ``terrain`` are `*`, ``dataset`` names both sides."""

    VERSION: ClassVar[int] = 1

    by = fields.text("columns that make a dataset")
    input = fields.source()
    quantity = fields.text("what is compared: median_modulus, or published_norm with --as-published")
    a = fields.text("one dataset")
    b = fields.text("the other")
    runs_a = fields.count("runs of a", 1)
    runs_b = fields.count("runs of b", 1)
    shift = fields.number("m/s", "Hodges-Lehmann shift b - a of the units")
    low = fields.optional("m/s", "lower end of its 95 % interval")
    high = fields.optional("m/s", "upper end of it")
    cliffs_delta = fields.bounded("1", "Cliff's delta of the units; above 0: b is larger", -1.0, 1.0)
    size = fields.text("Cliff's delta in a word")
    p = fields.bounded("1", "two-sided permutation p of this pair", 0.0, 1.0)
    p_adjusted = fields.bounded("1", "the same corrected over the family of pairs", 0.0, 1.0)
    smallest_p = fields.bounded("1", "smallest corrected p that the counts allow", 0.0, 1.0)
    method = fields.text("test and correction")
    unit_of_analysis = fields.choice(UNITS, "what is permuted: runs, or blocks of single runs")
    p_uncorrected = fields.bounded(
        "1", "plain Mann-Whitney of all samples: not valid, they are correlated", 0.0, 1.0
    )
    note = fields.text("what must be known to read the row; may be empty")
    keys = fields.text("run/generation of every run counted, separated by spaces")
