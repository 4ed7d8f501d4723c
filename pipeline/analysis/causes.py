"""Deployments compared by cause: from the results to the answer of `slip compare --causes`, and its files."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from pipeline.analysis.compare_files import write_figures, write_tables
from pipeline.analysis.compared_runs import find_material, keep_runs
from pipeline.analysis.errors import lack_runs
from pipeline.analysis.fleet import fit_results
from pipeline.analysis.options import FigureFormat
from pipeline.core.numbers import finite_or_none, pick, pick_finite
from pipeline.fleet.causes import Budget, Causes, Difference, compare_causes
from pipeline.store import Store

_EFFECT = "effect"


def find_causes(store: Store, by: Sequence[str], chosen: str | None) -> Causes:
    """Compare the datasets of the results by cause; nothing is written.

    Args:
        store: the results.
        by: columns that make a dataset.
        chosen: what u is; None: the command where every run has a budget on it, else the measured wheels.

    Raises:
        JobError: ``nothing_to_compare``.
        ComparisonError: ``no_such_column``.
    """
    compared = find_material(store, by, trusted_only=True, tables=("budget", "estimates"))
    rows = pl.DataFrame()
    if compared.manifests:
        rows = (
            compared.scan("budget")
            .filter(pl.col("quantity").cast(pl.String) == "slip")
            .with_columns(pl.col("input", "kind").cast(pl.String))
            .collect()
            .join(compared.labels.select("run", "group"), on="run")
        )
    if rows.is_empty():
        hint = "Analyze logs with their diagnosis: slip analyze LOG... --terrain NAME."
        what = "no run has a budget of its slip"
        raise lack_runs("nothing_to_compare", what, store.root, hint, compared.notes)
    on_command = rows.filter(pl.col("input") == "command")["run"].n_unique()
    source = chosen or ("command" if on_command == rows["run"].n_unique() else "measured")
    own = rows.filter(pl.col("input") == source)
    compared = keep_runs(compared, own["run"].unique().to_list(), f"no budget of its slip on {source}")
    if own.is_empty():
        what = f"no run has a budget of its slip on {source}"
        raise lack_runs("nothing_to_compare", what, store.root, "Choose the other input.")
    budgets, differences = compare_causes(own)
    keys = tuple(f"{run}/{manifest.key}" for run, manifest in sorted(compared.manifests.items()))
    return Causes(budgets, differences, source, _find_names(store), keys, compared.notes)


def _find_names(store: Store) -> dict[str, str]:
    """Effects that the fleet calls by another name at their level, or by all that they could have."""
    found: dict[str, set[str]] = {}
    for number in fit_results(store)[0].numbers:
        found.setdefault(number.effect, set()).add(number.name)
    called = {
        effect: name for effect, names in found.items() for name in names if names == {name} != {effect}
    }
    return called | {"localization_noise": "localization noise"}


def describe_causes(causes: Causes) -> dict[str, object]:
    """The JSON object of `slip compare --causes`."""
    return {
        "input": causes.input,
        "budgets": [_describe_budget(budget, causes.names) for budget in causes.budgets],
        "differences": [
            {
                **pick(one, "a", "b", "total"),
                "unit": "m/s",
                "by_effect": [
                    {
                        _EFFECT: part.name,
                        "name": causes.names.get(part.name, part.name),
                        "difference": part.difference,
                        **pick_finite(part, "low", "high", "p", "p_adjusted"),
                    }
                    for part in one.parts
                ],
                "unit_of_analysis": one.unit,
                "note": one.note or None,
                "sentence": say_difference(one, causes.names),
            }
            for one in causes.differences
        ],
        "notes": list(causes.notes),
    }


def _describe_budget(budget: Budget, names: Mapping[str, str]) -> dict[str, object]:
    numbers = {part.name: {"share": part.share, **pick_finite(part, "low", "high")} for part in budget.parts}
    return {
        **pick(budget, "dataset", "runs", "total"),
        "unit": "m^2/s^2",
        "rms": math.sqrt(budget.total),
        "shares": [
            {_EFFECT: part.name, "name": names.get(part.name, part.name), **numbers[part.name]}
            for part in budget.parts
            if part.kind == _EFFECT
        ],
        **{part.name: numbers[part.name] for part in budget.parts if part.kind != _EFFECT},
        "unit_of_analysis": budget.unit,
    }


def say_difference(one: Difference, names: Mapping[str, str]) -> str:
    """A difference in words, effects by the names of their levels."""
    return one.describe({part.name: names.get(part.name, part.name) for part in one.parts})


def write_causes(store: Store, causes: Causes, figures: FigureFormat | None = None) -> dict[str, Path]:
    """Write `causes` and `cause_differences` as CSV and LaTeX, and `causes.html`; the files by name.

    Args:
        store: the results.
        causes: as of `find_causes`.
        figures: also write the figure to `figures/` in this format.
    """
    from pipeline.report.causes import draw_causes, render_causes  # noqa: PLC0415 - heavy
    from pipeline.report.pages import write_page  # noqa: PLC0415 - heavy

    written: dict[str, Path] = {}
    for name, frame in (
        ("causes", _tabulate_budgets(causes)),
        ("cause_differences", _tabulate_pairs(causes)),
    ):
        written |= write_tables(store, name, frame, frame)
    sentences = [
        say_difference(one, causes.names) + (f" ({one.note})" if one.note else "")
        for one in causes.differences
    ]
    written["causes.html"] = write_page(store, "causes.html", render_causes(causes, sentences))
    return written | write_figures(store, lambda: [draw_causes(causes.budgets, causes.names)], figures)


def _tabulate_budgets(causes: Causes) -> pl.DataFrame:
    rows = [
        (one.dataset, one.runs, causes.names.get(part.name, part.name), part.share, finite_or_none(part.low),
         finite_or_none(part.high), math.sqrt(one.total))
        for one in causes.budgets
        for part in one.parts
    ]  # fmt: skip
    numbers = dict.fromkeys(("share", "low", "high", "rms"), pl.Float64)
    schema = {"dataset": pl.String, "runs": pl.Int64, "cause": pl.String, **numbers}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _tabulate_pairs(causes: Causes) -> pl.DataFrame:
    rows = [
        (one.a, one.b, causes.names.get(part.name, part.name), part.difference, finite_or_none(part.low),
         finite_or_none(part.high), finite_or_none(part.p), finite_or_none(part.p_adjusted), one.unit)
        for one in causes.differences
        for part in one.parts
    ]  # fmt: skip
    numbers = dict.fromkeys(("difference", "low", "high", "p", "p_adjusted"), pl.Float64)
    texts = dict.fromkeys(("a", "b", "cause"), pl.String)
    return pl.DataFrame(rows, schema={**texts, **numbers, "unit_of_analysis": pl.String}, orient="row")
