"""Before driving there: what the runs of a vehicle let expect of its numbers on a terrain."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.core.numbers import NORMAL_95
from pipeline.fleet.errors import ComparisonError
from pipeline.fleet.hierarchy import leave_out_odd, take_numbers
from pipeline.fleet.runs import UNKNOWN
from pipeline.fleet.statistics.posterior import draw_run
from pipeline.models.bounds import stands_at_bound
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import Effect, Place
from pipeline.models.parameter import USUAL_SPREAD, is_of_one_run

DRAWS = 400
"""Draws of every number: ends of 95 % intervals are then known to a tenth of their width."""
RUNS_SHARE = USUAL_SPREAD / 0.67449
"""Runs of one ground differ by so much of what grounds may, which is the usual size of the number: the
half-normal prior of that scale has the usual spread between runs as its median, and intervals of a ground
with two to four runs hold 93 to 97 % of drawn runs (`make fleets ARGS="--drawn 200"`)."""
_ENDS = (0.025, 0.975)


@dataclass(frozen=True)
class ForecastNumber:
    """A number as another run on the terrain is expected to show it.

    Attributes:
        effect, parameter, unit: which.
        draws: of it, within the bounds of the search, shape (n,).
        runs: how many runs tell of it.
    """

    effect: str
    parameter: str
    unit: str
    draws: Floats
    runs: int

    @property
    def label(self) -> str:
        """``effect.parameter``."""
        return f"{self.effect}.{self.parameter}"

    @property
    def value(self) -> float:
        """Median."""
        return float(np.median(self.draws))

    @property
    def ends(self) -> tuple[float, float]:
        """95 % interval."""
        low, high = np.quantile(self.draws, _ENDS).tolist()
        return low, high

    @property
    def at_bound(self) -> bool:
        """Whether the interval is cut at a bound of the search, so that it holds no 95 %."""
        bounds = find_effect(self.effect)().parameter(self.parameter).bounds
        return any(stands_at_bound(end, bounds) for end in self.ends)

    @property
    def deviation(self) -> float:
        """Standard deviation of a normal distribution with that interval."""
        low, high = self.ends
        return (high - low) / (2.0 * NORMAL_95)


@dataclass(frozen=True)
class Forecast:
    """The model expected of a vehicle on a terrain.

    Attributes:
        vehicle, terrain: of what.
        input: what the model is fed with.
        numbers: of its effects.
        here: runs of the vehicle on this terrain.
        elsewhere: its runs on others.
    """

    vehicle: str
    terrain: str
    input: Literal["command", "measured"]
    numbers: tuple[ForecastNumber, ...]
    here: tuple[str, ...]
    elsewhere: tuple[str, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at their expected values, in the order of a command's way."""
        return self._make([number.value for number in self.numbers])

    @property
    def prior(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of every number by label, for a fit."""
        return {number.label: (number.value, number.deviation) for number in self.numbers}

    def draw(self, which: int) -> tuple[Effect, ...]:
        """The effects at one draw of all numbers."""
        return self._make([float(number.draws[which]) for number in self.numbers])

    def _make(self, values: Sequence[float]) -> tuple[Effect, ...]:
        own: dict[str, dict[str, float]] = {}
        for number, value in zip(self.numbers, values, strict=True):
            own.setdefault(number.effect, {})[number.parameter] = value
        return make_effects(own)


def make_effects(values: dict[str, dict[str, float]]) -> tuple[Effect, ...]:
    """Effects of the catalogue with these values, in the order of a command's way."""
    effects = [find_effect(name)().change(**own) for name, own in values.items()]
    return tuple(sorted(effects, key=lambda effect: (effect.place, effect.rank, effect.id)))


def forecast_vehicle(
    estimates: pl.DataFrame,
    vehicle: str,
    terrain: str,
    source: Literal["command", "measured"] = "command",
    *,
    seed: int = 0,
) -> Forecast:
    """Forecast the numbers of a vehicle on a terrain.

    The model has the effects that most runs on the terrain name; on a terrain never driven, that most runs of
    the vehicle name. A number is drawn as another run would show it (`statistics.posterior`); runs that stand
    apart are left out. Draws of different numbers are independent.

    Args:
        estimates: rows of the table `estimates` of the fleet's runs.
        vehicle: which.
        terrain: which; need not have runs.
        source: what the model is fed with.
        seed: of the draws.

    Raises:
        ComparisonError: ``no_such_vehicle``: no run of the vehicle on a known terrain has estimates.
    """
    known = estimates.filter(pl.col("terrain") != UNKNOWN)
    rows = take_numbers(known).filter(pl.col("vehicle") == vehicle)
    if rows.is_empty():
        what = f"no run of {vehicle} on a known terrain has estimates"
        hint = f"There are runs of: {', '.join(sorted(set(known['vehicle']))) or 'no vehicle'}."
        raise ComparisonError("no_such_vehicle", what, hint=hint)
    here = rows.filter(pl.col("terrain") == terrain)
    numbers = []
    for effect in _choose_effects(rows if here.is_empty() else here, source):
        for parameter in effect.parameters:
            own = rows.filter(pl.col("effect") == effect.id, pl.col("parameter") == parameter.name)
            if own.is_empty():
                continue
            own, _ = leave_out_odd(own)
            drawn = draw_run(
                own["value"],
                own["standard_error"],
                own["terrain"].to_list(),
                terrain,
                usual=(parameter.usual_size, RUNS_SHARE * parameter.usual_size),
                count=DRAWS,
                rng=np.random.default_rng([seed, *f"{effect.id}.{parameter.name}".encode()]),
            )
            draws = np.clip(drawn.run, *parameter.bounds)
            numbers.append(ForecastNumber(effect.id, parameter.name, parameter.unit, draws, own.height))
    names = set(rows["run"])
    there = set(here["run"])
    return Forecast(
        vehicle, terrain, source, tuple(numbers), tuple(sorted(there)), tuple(sorted(names - there))
    )


def _choose_effects(rows: pl.DataFrame, source: str) -> list[Effect]:
    """Effects that more than half of the runs name and that can act on the input."""
    most = rows["run"].n_unique() / 2.0
    named = rows.filter("named").group_by("effect").agg(pl.col("run").n_unique().alias("runs"))
    effects = [find_effect(name)() for name in named.filter(pl.col("runs") > most)["effect"].sort()]
    chosen = [
        effect
        for effect in effects
        if (source == "command" or effect.place > Place.DRIVE) and not is_of_one_run(effect.parameters)
    ]
    return [effect for effect in chosen if not any(effect.id in other.contains for other in chosen)]
