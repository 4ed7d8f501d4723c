"""The table of the map of what to expect."""

from typing import ClassVar

from schemas import contract
from schemas.contract import Table


class Cells(Table):
    """One row a frame, vehicle and cell of the map of what to expect; ``run`` is `*`.

    ``dataset`` and ``terrain`` are `*` where several were driven in a cell.
    """

    VERSION: ClassVar[int] = 1

    frame = contract.name("in which x and y are: a place on Earth, a map that runs share, or one run's own")
    input = contract.source()
    cell = contract.bounded("m", "side of the cell", 0.0)
    x = contract.number("m", "middle of the cell, east on Earth", frame="map")
    y = contract.number("m", "middle of the cell, north on Earth", frame="map")
    latitude = contract.optional("deg", "of the middle; null in a frame that is not on Earth")
    longitude = contract.optional("deg", "of the middle; null in a frame that is not on Earth")
    passes = contract.count("crossings of the cell by all runs", 1)
    runs = contract.count("runs that crossed it", 1)
    slip = contract.bounded("1", "share of the ideal motion that was lost, median over crossings", 0.0)
    slip_low = contract.optional("1", "lower quartile of it over crossings; null of a single one")
    slip_high = contract.optional("1", "upper quartile")
    modulus = contract.bounded("m/s", "slip modulus, median over crossings", 0.0)
    energy = contract.optional("J", "kinetic energy of the slip velocity, median; null without a mass")
    lean = contract.optional("rad", "inclination of the vehicle, median; null where it was not measured")
    power = contract.optional("W", "drawn from the battery, median; null where the log does not say")
    keys = contract.text("run/generation of every run counted, separated by spaces")
