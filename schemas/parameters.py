"""Parameters of the effects that the diagnosis of a run named."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Parameters(Table):
    """One row a parameter of an effect that is missing from the ideal model, as in `diagnosis.json`."""

    VERSION: ClassVar[int] = 2

    input = fields.source()
    effect = fields.name("id of the effect")
    parameter = fields.name("name of the parameter")
    value = fields.number("1", "its value, in the unit of the column `unit`")
    low = fields.optional("1", "lower end of its 95 % interval")
    high = fields.optional("1", "upper end of it")
    unit = fields.text("unit of value, low and high")
    at_bound = fields.flag("it stopped at a bound of the search: the interval says little")
