"""Numbers of a fleet by vehicle, terrain and run."""

from typing import ClassVar

from schemas import fields
from schemas.contract import Table

LEVELS = ("vehicle", "terrain", "run", "open")


class Fleet(Table):
    """One row a vehicle and number, ``terrain`` `*`, then one for each terrain.

    ``run`` and ``dataset`` are `*`; ``keys`` names the runs.
    """

    VERSION: ClassVar[int] = 1

    effect = fields.name("id of the effect")
    parameter = fields.name("name of the parameter")
    unit = fields.text("unit of value, low, high and the spreads")
    level = fields.choice(LEVELS, "whose the number is; open where the runs cannot tell")
    name = fields.text("what the effect is called at that level; all candidates where it is open")
    because = fields.text("why that level, or what would tell")
    value = fields.number("1", "common value of the vehicle, or mean of the terrain, in the column `unit`")
    low = fields.optional("1", "lower end of its 95 % interval")
    high = fields.optional("1", "upper end of it")
    spread_terrain = fields.optional("1", "standard deviation between terrains")
    spread_run = fields.optional("1", "standard deviation between runs of a terrain")
    chi_square = fields.optional("1", "scatter of runs over what their errors say")
    p_terrain = fields.optional("1", "chance that equal terrains differ as much")
    runs = fields.count("runs behind the value", 1)
    named = fields.count("runs whose diagnosis names the effect", nullable=True)
    keys = fields.text("run/generation of every run counted, separated by spaces")
