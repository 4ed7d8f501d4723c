"""Numbers of all effects that a run tells of, named or not."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table


class Estimates(Table):
    """One row a parameter: what runs are set side by side with."""

    VERSION: ClassVar[int] = 2

    input = fields.source()
    effect = fields.name("id of the effect")
    parameter = fields.name("name of the parameter")
    unit = fields.text("unit of value and standard_error")
    value = fields.number("1", "its estimate, in the unit of the column `unit`")
    standard_error = fields.bounded("1", "half of its 95 % interval over 1.96", 0.0)
    named = fields.flag(
        "the diagnosis names the effect; else the estimate is what one step of a joint fit gives"
    )
    at_bound = fields.flag("it stopped at a bound of the search: the error says little")
