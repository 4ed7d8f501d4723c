"""The fleet model of the results: fitted to the estimates of all runs, written, and read again."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import polars as pl

from pipeline.analysis.compared_runs import ComparedRuns, find_material, read_digest
from pipeline.analysis.errors import JobError, lack_runs
from pipeline.core.numbers import finite_or_none, pick
from pipeline.fleet.hierarchy import FleetModel, FleetNumber
from pipeline.fleet.statistics.intervals import Interval
from pipeline.store import Store

FLEET = "fleet.json"
_TABLES = ("estimates",)
_EVERY = "*"
_NAME_EFFECTS = "Name the effects of its logs: slip batch LOGS --diagnosis"


def fit_results(store: Store) -> tuple[FleetModel, tuple[str, ...]]:
    """Fit the fleet model of the results; it, and runs with the keys of their results.

    Args:
        store: the results.

    Raises:
        JobError: ``nothing_to_fit``: no run has estimates, or none is on a known terrain.
    """
    from pipeline.fleet.hierarchy import FleetModel, fit_fleet  # noqa: PLC0415 - heavy

    compared = _find_runs(store)
    if not compared.manifests:
        raise lack_runs("nothing_to_fit", "no run has estimates", store.root, _NAME_EFFECTS, compared.notes)
    model = fit_fleet(compared.scan("estimates").collect())
    notes = (*compared.notes, *model.notes)
    return FleetModel(model.numbers, model.runs, notes), _list_keys(compared)


def find_estimates(store: Store, *, without: Sequence[str] = ()) -> pl.DataFrame:
    """Rows of `estimates` of the runs that a fleet model takes.

    Args:
        store: the results.
        without: SHA-256 of recordings that do not count: what is to be predicted is not known.

    Raises:
        JobError: ``nothing_to_fit``: there are none.
    """
    compared = _find_runs(store)
    known = {
        run: manifest for run, manifest in compared.manifests.items() if read_digest(manifest) not in without
    }
    if not known:
        what = "no other run has estimates" if compared.manifests else "no run has estimates"
        raise lack_runs("nothing_to_fit", what, store.root, _NAME_EFFECTS)
    return compared.scan("estimates").filter(pl.col("run").is_in(list(known))).collect()


def _find_runs(store: Store) -> ComparedRuns:
    return find_material(store, ("vehicle",), trusted_only=True, tables=_TABLES)


def _list_keys(compared: ComparedRuns) -> tuple[str, ...]:
    return tuple(f"{run}/{manifest.key}" for run, manifest in sorted(compared.manifests.items()))


def write_fleet(store: Store, model: FleetModel, keys: tuple[str, ...]) -> Path:
    """Write `fleet.json`, the table `fleet` and the page; the path of the first."""
    from pipeline.report.fleet import render_fleet  # noqa: PLC0415 - heavy
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy

    store.write_results_table("fleet", tabulate_fleet(model, keys))
    content = {**describe_fleet(model), "keys": list(keys)}
    write_page(store, "fleet.html", render_fleet(content))
    return store.write_results_text(FLEET, json.dumps(content, indent=1, allow_nan=False) + "\n")


def update_fleet(store: Store) -> None:
    """Fit the fleet model anew where one was fitted before; nothing else is done.

    Results without any run that tells of it keep the model they have.
    """
    if (store.root / FLEET).is_file():
        with contextlib.suppress(JobError):
            write_fleet(store, *fit_results(store))


def read_fleet(store: Store) -> dict[str, object]:
    """The JSON object of the fleet model that was written last; `notes` say where results have changed since.

    Raises:
        JobError: ``no_fleet``: none was written, or it cannot be read.
    """
    path = store.root / FLEET
    hint = f"Fit it: slip fleet fit {store.root}"
    if not path.is_file():
        raise JobError("no_fleet", "no fleet model was fitted to these results", where=str(path), hint=hint)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        known = set(content["keys"])
        notes = list(content["notes"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError("no_fleet", "the fleet model cannot be read", where=str(path), hint=hint) from error
    now = set(_list_keys(_find_runs(store)))
    if now != known:
        notes.append(f"{len(now ^ known)} results have changed since: slip fleet fit brings it up to date")
    return {**content, "notes": notes}


def describe_fleet(model: FleetModel) -> dict[str, object]:
    """The JSON object of `slip fleet fit`."""
    return {
        "parameters": [_describe_number(number) for number in model.numbers],
        "resolved": [
            {
                "vehicle": number.vehicle,
                "parameter": number.label,
                "candidates": list(number.candidates),
                "answer": None if number.level is None else number.name,
                "because": number.because,
            }
            for number in model.numbers
            if len(number.candidates) > 1
        ],
        "runs": {vehicle: list(runs) for vehicle, runs in model.runs.items()},
        "notes": list(model.notes),
    }


def _describe_number(number: FleetNumber) -> dict[str, object]:
    fit = number.fit
    return {
        **pick(number, "effect", "parameter", "unit", "vehicle"),
        "level": None if number.level is None else number.level.value,
        "name": number.name,
        "because": number.because,
        "value": fit.value,
        **_bounds(number, fit.interval),
        "spread_terrain": finite_or_none(fit.spread_group),
        "spread_run": finite_or_none(fit.spread_run),
        "chi_square": finite_or_none(fit.chi_square),
        "p_terrain": finite_or_none(fit.p_groups),
        "terrains": {
            name: {"value": mean.value, **_bounds(number, mean.interval), "runs": mean.runs}
            for name, mean in fit.groups.items()
        },
        "runs": len(number.runs),
        "named": number.named,
        "odd": list(number.odd),
    }


def tabulate_fleet(model: FleetModel, keys: tuple[str, ...]) -> pl.DataFrame:
    """The table `fleet`."""
    from schemas import contract_of  # noqa: PLC0415 - brings a table library along

    rows: list[Mapping[str, object]] = []
    for number in model.numbers:
        told = _describe_number(number)
        whose = {"run": _EVERY, "dataset": _EVERY, "terrain": _EVERY, "keys": " ".join(keys)}
        rows.append({**told, **whose, "level": told["level"] or "open"})
        terrains = cast("Mapping[str, Mapping[str, object]]", told["terrains"])
        rows += [{**rows[-1], "named": None, "terrain": name, **mean} for name, mean in terrains.items()]
    return pl.DataFrame(rows, schema=contract_of("fleet").schema.create_empty().schema)


def _bounds(number: FleetNumber, interval: Interval | None) -> dict[str, float | None]:
    """Ends of an interval, within what the number can be."""
    from pipeline.models import find_effect  # noqa: PLC0415 - heavy
    from pipeline.models.bounds import cut_interval  # noqa: PLC0415 - heavy

    if interval is None:
        return {"low": None, "high": None}
    bounds = find_effect(number.effect)().parameter(number.parameter).bounds
    low, high = cut_interval(interval.low, interval.high, bounds)
    return {"low": low, "high": high}
