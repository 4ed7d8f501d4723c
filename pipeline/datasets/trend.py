"""Slip and fitted parameters over the dates of runs, each with a test of the largest step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.core import FEWEST_OF_SPREAD, Floats, format_count, suffix_unit
from pipeline.datasets.compared_runs import find_material
from pipeline.datasets.fleet import list_numbers
from pipeline.datasets.levels import LEVEL, adjust
from pipeline.datasets.pooling import gather_runs
from pipeline.store import Store, lack_runs

FEWEST_OF_TEST = 2 * FEWEST_OF_SPREAD
"""Runs of a series from which on a step can be tested, half of them on either side."""
_DRAWS = 1_999
"""Random orders of a test: p = 0.05 is then known to a standard error of 0.005."""


@dataclass(frozen=True)
class Step:
    """The largest step of a series.

    Attributes:
        run, since: first run after it, and its day.
        before, after: levels before and after, on average over its terrains.
        p: probability of a step as large anywhere in the series without a change.
        p_adjusted: over all series (Benjamini and Hochberg).
    """

    run: str
    since: str
    before: float
    after: float
    p: float
    p_adjusted: float = 1.0


@dataclass(frozen=True)
class Series:
    """One quantity of one group over time.

    Attributes:
        group: a dataset, or the vehicle of a parameter.
        quantity: for example `median_modulus (command)` or `effective_track.k`.
        unit: unit of the values.
        points: ``day``, ``run``, ``terrain``, ``value``, in the order of time.
        step: its largest step; None with too few runs for a test.
    """

    group: str
    quantity: str
    unit: str
    points: pl.DataFrame
    step: Step | None = None

    @property
    def is_changed(self) -> bool:
        """Whether its step is significant over all series."""
        return self.step is not None and self.step.p_adjusted <= LEVEL

    def describe(self) -> str:
        """The series in a sentence: its last value, and the step where there is one."""
        unit = suffix_unit(self.unit)
        text = f"{format_count(self.points.height, 'run')}, latest {self.points['value'][-1]:.3g}{unit}"
        if self.step is None:
            repeated = _take_repeated(self.points).height
            few = f", no test: {repeated} of the {FEWEST_OF_TEST} runs on terrains driven twice that it takes"
            return text + (few if repeated < FEWEST_OF_TEST else ", no test: all values are the same")
        if not self.is_changed:
            return f"{text}, no significant step"
        change = f"{self.step.before:.3g} -> {self.step.after:.3g}{unit}"
        return f"{text}, {change} since {self.step.since} (p = {self.step.p_adjusted:.2g} over all series)"


@dataclass(frozen=True)
class Trend:
    """Series of all groups, those with a significant step first; notes; and the keys of the runs."""

    series: tuple[Series, ...]
    notes: tuple[str, ...]
    keys: tuple[str, ...]

    @property
    def summary(self) -> str:
        """How many series could be tested, and how many have a step."""
        testable = [one for one in self.series if one.step is not None]
        if not testable:
            need = f"a series takes {FEWEST_OF_TEST} dated runs on terrains that were driven twice or more"
            return f"Nothing can be tested: {need}"
        count = sum(one.is_changed for one in testable)
        steps = format_count(count, "significant step") if count else "No significant step"
        return f"{steps} in the {len(testable)} of {len(self.series)} series that could be tested"

    def to_json(self) -> dict[str, object]:
        """The JSON object of `slip fleet trend`."""
        series = [
            {
                "group": one.group,
                "quantity": one.quantity,
                "unit": one.unit,
                "points": one.points.to_dicts(),
                "step": None if one.step is None else {**vars(one.step), "is_significant": one.is_changed},
            }
            for one in self.series
        ]
        return {"summary": self.summary, "series": series, "notes": list(self.notes)}


def follow_trend(store: Store, by: Sequence[str]) -> Trend:
    """Follow slip by group and fitted parameters by vehicle over the dates of the runs.

    Args:
        store: the results.
        by: columns that define a group of slip.

    Raises:
        ComparisonError: ``nothing_to_follow``: no run has a date; ``no_such_column``.
    """
    compared = find_material(store, by, trusted_only=True, optional=("estimates",))
    dated = compared.labels.filter(pl.col("day").is_not_null()).sort("day", "start", "run")
    undated = sorted(set(compared.manifests) - set(dated["run"]))
    notes = [*compared.notes, *(note for note in compared.date_notes if note not in compared.notes)]
    notes += [f"left out, because no date is known: {', '.join(undated)}"] if undated else []
    if dated.is_empty():
        hint = "Analyze logs whose clock was set, or put the date into their names (2026-05-03)."
        raise lack_runs("nothing_to_follow", "there is no run with a date", store.root, hint, notes)
    dated = dated.with_row_index("order")
    series: list[Series] = []
    slip = gather_runs(compared.scan("aggregates").collect(), dated).sort("order")
    for (group, source), rows in slip.partition_by(
        "group", "input", as_dict=True, maintain_order=True
    ).items():
        points = rows.select("day", "run", "terrain", pl.col("median_modulus").alias("value")).drop_nulls()
        series += [Series(str(group), f"median_modulus ({source})", "m/s", points)] if points.height else []
    days = dated.select("order", "run", "day")
    for vehicle, effect, parameter, rows in list_numbers(compared.read_estimates().join(days, on="run")):
        own = rows.filter(pl.col("in_model") | pl.col("named")).sort("order")
        points = own.select("day", "run", "terrain", "value")
        series.append(Series(vehicle, f"{effect}.{parameter}", str(own["unit"][0]), points))
    keys = tuple(f"{run}/{compared.manifests[run].key}" for run in dated["run"])
    return Trend(tuple(find_steps(series)), (*compared.count_omitted(len(keys)), *notes), keys)


def find_steps(series: Sequence[Series]) -> list[Series]:
    """The series with their largest steps, and p over all of them; those with a significant step first."""
    steps = [_find_step(one.points) for one in series]
    adjusted = adjust([None if step is None else step.p for step in steps])
    judged = [
        replace(one, step=None if step is None or p is None else replace(step, p_adjusted=p))
        for one, step, p in zip(series, steps, adjusted, strict=True)
    ]
    return sorted(judged, key=lambda one: (not one.is_changed, one.group, one.quantity))


def _take_repeated(points: pl.DataFrame) -> pl.DataFrame:
    """Runs on terrains that were driven more than once: the others say nothing of a step."""
    return points.filter(pl.len().over("terrain") > 1)


def _find_step(points: pl.DataFrame) -> Step | None:
    """The split with the largest Mann-Whitney statistic, beside what terrains differ by; p by permutation."""
    from scipy.stats import permutation_test, rankdata  # noqa: PLC0415 - heavy

    mean = pl.col("value").mean()
    several = _take_repeated(points)
    rest = several.select(pl.col("value") - mean.over("terrain") + mean).to_series().to_numpy()
    count = rest.size
    if count < FEWEST_OF_TEST or float(np.ptp(rest)) == 0.0:
        return None
    before = np.arange(FEWEST_OF_SPREAD, count - FEWEST_OF_SPREAD + 1)

    def weigh(ranks: Floats, axis: int = -1) -> Floats:
        sums = np.cumsum(ranks, axis=axis)[..., before - 1]
        scores: Floats = np.abs(sums - before * (count + 1) / 2.0) / np.sqrt(
            before * (count - before) * (count + 1) / 12
        )
        return scores

    ranks = rankdata(rest)
    test = permutation_test(
        (ranks,), lambda data, axis: weigh(data, axis).max(axis=-1), permutation_type="pairings",
        alternative="greater", vectorized=True, n_resamples=_DRAWS, rng=np.random.default_rng(0),
    )  # fmt: skip
    first = int(before[int(np.argmax(weigh(ranks)))])
    run, since = several["run"][first], several["day"][first]
    return Step(
        str(run), str(since), float(rest[:first].mean()), float(rest[first:].mean()), float(test.pvalue)
    )
