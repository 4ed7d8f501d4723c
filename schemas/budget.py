"""Who carries the slip of a run, and the errors of its predictions."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS

QUANTITIES = ("slip", "position", "heading")
KINDS = ("effect", "disturbance", "localization_noise")


class Budget(Table):
    """One row a cause: the shares of an input and a quantity add up to one."""

    VERSION: ClassVar[int] = 1

    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    quantity = dy.Enum(
        QUANTITIES,
        metadata={"description": "mean square that is shared out: slip over 0.5 s, or error over 2 s"},
    )
    kind = dy.Enum(
        KINDS, metadata={"description": "an effect, what no effect takes away, or the noise floor"}
    )
    name = dy.String(min_length=1, metadata={"description": "id of the effect, or the kind"})
    mean_square = fields.number("1", "its part of the mean square, in the unit of the column `unit`")
    unit = fields.text("unit of mean_square")
    share = fields.number("1", "its part over the whole: its Shapley value over the order of effects")
    low = fields.number("1", "lower end of its 95 % interval, a jackknife over 10 s stretches", nullable=True)
    high = fields.number("1", "upper end of it", nullable=True)
    alone = fields.number("1", "share that the effect takes from the ideal model by itself", nullable=True)
    last = fields.number("1", "share that it takes when all others are there", nullable=True)
    stretches = dy.Int32(min=0, metadata={"description": "stretches of 10 s behind the interval"})
