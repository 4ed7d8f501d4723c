"""Measures of difficulty, and whether vehicles agree on which ground is harder."""

import itertools
from dataclasses import dataclass

import polars as pl

from pipeline.fleet.statistics.ranks import kendall_p, kendall_tau

_LEVEL = 0.05


@dataclass(frozen=True)
class Measure:
    """A measure of difficulty.

    Attributes:
        column: of the table `datasets`.
        name, unit, about: in words; those of unit 1 compare vehicles of any size.
    """

    column: str
    name: str
    unit: str
    about: str


MEASURES = {
    "slip": Measure("median_modulus", "slip modulus", "m/s", "the published idea: fast vehicles look worse"),
    "relative": Measure(
        "relative_slip", "relative slip", "1", "modulus over ideal speed, while the vehicle should move"
    ),
    "energy": Measure(
        "lost_energy",
        "lost energy",
        "1",
        "slip path over path driven: what friction takes per metre and mass, over its coefficient times g",
    ),
    "unpredictability": Measure(
        "relative_unpredictability",
        "unpredictability",
        "1",
        "rms slip that a fitted slip model leaves on unseen data, over the rms ideal speed",
    ),
    "transitory": Measure(
        "transitory_slip", "transitory slip", "m", "slip path that a change of command adds to the steady one"
    ),
}


@dataclass(frozen=True)
class Agreement:
    """How alike two vehicles order the grounds that both were driven on.

    Attributes:
        measure: key of `MEASURES`.
        a, b: vehicles.
        terrains: common grounds, from easy to hard for `a`.
        tau: Kendall's tau-b; None with fewer than two grounds.
        p: chance of as strong an order, either way, if there were none.
        smallest_p: the least that so many grounds allow.
        text: in words.
    """

    measure: str
    a: str
    b: str
    terrains: tuple[str, ...]
    tau: float | None
    p: float | None
    smallest_p: float | None
    text: str


def compare_orders(datasets: pl.DataFrame) -> list[Agreement]:
    """Every two vehicles by every measure that both have; grounds are taken as medians over their datasets.

    Args:
        datasets: table `datasets` of one input; rows over several vehicles or grounds do not count.
    """
    known = datasets.filter(pl.col("vehicle") != "*", pl.col("terrain") != "*")
    found = []
    for a, b in itertools.combinations(sorted(set(known["vehicle"])), 2):
        for key, measure in MEASURES.items():
            sides = [
                known.filter(pl.col("vehicle") == vehicle)
                .drop_nulls(measure.column)
                .group_by("terrain")
                .agg(pl.col(measure.column).median().alias(vehicle))
                for vehicle in (a, b)
            ]
            found.append(_compare(key, a, b, sides[0].join(sides[1], on="terrain").sort(a, "terrain")))
    return found


def _compare(key: str, a: str, b: str, both: pl.DataFrame) -> Agreement:
    terrains = tuple(both["terrain"].to_list())
    count = len(terrains)
    if count < 2:  # noqa: PLR2004 - an order takes two
        shared = f"share {terrains[0]} only" if terrains else "share no ground"
        return Agreement(key, a, b, terrains, None, None, None, f"{a} and {b} {shared}: no order to compare")
    tau = kendall_tau(both[a], both[b])
    p, smallest = kendall_p(tau, count)
    sure = f"p = {p:.2g}" if smallest <= _LEVEL else f"too few grounds to be sure, p = {p:.2g}; 5 would do"
    text = f"{a} and {b} on {count} grounds by {MEASURES[key].name}: Kendall's tau {tau:.2f}, {sure}"
    return Agreement(key, a, b, terrains, tau, p, smallest, text)
