"""Parameters of the effects that the diagnosis of a run named."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table
from schemas.slip import INPUTS


class Parameters(Table):
    """One row a parameter of an effect that is missing from the ideal model, as in `diagnosis.json`."""

    VERSION: ClassVar[int] = 2

    input = dy.Enum(INPUTS, metadata={"description": "what u was: the command or the measured wheels"})
    effect = dy.String(min_length=1, metadata={"description": "id of the effect"})
    parameter = dy.String(min_length=1, metadata={"description": "name of the parameter"})
    value = fields.number("1", "its value, in the unit of the column `unit`")
    low = fields.number("1", "lower end of its 95 % interval", nullable=True)
    high = fields.number("1", "upper end of it", nullable=True)
    unit = fields.text("unit of value, low and high")
    at_bound = fields.flag("it stopped at a bound of the search: the interval says little")
