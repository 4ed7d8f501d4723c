"""What follows from a result: refusals, the effects that count, and the distance to the noise floor."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from pipeline.core import (
    JSON_DIGITS,
    mapping_in,
    number_in,
    objects_in,
    round_digits,
    round_numbers,
)
from pipeline.recording import FAULTS, Finding
from pipeline.results.structs import Errors, Named, RunDiagnosis, Step
from pipeline.run import GROUND_UNOBSERVABLE

if TYPE_CHECKING:
    import polars as pl

    from pipeline.models import Effect, ModelFile
    from pipeline.sources import Vehicle
    from pipeline.store import JSON


ERRORS_OVER_2S: Final = {"t_mrmse_m": ("position", "m"), "r_mrmse_rad": ("heading", "rad")}
"""Quantity and unit by name in `Errors` and in JSON."""
NOTHING = 1e-3
"""Relative increase below which an error counts as unchanged: rounding of fits."""
# Two fits of one model differ by as much on other folds: a step may raise one error by this share.
CHANCE = 1e-2
"""Relative change of an error over 2 s below which it is chance: the smallest relevant one, as
`LEAST_GAIN`."""
FATAL = ("not_moving", "pose_from_wheels", *FAULTS)
"""Findings of which one makes every fit meaningless: no effect is named."""
CHANGE = "changing_number"
"""The finding of a run during which a number of the model changes."""
SEARCH_CUT = "search_cut"
"""The finding of a run whose budget ended the search for effects before it was complete."""
BREVITY = "little_driving"
"""Finding of a run with less driving than effects can be trusted on."""
ABOVE_FLOOR = 1.5
"""Factor over the (estimated) noise floor above which an error over 2 s is not noise."""
DETECTED_SHARE = 90
"""Share of logs with an effect of the size of a detection limit in which it is named [percent]."""
INTERVAL_SHARE = 0.05
"""Target half-width of a 95 % interval as a share of the parameter's size."""
_MAIN_SHARE = 0.1
"""Of an error of the ideal model: an effect that removes less of every one is a smaller one."""


def read_findings(content: Mapping[str, object]) -> tuple[Finding, ...]:
    """The ``findings`` of a run's JSON object."""
    return tuple(map(_read_finding, objects_in(content, "findings")))


def read_finding_table(table: pl.DataFrame) -> tuple[Finding, ...]:
    """The findings of a run's table; of one that has sentences alone, by these."""
    rows = list(table.iter_rows(named=True))
    said = [parse_values(row["values"]) if "values" in row else {"error": row["text"]} for row in rows]
    return tuple(_read_finding({**row, "values": values}) for row, values in zip(rows, said, strict=True))


def parse_values(text: object) -> JSON:
    """The values of a finding from their column; empty where it is no JSON."""
    try:
        return cast("JSON", json.loads(str(text)))
    except (ValueError, RecursionError):
        return {}


def _read_finding(content: Mapping[str, object]) -> Finding:
    severity = content.get("severity")
    return Finding(
        str(content.get("id") or ""),
        "error" if severity == "error" else "warning" if severity == "warning" else "info",
        str(content.get("where") or ""),
        mapping_in(content, "values"),
        t_start=number_in(content, "t_start"),
        t_end=number_in(content, "t_end"),
    )


def key_finding(finding: Finding) -> tuple[str, str, str]:
    """By what two findings are compared: id, place and values, these as JSON has them."""
    return finding.id, finding.where, json.dumps(round_numbers(finding.values), sort_keys=True)


def find_refusal(findings: Iterable[Finding]) -> Finding | None:
    """The finding that makes every fit to a run meaningless; None where there is none."""
    return next((one for one in findings if one.id in FATAL), None)


def has_no_pose(findings: Iterable[Finding]) -> bool:
    """Whether the log of a run holds no pose, so that only its drivetrain is observable."""
    return any(one.id == GROUND_UNOBSERVABLE for one in findings)


def read_model(run: RunDiagnosis) -> ModelFile | None:
    """The model file that a diagnosis proposes; None without a readable one."""
    from pipeline.models import parse_model  # noqa: PLC0415 - heavy
    from pipeline.run import MotionError  # noqa: PLC0415 - heavy

    try:
        return None if run.model is None else parse_model(run.model, Path("diagnosis.toml"))
    except MotionError:
        return None


def read_suggestion(run: RunDiagnosis, vehicle: Vehicle) -> tuple[Effect, ...]:
    """The formula that a diagnosis suggests for what no effect explains; empty without one.

    Args:
        run: the diagnosis.
        vehicle: its vehicle.
    """
    from pipeline.models import Model, ModelFile, format_model, parse_model  # noqa: PLC0415 - heavy

    text = None if run.unexplained is None else run.unexplained.formula
    if text is None:
        return ()
    return parse_model(format_model(ModelFile(Model(vehicle))) + text, Path("diagnosis.toml")).model.effects


def read_diagnosed(run: RunDiagnosis, vehicle: Vehicle) -> tuple[Effect, ...]:
    """What a diagnosis names, and the formula that it suggests, with their values."""
    file = read_model(run)
    return (*(() if file is None else file.model.effects), *read_suggestion(run, vehicle))


def list_added(before: Step, after: Step) -> list[str]:
    """Ids of the effects that a step of the ladder has beyond the one below."""
    return [name for name in after.effects if name not in before.effects]


def rank_effects(run: RunDiagnosis) -> dict[str, float]:
    """Effects in the order in which they are listed everywhere: that of the ladder.

    Returns:
        The largest share of an error of the ideal model that each removes, by id: of the errors over 2 s at
        its step of the ladder, and of every error budget of the leading input.
    """
    shares: dict[str, float] = {}
    for before, after in pairwise(run.ladder):
        falls = [
            fall
            for key in ERRORS_OVER_2S
            if (ideal := getattr(run.ladder[0], key))
            and math.isfinite(fall := (getattr(before, key) - getattr(after, key)) / ideal)
        ]
        for name in list_added(before, after):
            shares.setdefault(name, max(falls, default=0.0))
    for budget in run.budget:
        for one in budget.shares:
            if budget.input == run.input and one.effect in shares and math.isfinite(one.share):
                shares[one.effect] = max(shares[one.effect], one.share)
    return shares


def rank_main(run: RunDiagnosis) -> dict[str, float]:
    """Those of `rank_effects` that remove a tenth of an error, at least the largest one."""
    ranked = rank_effects(run)
    least = min(_MAIN_SHARE, round_digits(max(ranked.values(), default=0.0), JSON_DIGITS))
    return {name: share for name, share in ranked.items() if round_digits(share, JSON_DIGITS) >= least}


def split_main(effects: Sequence[Named], run: RunDiagnosis) -> tuple[list[Named], list[Named]]:
    """The effects of `rank_main` with those that stand out (`Named.stands_out`), and the smaller effects.

    Returns:
        Main and smaller effects in their order; where `rank_main` lists none, all are main.
    """
    first = rank_main(run)
    if not first.keys() & {effect.id for effect in effects}:
        return list(effects), []
    main = [effect for effect in effects if effect.id in first or effect.stands_out]
    return main, [effect for effect in effects if effect not in main]


def is_small(name: str | None, run: RunDiagnosis) -> bool:
    """Whether the ladder contains an effect that `rank_main` does not list."""
    return name in rank_effects(run).keys() - rank_main(run).keys()


def list_excess(run: RunDiagnosis) -> dict[str, float]:
    """The errors of the last step over the noise floor, where that is known."""
    last, floor = run.ladder[-1], run.noise_floor or Errors()
    return {
        key: getattr(last, key) / least
        for key in ERRORS_OVER_2S
        if (least := getattr(floor, key)) > 0.0 and math.isfinite(getattr(last, key))
    }


def measure_excess(run: RunDiagnosis) -> float:
    """The larger error of the last step over its noise floor; 0 where that is not known."""
    return max(list_excess(run).values(), default=0.0) if run.ladder else 0.0


def read_error(errors: object, name: str) -> float:
    """An error by its name; NaN if unknown."""
    value = errors.get(name) if isinstance(errors, Mapping) else getattr(errors, name)
    return float(value) if isinstance(value, int | float) else math.nan


def as_written(errors: object, name: str) -> float:
    """An error with the digits that JSON has; NaN if unknown."""
    return round_digits(read_error(errors, name), JSON_DIGITS)


def list_rises(below: object, errors: object, forgiven: float = NOTHING) -> tuple[str, ...]:
    """Names in `ERRORS_OVER_2S` of the errors that rise in a step; unknown errors do not rise.

    They are compared as they are written, so that screen and page agree.

    Args:
        below: errors before the step, or the step in JSON.
        errors: errors after it.
        forgiven: tolerated relative increase, by default that of rounding.
    """
    return tuple(
        name
        for name in ERRORS_OVER_2S
        if as_written(errors, name) > as_written(below, name) * (1.0 + forgiven)
    )


BUDGET_SLIP = "RMS slip over half a second"
"""What budgets of slip share out: the square root of their totals."""
CAUSE_NAMES = {"localization_noise": "localization noise"}
"""Causes of an error budget in words, where these differ from the id."""
