"""Who carries the slip of a run, and the errors of its predictions."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

QUANTITIES = ("slip", "position", "heading")
KINDS = ("effect", "disturbance", "localization_noise")


class Budget(Table):
    """One row a cause: the shares of an input and a quantity add up to one."""

    VERSION: ClassVar[int] = 1

    input = fields.source()
    quantity = fields.choice(QUANTITIES, "mean square that is shared out: slip over 0.5 s, or error over 2 s")
    kind = fields.choice(KINDS, "an effect, what no effect takes away, or the noise floor")
    name = fields.name("id of the effect, or the kind")
    mean_square = fields.number("1", "its part of the mean square, in the unit of the column `unit`")
    unit = fields.text("unit of mean_square")
    share = fields.number("1", "its part over the whole: its Shapley value over the order of effects")
    low = fields.optional("1", "lower end of its 95 % interval, a jackknife over 10 s stretches")
    high = fields.optional("1", "upper end of it")
    alone = fields.optional("1", "share that the effect takes from the ideal model by itself")
    last = fields.optional("1", "share that it takes when all others are there")
    stretches = dy.Int32(min=0, metadata={"description": "stretches of 10 s behind the interval"})
