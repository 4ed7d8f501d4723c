"""Diagnoses of runs with what the results do not hold as data, and their tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from pipeline.core import JSON_DIGITS, finite_or_none, pick_finite
from pipeline.results import Errors, EstimatedNumber, Json, RunDiagnosis, Step

if TYPE_CHECKING:
    import polars as pl

    from pipeline.models import ModelFile


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one run, or of several of one vehicle together.

    Attributes:
        runs: one each.
        proposal: model file with the identified effects, fitted; None where no model could be judged.
        estimates: parameters of all effects that these runs determine.
    """

    runs: tuple[RunDiagnosis, ...]
    proposal: ModelFile | None = None
    estimates: tuple[EstimatedNumber, ...] = ()

    def tabulate(self, table: str, run: str) -> pl.DataFrame:
        """One run's rows of `ladder`, `parameters`, `budget` or `estimates` (without the run's own columns).

        Steps and noise floor, values of named effects, causes of slip and errors, estimates of all effects.
        """
        from schemas import tabulate  # noqa: PLC0415 - heavy

        if table == "estimates":
            return tabulate(table, [msgspec.structs.asdict(number) for number in self.estimates])
        return tabulate(table, [row for item in self.runs if item.run == run for row in _ROWS[table](item)])


def _ladder_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    rows: list[dict[str, Json]] = []
    before: set[str] = set()
    rungs: list[tuple[str, Errors]] = [("rung", step) for step in item.ladder]
    if item.noise_floor is not None:
        rungs.append(("floor", item.noise_floor))
    for number, (kind, step) in enumerate(rungs):
        names = step.effects if isinstance(step, Step) else ()
        x, y, w = map(_clean, step.velocity_rms)
        rows.append(
            {
                "input": item.input,
                "rung": number,
                "added": ", ".join(name for name in names if name not in before),
                "effects": ", ".join(names),
                "rms_x": x,
                "rms_y": y,
                "rms_w": w,
                "t_mrmse": _clean(step.t_mrmse_m),
                "r_mrmse": _clean(step.r_mrmse_rad),
                "explained_share": _clean(step.explained_share) if isinstance(step, Step) else None,
                "kind": kind,
            }
        )
        before |= set(names)
    return rows


def _parameter_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    return [
        {
            "input": item.input,
            "effect": effect.id,
            "parameter": name,
            **_cut(value, "value", "low", "high"),
            "unit": value.unit,
            "at_bound": value.at_bound,
            "doubt": value.doubt,
        }
        for effect in item.effects
        for name, value in effect.parameters.items()
        if math.isfinite(value.value)
    ]


def _budget_rows(item: RunDiagnosis) -> list[dict[str, Json]]:
    return [
        {
            "input": budget.input,
            "quantity": budget.quantity,
            "kind": kind,
            "name": share.effect,
            "mean_square": share.share * budget.total,
            "unit": budget.unit,
            **_cut(share, "share", "low", "high", "alone", "last"),
            "stretches": budget.stretches,
        }
        for budget in item.budget
        for kind, share in budget.causes
    ]


_ROWS: Mapping[str, Callable[[RunDiagnosis], list[dict[str, Json]]]] = {
    "ladder": _ladder_rows,
    "parameters": _parameter_rows,
    "budget": _budget_rows,
}


def _clean(value: float) -> float | None:
    """A number as in JSON: six digits, null where it is not finite."""
    return finite_or_none(value, JSON_DIGITS)


def _cut(item: object, *names: str) -> dict[str, Json]:
    return {**pick_finite(item, *names, digits=JSON_DIGITS)}
