"""What is known of an effect stands in its own file, and nowhere else."""

import ast
import math
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.cli.verbs_drives import list_written_effects
from pipeline.models import Effect, list_effects
from pipeline.models.catalogue import find_late_effect, format_effect
from pipeline.models.effect import Late
from pipeline.models.parameter import Conditions, Largest, is_of_one_run, parse_unit
from pipeline.simulate import list_effects as list_simulated

EFFECTS = list_effects()
BY_ID = {effect.id: effect for effect in EFFECTS}
SIMULATED = {spec.id: spec for spec in (*list_simulated(), *list_written_effects())}
SOURCES = Path(__file__).parents[2] / "pipeline"
OWN = SOURCES / "models" / "effects"
GENERIC = sorted(
    path
    for path in SOURCES.rglob("*.py")
    # What others published under a name is a set of effects.
    if OWN not in path.parents and SOURCES / "simulate" not in path.parents and path.name != "literature.py"
)
# Parameters of other people's controllers that are called as an effect is.
NAMESAKES = {
    "sources/recognition.py": {"'wheel_radius'"},
    # An element of Gazebo's DiffDrive and AckermannSteering.
    "export/gazebo.py": {"'wheel_radius'"},
}
ASKED = Largest(1.5, 1.2, 9.0, 8.0, np.linspace(0.0, 300.0, 11))


def list_mentions(path: Path) -> list[str]:
    """Effects that a file's logic knows: by their ids as text, or by importing their files."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in BY_ID:
            found.append(f"line {node.lineno}: {node.value!r}")
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        module = f"{node.module}." if isinstance(node, ast.ImportFrom) and node.module else ""
        found += [
            f"line {node.lineno}: imports {module}{name}"
            for name in names
            if f"{module}{name}".startswith("pipeline.models.effects.")
        ]
    return found


@pytest.mark.lint
def test_no_generic_file_knows_an_effect() -> None:
    knowing = {
        name: [line for line in list_mentions(path) if line.split(": ")[1] not in NAMESAKES.get(name, ())]
        for path in GENERIC
        if (name := str(path.relative_to(SOURCES)))
    }
    assert {path: lines for path, lines in knowing.items() if lines} == {}


@pytest.mark.parametrize("effect", EFFECTS, ids=list(BY_ID))
def test_what_an_effect_says_of_itself_holds(effect: type[Effect]) -> None:
    check_page(effect)
    check_sizes(effect)
    check_relations(effect)
    spec = SIMULATED[effect.id]
    assert {p.name: p.unit for p in effect.parameters} == {p.name: p.unit for p in spec.parameters}
    assert effect.kinds == spec.kinds
    usual = effect().make_usual(ASKED)
    assert not usual.is_neutral
    assert not usual.is_degenerate(Conditions(ASKED, encoders=True, gyro=True))


def check_page(effect: type[Effect]) -> None:
    """It names formula, parameters, units and source."""
    page = effect.find_page()
    assert "Source: " in page
    assert re.search(r"^ {4}\S", page, flags=re.MULTILINE), "the page has no indented formula"
    for parameter in effect.parameters:
        parse_unit(parameter.unit, effect.id)
        assert re.search(rf"\b{re.escape(parameter.name)}\b", page), parameter.name
        if parameter.unit != "1":
            assert f"[{parameter.unit}]" in page, parameter.unit
        low, high = parameter.bounds
        assert low < high
        assert low <= parameter.typical <= high
        assert (
            math.isnan(parameter.neutral) or math.isinf(parameter.neutral) or low <= parameter.neutral <= high
        )


def check_sizes(effect: type[Effect]) -> None:
    """They have reasons and fit each other."""
    page = format_effect(effect)
    for reading in effect.readings:
        assert reading.text in page
    assert len({reading.level for reading in effect.readings}) == len(effect.readings)
    for parameter in effect.parameters:
        low, high = parameter.bounds
        if parameter.least is not None:
            assert 0.0 < parameter.least.size < abs(parameter.typical - parameter.neutral)
            assert parameter.least.reason in page
        if parameter.plausible is not None:
            assert low <= parameter.plausible.low < parameter.plausible.high <= high
            assert parameter.plausible.low <= parameter.typical <= parameter.plausible.high
            assert parameter.plausible.source in page
        if not is_of_one_run(effect.parameters):
            assert 0.0 < parameter.spread.size < parameter.usual_size
            assert parameter.spread.source in page
        if parameter.one_sign:
            assert parameter.typical > parameter.neutral
        if parameter.instead_of:
            assert math.isnan(effect().parameter(parameter.instead_of).neutral)


def check_relations(effect: type[Effect]) -> None:
    """They hold on both sides."""
    assert set(effect.confused_with) | set(effect.equivalent_to) <= BY_ID.keys() - {effect.id}
    assert bool(effect.equivalent_to) == bool(effect.equivalent_when)
    assert set(effect.contains) <= BY_ID.keys() - {effect.id}
    assert all(effect.id in BY_ID[name].same_in_one_motion for name in effect.same_in_one_motion)
    assert all(effect.id in BY_ID[name].equivalent_to for name in effect.equivalent_to)
    for part in effect.parts:
        assert part.name in {p.name for p in effect.parameters}
        assert part.parameter in {p.name for p in BY_ID[part.effect].parameters}
    simpler = effect().collapse()
    assert simpler is None or simpler.id in effect.contains
    assert all(other.id in BY_ID for other in effect().list_softer(ASKED))


def test_every_delay_that_sensors_know_is_one_effect() -> None:
    for late in Late:
        (effect,) = [effect for effect in EFFECTS if effect.late is late]
        assert find_late_effect(late) is effect
        assert effect.of_delay(0.1).delay == 0.1
        assert effect.of_delay(1e3).delay == effect.parameters[0].bounds[1]


def test_parts_that_are_found_together_make_the_whole() -> None:
    whole = next(effect for effect in EFFECTS if effect.parts)
    values = {part.effect: (part.parameter, 0.1 * number) for number, part in enumerate(whole.parts, start=1)}
    joined = whole.join({name: BY_ID[name](**dict([value])) for name, value in values.items()})
    assert joined.searched_as == values.keys()
    assert list(joined.values.values()) == [-0.1, -0.2]
