"""Quantities of a vehicle over its runs: levels, the days on which they stepped, and when to raise alarm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.fleet.statistics import find_changes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl

FEWEST_RUNS = 8
LEVEL = 0.05


@dataclass(frozen=True)
class Step:
    """A change of level.

    Attributes:
        since: day of the first run of the new level.
        run: that run.
        before: level before, the mean over runs.
        after: level after.
        runs_before: runs of the level before.
        runs_after: runs of the level after.
        p: how often the runs in random order would step as much somewhere.
    """

    since: str
    run: str
    before: float
    after: float
    runs_before: int
    runs_after: int
    p: float

    @property
    def size(self) -> float:
        """Change over the level before; infinite where that is zero."""
        return abs(self.after - self.before) / abs(self.before) if self.before else float("inf")


@dataclass(frozen=True)
class Series:
    """One quantity of one group over time.

    Attributes:
        group: whose.
        quantity: for example `median_modulus (command)` or `effective_track.k (measured)`.
        unit: of the values.
        points: ``day``, ``run``, ``value``, in the order of time.
        steps: changes of level, in the order of time.
    """

    group: str
    quantity: str
    unit: str
    points: pl.DataFrame
    steps: tuple[Step, ...]

    @property
    def latest(self) -> float:
        """The last run's value."""
        return float(self.points["value"][-1])


@dataclass(frozen=True)
class Alert:
    """What somebody should look at."""

    group: str
    quantity: str
    text: str


def follow_quantities(values: pl.DataFrame) -> list[Series]:
    """Every quantity of every group as a series, with its steps.

    Steps are looked for by `find_changes`, at 5 % for each series, where there are at least eight runs: with
    fewer, no order of the runs is rare enough.

    Args:
        values: ``group``, ``quantity``, ``unit``, ``day``, ``run``, ``value`` in the order of time.
    """
    series = []
    for (group, quantity), rows in values.partition_by(
        "group", "quantity", as_dict=True, maintain_order=True
    ).items():
        points = rows.select("day", "run", "value")
        series.append(Series(str(group), str(quantity), str(rows["unit"][0]), points, _find_steps(points)))
    return sorted(series, key=lambda one: (one.group, one.quantity))


def raise_alerts(series: list[Series], *, threshold: float, limits: Mapping[str, float]) -> list[Alert]:
    """Steps of the last level beyond ``threshold``, and last values beyond their limit.

    Args:
        series: as of `follow_quantities`.
        threshold: relative change of level that matters, for example 0.1.
        limits: highest value allowed, by quantity (with or without the input in brackets).
    """
    alerts = []
    for one in series:
        if one.steps and one.steps[-1].size >= threshold:
            alerts.append(Alert(one.group, one.quantity, describe_step(one, one.steps[-1])))
        limit = limits.get(one.quantity, limits.get(one.quantity.split(" (")[0]))
        if limit is not None and one.latest > limit:
            text = (
                f"{one.quantity} of {one.group} is {one.latest:.3g} {one.unit} in {one.points['run'][-1]}, "
                f"above the limit of {limit:g}"
            )
            alerts.append(Alert(one.group, one.quantity, text))
    return alerts


def describe_quiet(series: Sequence[Series]) -> str:
    """What is to be said where there is no alert: that nothing moved, or that nothing could be tested."""
    most = max((one.points.height for one in series), default=0)
    if most >= FEWEST_RUNS:
        return "nothing moved beyond the threshold"
    return (
        f"nothing could be tested: a change of level takes {FEWEST_RUNS} runs, the most of a group is {most}"
    )


def describe_step(series: Series, step: Step) -> str:
    """A step in a sentence: whose quantity moved from what to what, since when, how sure."""
    unit = f" {series.unit}" if series.unit not in ("", "1") else ""
    return (
        f"{series.quantity} of {series.group} moved from {step.before:.3g} to {step.after:.3g}{unit} since "
        f"{step.since} ({step.runs_before} runs before, {step.runs_after} since, p = {step.p:.2g})"
    )


def _find_steps(points: pl.DataFrame) -> tuple[Step, ...]:
    if points.height < FEWEST_RUNS:
        return ()
    changes = find_changes(points["value"].to_numpy(), level=LEVEL)
    edges = [0, *(change.index for change in changes), points.height]
    return tuple(
        Step(
            since=points["day"][change.index],
            run=points["run"][change.index],
            before=change.before,
            after=change.after,
            runs_before=edges[i + 1] - edges[i],
            runs_after=edges[i + 2] - edges[i + 1],
            p=change.p,
        )
        for i, change in enumerate(changes)
    )
