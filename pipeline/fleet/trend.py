"""Quantities of a vehicle over its runs: levels, the days on which they stepped, and when to raise alarm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.fleet.parameter_trend import LevelChange, ParameterTrend, describe_change, say_change
from pipeline.fleet.statistics.changes import find_changes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import polars as pl


FEWEST_RUNS = 8
LEVEL = 0.05
"""Chance of an alert where nothing moved: half of it for the parameters of a vehicle, half for all else."""
_SLIP_FIRST = ("median_modulus (command)", "median_modulus (measured)")


@dataclass(frozen=True)
class Series:
    """One quantity of one group over time.

    Attributes:
        group: whose.
        quantity: for example `median_modulus (command)`.
        unit: of the values.
        points: ``order``, ``day``, ``run``, ``value``, in the order of time.
        steps: changes of level, in the order of time.
    """

    group: str
    quantity: str
    unit: str
    points: pl.DataFrame
    steps: tuple[LevelChange, ...]

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

    Steps are looked for by `find_changes`, where there are at least eight runs: with fewer, no order of the
    runs is rare enough. All series share the chance of a step that is none.

    Args:
        values: ``order`` (of all dated runs), ``group``, ``quantity``, ``unit``, ``day``, ``run``, ``value``
            in the order of time.
    """
    parts = values.partition_by("group", "quantity", as_dict=True, maintain_order=True)
    tested = sum(_can_step(rows) for rows in parts.values())
    series = []
    for (group, quantity), rows in parts.items():
        points = rows.select("order", "day", "run", "value")
        steps = _find_steps(points, LEVEL / 2 / tested) if _can_step(rows) else ()
        series.append(Series(str(group), str(quantity), str(rows["unit"][0]), points, steps))
    return sorted(series, key=lambda one: (one.group, one.quantity))


@dataclass(frozen=True)
class _Event:
    """A change that may be told: alone, or with the one that it follows from."""

    group: str
    quantity: str
    text: str
    short: str
    earliest: int
    latest: int


def raise_alerts(
    series: Sequence[Series],
    parameters: Sequence[ParameterTrend],
    latest: pl.DataFrame,
    *,
    vehicles: Mapping[str, str],
    threshold: float,
    limits: Mapping[str, float],
) -> list[Alert]:
    """One alert for each cause: the last change of a parameter, or of anything else, and what moved with it.

    Changes of one vehicle that may be of the same day are one: that of the surest parameter, with the
    others, slip and all, in its words. Last values beyond their limit are alerts of their own.

    Args:
        series: as of `follow_quantities`.
        parameters: as of `follow_parameters`; they count where they move by what is worth a name.
        latest: as of `find_latest`.
        vehicles: vehicle of each group that has one only.
        threshold: relative change of a series that matters, for example 0.1.
        limits: highest value allowed, by quantity (with or without the input in brackets).
    """
    moved = [(one, one.changes[-1]) for one in parameters if one.changes]
    moved = [(one, last) for one, last in moved if abs(last.after - last.before) >= one.worth]
    events = [
        _Event(one.vehicle, one.label, describe_change(one, last), say_change(one, last), last.earliest,
               last.latest)
        for one, last in sorted(moved, key=lambda pair: (pair[1].p, -pair[0].named))
    ]  # fmt: skip
    stepped = [(one, one.steps[-1]) for one in series if one.steps and one.steps[-1].size >= threshold]
    events += [
        _Event(vehicles.get(one.group, one.group), one.quantity, describe_step(one, step),
               say_step(one, step), step.earliest, step.latest)
        for one, step in sorted(stepped, key=lambda pair: pair[0].quantity not in _SLIP_FIRST)
    ]  # fmt: skip
    alerts = []
    while events:
        head = events.pop(0)
        same = [one for one in events if one.group == head.group and _overlap(one, head)]
        events = [one for one in events if one not in same]
        told = "; ".join(one.short for one in same)
        alerts.append(Alert(head.group, head.quantity, head.text + (f"; with it: {told}" if told else "")))
    lasts = [(one.group, one.quantity, one.unit, one.latest, one.points["run"][-1]) for one in series]
    lasts += [
        (vehicle, f"{effect}.{parameter}", unit, value, run)
        for vehicle, effect, parameter, unit, value, run in latest.iter_rows()
    ]
    for group, quantity, unit, value, run in lasts:
        limit = limits.get(quantity, limits.get(quantity.split(" (")[0]))
        if limit is not None and value > limit:
            text = f"{quantity} of {group} is {value:.3g} {unit} in {run}, above the limit of {limit:g}"
            alerts.append(Alert(group, quantity, text))
    return alerts


def _overlap(one: _Event, other: _Event) -> bool:
    return one.earliest <= other.latest and other.earliest <= one.latest


def describe_quiet(series: Sequence[Series], parameters: Sequence[ParameterTrend]) -> str:
    """What is to be said where there is no alert: that nothing moved, or that nothing could be tested."""
    most = max((one.points.height for one in series), default=0)
    if most >= FEWEST_RUNS or any(not one.need for one in parameters):
        return "nothing moved beyond the threshold"
    return (
        f"nothing could be tested: a change of slip takes {FEWEST_RUNS} runs, the most of a group is {most}; "
        "one of a parameter four runs on one ground"
    )


def say_step(series: Series, step: LevelChange) -> str:
    """What moved from what to what."""
    unit = f" {series.unit}" if series.unit not in ("", "1") else ""
    return f"{series.quantity} of {series.group} {step.before:.3g} -> {step.after:.3g}{unit}"


def describe_step(series: Series, step: LevelChange) -> str:
    """A step in a sentence: whose quantity moved from what to what, since when, how sure."""
    return (
        f"{say_step(series, step)} since {step.since} ({step.runs_before} runs before, {step.runs_after} "
        f"since, p = {step.p:.2g})"
    )


def _can_step(rows: pl.DataFrame) -> bool:
    return rows.height >= FEWEST_RUNS and rows["value"].n_unique() > 1


def _find_steps(points: pl.DataFrame, level: float) -> tuple[LevelChange, ...]:
    changes = find_changes(points["value"].to_numpy(), level=level)
    edges = [0, *(change.index for change in changes), points.height]
    orders = points["order"].to_list()
    return tuple(
        LevelChange(
            since=points["day"][change.index],
            run=points["run"][change.index],
            earliest=orders[max(change.index - 2, 0)] + 1,
            latest=orders[min(change.index + 1, len(orders) - 1)],
            before=change.before,
            after=change.after,
            runs_before=edges[i + 1] - edges[i],
            runs_after=edges[i + 2] - edges[i + 1],
            p=change.p,
        )
        for i, change in enumerate(changes)
    )


@dataclass(frozen=True)
class Trend:
    """Series of groups, parameters of vehicles, what to look at, what must be known, what was asked."""

    series: tuple[Series, ...]
    parameters: tuple[ParameterTrend, ...]
    alerts: tuple[Alert, ...]
    keys: tuple[str, ...]
    notes: tuple[str, ...]
    asked: Mapping[str, object]
