"""What is promised of every effect: nothing at neutral values, its formula, numbers that come back, facts."""

import ast
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from motion_runs import simulate, vehicle_of

from pipeline.cli.verbs_drives import list_written_effects
from pipeline.estimation import EstimationData, Input, estimate_intervals, fit_model
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.models import Effect, LinearEffect, Model, Place, Timing, list_effects
from pipeline.models.catalogue import find_late_effect, format_page
from pipeline.models.effect import Excitation, KinematicEffect, Late
from pipeline.models.expression import parse_expression
from pipeline.models.families import check_formula
from pipeline.models.pairs import list_pairs
from pipeline.models.parameter import Conditions, Largest, is_of_one_run, parse_unit
from pipeline.run import MotionRun
from pipeline.run.signals import Rolling, Velocity, Wheels, find_turning
from pipeline.simulate import VEHICLES, Encoders, Ground, Program
from pipeline.simulate import list_effects as list_simulated

EFFECTS = list_effects()
BY_ID = {effect.id: effect for effect in EFFECTS}
WRITTEN_EFFECTS = list_written_effects()
SIMULATED = {spec.id: spec for spec in (*list_simulated(), *WRITTEN_EFFECTS)}
KIND_OF = {"differential": "husky_a200", "ackermann": "ackermann_car", "mecanum": "youbot"}


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
    # Findings of a clock and of a frame, which are called as the effect that they correct.
    "words/findings.py": {"'clock_offset'", "'heading_skew'"},
}
ASKED = Largest(1.5, 1.2, 9.0, 8.0, np.linspace(0.0, 300.0, 11))


def ids(effects: tuple[type[Effect], ...]) -> list[str]:
    return [effect.id for effect in effects]


@cache
def plain_run(kind: str) -> MotionRun:
    return simulate({}, duration_s=40.0, **vehicle_and_program(kind))


@cache
def comparison_of(kind: str) -> RunResiduals:
    return RunResiduals(plain_run(kind), vehicle_of(KIND_OF[kind]), Input.COMMAND)


def vehicle_and_program(kind: str) -> dict[str, object]:
    if kind == "differential":
        return {}
    if kind == "mecanum":
        return {"vehicle": VEHICLES["youbot"]}
    return {"vehicle": VEHICLES["car"], "program": Program(speed_scale=0.5)}


def test_the_catalogue_is_that_of_the_simulator() -> None:
    assert set(ids(EFFECTS)) == set(SIMULATED)


@pytest.mark.parametrize("effect", EFFECTS, ids=ids(EFFECTS))
def test_neutral_parameters_change_nothing_bit_for_bit(effect: type[Effect]) -> None:
    check_formula(effect)
    run_residuals = comparison_of(effect.kinds[0])
    base = run_residuals.predict_velocity((), Timing())
    with_effect = run_residuals.predict_velocity((effect(),), Timing())
    for channel in ("x", "y", "w"):
        assert np.array_equal(getattr(base, channel), getattr(with_effect, channel))
    assert np.array_equal(
        run_residuals.find_residuals((), Timing()), run_residuals.find_residuals((effect(),), Timing())
    )


UNITS = {
    "v0": "m/s",
    "w0": "rad/s",
    "s0": "m/s",
    "v_x": "m/s",
    "v_y": "m/s",
    "v_w": "rad/s",
    "turning": "1",
    "pitch": "rad",
    "roll": "rad",
    "t": "s",
    "T": "s",
    "b": "m",
    "l": "m",
    "delta": "rad",
}
FORMULA = re.compile(r"(v0|w0|s0|v_[xyw]) (\+?=) (.+)$", re.MULTILINE)
# A change of terrain begins at a place or a moment, play remembers: no formula of a moment.
UNWRITTEN = ("terrain_change", "steering_sensor_play")
WRITTEN = [e for e in EFFECTS if issubclass(e, LinearEffect | KinematicEffect) and e.id not in UNWRITTEN]


@pytest.mark.parametrize("effect", WRITTEN, ids=ids(tuple(WRITTEN)))
def test_the_formula_of_the_page_is_that_of_the_code(effect: type[Effect]) -> None:
    run_residuals = comparison_of(effect.kinds[0])
    around = run_residuals.context
    generator = np.random.default_rng(3)
    size = around.times.size
    wheels = Wheels(
        *(generator.uniform(-5.0, 5.0, size) for _ in range(2)), generator.uniform(-0.4, 0.4, size)
    )
    v0 = generator.uniform(-2.0, 2.0, size)
    w0 = (
        v0 * np.tan(wheels.steering) / (around.vehicle.wheelbase_m or 1.0)
        if effect.id == "understeer"
        else v0[::-1]
    )
    s0 = generator.uniform(-2.0, 2.0, size) if "mecanum" in effect.kinds[:1] else np.zeros(size)
    rolling = Rolling(v0, w0, wheels, s0)
    velocity = Velocity(*(generator.uniform(-1.0, 1.0, size) for _ in range(3)))
    chosen = effect(**{p.name: p.typical for p in effect.parameters})
    known = {p.name: parse_unit(p.unit, "") for p in effect.parameters}
    known |= {name: parse_unit(unit, "") for name, unit in UNITS.items()}
    values = dict(chosen.values) | {
        "v0": v0,
        "w0": w0,
        "s0": s0,
        "v_x": velocity.x,
        "v_y": velocity.y,
        "v_w": velocity.w,
        "turning": find_turning(wheels, around),
        "pitch": around.attitude[:, 1],
        "roll": around.attitude[:, 0],
        "t": around.times,
        "T": around.duration_s,
        "b": around.track_m,
        "l": around.vehicle.wheelbase_m or 1.0,
        "delta": wheels.steering,
    }
    page = effect.find_page()
    found = FORMULA.findall("\n".join(line for line in page.splitlines() if line.startswith("    ")))
    assert found, "the page has no formula that could be compared"
    if isinstance(chosen, LinearEffect):
        zero = Velocity(*(np.zeros(size) for _ in range(3)))
        added = chosen.add_to(zero, rolling, velocity, around)
        results = {"v_x": added.x, "v_y": added.y, "v_w": added.w}
    else:
        assert isinstance(chosen, KinematicEffect)
        rolled = chosen.roll(rolling, around)
        results = {"v0": rolled.v0, "s0": rolled.s0, "w0": rolled.w0}
    for name, _, text in found:
        expression = parse_expression(text, known, effect.id)
        assert expression.unit == parse_unit("m/s" if name in {"v0", "s0", "v_x", "v_y"} else "rad/s", "")
        expected = np.asarray(expression.evaluate(values))
        assert np.allclose(results[name], expected, rtol=1e-9, atol=1e-12), text


DRIVETRAIN = {effect.id for effect in EFFECTS if effect.place in {Place.COMMAND, Place.DRIVE}}


_IN_STEP = {
    "steering_lag",
    "steering_rate_limit",
    "body_acceleration_limit",
    "turn_acceleration_limit",
    "drive_overshoot",
}


@pytest.mark.parametrize("effect", EFFECTS, ids=ids(EFFECTS))
def test_a_parameter_put_into_simulated_data_comes_back(effect: type[Effect]) -> None:
    names = (effect.id, *effect.acts_with)
    usual = {name: {p.name: p.typical for p in SIMULATED[name].parameters} for name in names}
    hidden = {
        name: {key: value for key, value in values.items() if not math.isnan(value)}
        for name, values in usual.items()
    }
    truth = hidden[effect.id]
    more = vehicle_and_program(effect.kinds[0])
    if Excitation.SLOPE in effect.needs:
        more["ground"] = Ground(pitch_rad=0.14)
    if effect.late is Late.POSES:
        # A gyro tells how late poses are before any model is fitted; slow encoders know when only by halves.
        more |= {"imu": None, "encoders": Encoders(rate_hz=50.0)}
    if effect.id in _IN_STEP:
        # Encoders of 20 Hz that keep step with commands of 20 Hz seem 20 ms late, which a lag then lacks, and
        # a ramp is as much longer.
        more |= {"encoders": Encoders(rate_hz=50.0)}
    vehicle = KIND_OF[effect.kinds[0]]
    if "wheel_servo" in names:
        # A force that falls with speed shows on wheels that turn at metres a second.
        more, vehicle = more | {"vehicle": VEHICLES["warthog"]}, "warthog"
    # What only shows where fast turns stand beside slow ones, or across a slope, takes longer.
    duration_s = 240.0 if effect.id in {"speed_track", "understeer", "side_slope_turn"} else 100.0
    run = simulate(hidden, duration_s=duration_s, written=WRITTEN_EFFECTS, **more)
    source = Input.COMMAND if effect.id in DRIVETRAIN else Input.MEASURED
    data = EstimationData([run], vehicle_of(vehicle), source)
    searched = tuple(kind() for kind in EFFECTS if kind.id in names)
    fitted = fit_model(data, Model(data.vehicle, searched))
    estimates = estimate_intervals(fitted)
    for name, value in truth.items():
        item = estimates.find(f"{effect.id}.{name}")
        half = 0.5 * (item.high - item.low)
        # Intervals miss one time in twenty; twice as wide they hold, and they are narrow enough to be of use.
        assert abs(item.value - value) < 2.0 * half
        assert half < 0.2 * abs(value)


# What is known of an effect stands in its own file, and nowhere else.


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


@pytest.mark.parametrize("effect", EFFECTS, ids=ids(EFFECTS))
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
            math.isnan(parameter.neutral)
            or math.isinf(parameter.neutral)
            or low <= parameter.neutral <= high
            # What begins at several numbers never walks to none: it becomes a special case before.
            or (effect.starts and parameter.neutral < low)
        )


def check_sizes(effect: type[Effect]) -> None:
    """They have reasons and fit each other."""
    page = format_page(effect)
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
    """They name effects, and those that hold on both sides say so on both."""
    facts = list_pairs().get(effect.id, {})
    assert list_pairs().keys() <= BY_ID.keys()
    for relation, named in facts.items():
        assert getattr(effect, relation) == named
        assert relation == "equivalent_when" or set(named) <= BY_ID.keys() - {effect.id}
    assert bool(effect.equivalent_to) == bool(effect.equivalent_when)
    assert all(effect.id in BY_ID[name].same_in_one_motion for name in effect.same_in_one_motion)
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
