"""Numbers of a fleet by vehicle, terrain and run."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

LEVELS = ("vehicle", "terrain", "run", "open")


class Fleet(Table):
    """One row a vehicle and number, ``terrain`` `*`, then one for each terrain.

    ``run`` and ``dataset`` are `*`; ``keys`` names the runs.
    """

    VERSION: ClassVar[int] = 1

    effect = dy.String(min_length=1, metadata={"description": "id of the effect"})
    parameter = dy.String(min_length=1, metadata={"description": "name of the parameter"})
    unit = fields.text("unit of value, low, high and the spreads")
    level = dy.Enum(LEVELS, metadata={"description": "whose the number is; open where the runs cannot tell"})
    name = fields.text("what the effect is called at that level; all candidates where it is open")
    because = fields.text("why that level, or what would tell")
    value = fields.number("1", "common value of the vehicle, or mean of the terrain, in the column `unit`")
    low = fields.number("1", "lower end of its 95 % interval", nullable=True)
    high = fields.number("1", "upper end of it", nullable=True)
    spread_terrain = fields.number("1", "standard deviation between terrains", nullable=True)
    spread_run = fields.number("1", "standard deviation between runs of a terrain", nullable=True)
    chi_square = fields.number("1", "scatter of runs over what their errors say", nullable=True)
    p_terrain = fields.number("1", "chance that equal terrains differ as much", nullable=True)
    runs = dy.Int64(min=1, metadata={"description": "runs behind the value"})
    named = dy.Int64(min=0, nullable=True, metadata={"description": "runs whose diagnosis names the effect"})
    keys = fields.text("run/generation of every run counted, separated by spaces")
