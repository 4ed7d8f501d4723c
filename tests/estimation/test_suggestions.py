"""What is suggested, written and left out: no place, no time, nothing that raises the error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from verbs import run_verb

from pipeline.estimation.ladder import lowers_errors, raises_errors
from pipeline.estimation.largest import _is_one_speed
from pipeline.estimation.terms import list_terms
from pipeline.models import Model, read_model
from pipeline.models.formula import FormulaEffect
from pipeline.results import Errors
from pipeline.sources import find_preset

SHARED = Path(__file__).parents[3] / "shared"
HUSKY = find_preset("husky_a200")
assert HUSKY is not None
# Errors over 2 s: position, heading.
Pair = tuple[float, float]


def errors_of(pair: Pair) -> Errors:
    position, heading = pair
    same = (0.1, 0.1, 0.1)
    return Errors(same, same, position, heading, position, heading, position, heading, 10)


@pytest.mark.parametrize("more", [False, True])
def test_no_term_of_a_formula_depends_on_place_or_time(*, more: bool) -> None:
    for term in list_terms(sideways=more, wheels=more):
        names = {name for one in term().expressions.values() for name in one.names}
        assert not {name.removesuffix("_rate") for name in names} & {"x", "y", "t"}, term.id


def test_an_effect_raises_or_lowers_the_errors_by_one_rule() -> None:
    for after, raises, lowers in [
        ((1.032, 1.17), True, False),
        ((1.002, 1.002), True, False),
        ((1.02, 1.0), True, False),
        ((1.0, 1.02), True, False),
        ((1.005, 1.0), False, False),
        ((1.0, 1.0), False, False),
        ((0.995, 1.0), False, False),
        ((0.98, 1.0), False, True),
        ((1.03, 0.91), False, True),
        ((1.03, 0.997), True, False),
        ((1.12, 0.98), False, False),
    ]:
        before = errors_of((1.0, 1.0))
        assert raises_errors(before, errors_of(after)) is raises
        assert lowers_errors(before, errors_of(after)) is lowers


def test_commands_of_one_speed_are_told_by_their_spread() -> None:
    for speeds, is_one in [
        ([0.0, 0.1, 0.1, 0.1, 0.0], True),
        ([0.0] * 30 + [0.05] + [0.1] * 40, True),
        ([1.0] * 20 + [0.9] * 20, True),
        ([0.1] * 10 + [0.2] * 10 + [0.3] * 10, False),
        (list(np.linspace(0.0, 1.0, 50)), False),
        ([0.0, 0.0], False),
        ([], False),
    ]:
        fastest = np.array(speeds, dtype=float)
        assert _is_one_speed(fastest) is is_one


def diagnose(log: Path, folder: Path) -> tuple[dict[str, Any], Model]:
    """The JSON object of one run, and the model that was written."""
    if not log.is_file():
        pytest.skip(f"{log} is not here: recordings are not part of the repository")
    target = folder / "model.toml"
    asked = ["diagnose", str(log), "--results", str(folder / "out"), "--json", "--apply", str(target)]
    (run,) = json.loads(run_verb(*asked).stdout)["runs"]
    return run, read_model(target).model


def test_at_one_commanded_speed_a_limit_and_a_gain_are_undecided(tmp_path: Path) -> None:
    """The screen said `commands are clipped at .089 m/s`; at .2 and .3 m/s the same floor told another."""
    run, _ = diagnose(SHARED / "published" / "robotino_surfaces" / "table_06.mcap", tmp_path)
    (group,) = [one for one in run["undecided"] if "drive_gain" in one["candidates"]]
    assert "body_speed_limit" in group["candidates"]
    assert "several speeds" in group["separate_by"]
    assert not {"drive_gain", "body_speed_limit"} & {one["id"] for one in run["effects"]}


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        *(f"cases/hills/{name}" for name in ("a2_human", "g_sideslope", "j_grade_additive")),
        *(
            f"published/optiodom_tricycle/tri_{name}"
            for name in ("free_140120211525_1", "square_140120211446_1")
        ),
        "published/robotino_surfaces/green_24",
    ],
)
def test_the_written_model_has_no_formula_and_no_effect_that_raises_its_errors(
    name: str, tmp_path: Path
) -> None:
    run, model = diagnose(SHARED / f"{name}.mcap", tmp_path)
    assert not any(isinstance(effect, FormulaEffect) for effect in model)
    assert set(model.ids) == set(run["ladder"][-1]["effects"])
    if len(run["ladder"]) > 1:
        assert not raises_errors(*run["ladder"][-2:])
