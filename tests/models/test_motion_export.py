"""The exported function computes what the model computes, and a model file says again what it was told."""

import math
import random
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_files import HUSKY, make, predict
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from motion_runs import QUIET, simulate, vehicle_of

from pipeline.estimation import Input
from pipeline.estimation.run_residuals import RunResiduals
from pipeline.export import export_model
from pipeline.models import Model, ModelFile, Place, Timing, find_effect, format_model, list_effects
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.model_file import parse_model
from pipeline.run import MotionError, MotionRun
from pipeline.simulate import VEHICLES, Disturbance, Program

HERE = Path("model.toml")
PRESETS = {"differential": "husky_a200", "ackermann": "ackermann_car", "mecanum": "youbot"}
YOUBOT = {"vehicle": VEHICLES["youbot"]}
STEP_S = 0.005
FREE = st.floats(-3.0, 3.0, allow_subnormal=False)
LEAVES = [
    "a",
    "b",
    "roll",
    "pitch",
    "yaw",
    "pi",
    "(v0 / u)",
    "(w0 * s)",
    "(t / s)",
    "(left * s)",
    "(x / (u * s))",
    "-a",
]


def numbers() -> st.SearchStrategy[str]:
    return st.one_of(
        st.integers(0, 10**30).map(str),
        st.floats(0.0, 1e6).map(repr),
        st.sampled_from(["1e-300", "2.5E3", ".5", "3."]),
    )


def combine(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    power = st.sampled_from(["0", "1", "2", "3", "0.5", "-1", "-2", "1.5"])
    one = st.sampled_from(
        ["sin", "cos", "tan", "asin", "acos", "atan", "tanh", "exp", "log", "abs", "sqrt", "sign"]
    )
    two = st.sampled_from(["min", "max", "hypot", "atan2"])
    return st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", " - -"]), inner).map("".join),
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/"]), inner).map(
            lambda parts: f"({' '.join(parts)})"
        ),
        st.tuples(inner, st.sampled_from(["**", "^", " ** "]), power).map("".join),
        st.tuples(st.sampled_from(["-", "+", "- -"]), inner).map("".join),
        st.tuples(one, inner).map(lambda parts: f"{parts[0]}({parts[1]})"),
        st.tuples(two, inner, inner).map(lambda parts: f"{parts[0]}({parts[1]},\n{parts[2]})"),
    )


FORMULAS = st.recursive(st.one_of(st.sampled_from(LEAVES), numbers()), combine, max_leaves=12)


@settings(max_examples=150)
@given(
    text=FORMULAS,
    state=st.tuples(FREE, FREE, FREE, FREE, FREE, FREE, FREE),
    values=st.tuples(FREE, FREE, FREE, st.floats(0.1, 3.0), st.floats(0.1, 3.0)),
    channel=st.sampled_from(["v_x", "v_y"]),
)
def test_an_exported_formula_gives_what_the_model_gives(
    text: str, state: tuple[float, ...], values: tuple[float, ...], channel: str
) -> None:
    parameters = (
        make_parameter("k", "1", (-9.0, 9.0)),
        *(make_parameter(name, "1", (-9.0, 9.0), neutral=0.7) for name in "ab"),
        make_parameter("u", "m/s", (-9.0, 9.0), neutral=0.7),
        make_parameter("s", "s", (-9.0, 9.0), neutral=0.7),
    )
    whole = f"k * u * ({text}) + 0 * k * (a + b) * u * s / s"
    try:
        effect = FormulaEffect("f", {channel: whole}, parameters).change(
            **dict(zip("kabus", values, strict=True))
        )
    except MotionError as error:
        assume(error.code not in {"bad_formula", "not_finite"})
        raise
    left, right, x, y, yaw, roll, pitch = state
    radius, track = HUSKY.wheel_radius_m, HUSKY.track_width_m or math.nan
    signals = {"left": left, "right": right, "x": x, "y": y, "yaw": yaw, "roll": roll, "pitch": pitch}
    signals |= {"v0": radius * (left + right) / 2.0, "w0": radius * (right - left) / track, "t": STEP_S / 2.0}
    expression = effect.expressions[channel]
    try:
        added = float(expression.evaluate({**signals, **effect.values}))
    except MotionError:
        return
    rows = predict(make(effect), [(-1.0, left, right)], STEP_S, pose=(x, y, yaw), roll=roll, pitch=pitch)
    expected = added + (signals["v0"] if channel == "v_x" else 0.0)
    assert rows[0, 4 if channel == "v_x" else 5] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_power_of_a_negative_number_keeps_its_sign() -> None:
    effect = FormulaEffect("f", {"v_x": "k**2 * v0"}, (make_parameter("k", "1", (-1.0, 1.0)),), k=-0.5)
    rows = predict(make(effect), [(-1.0, 1.0, 1.0)], STEP_S)
    assert rows[0, 4] == pytest.approx(1.25 * HUSKY.wheel_radius_m)


def test_an_exported_formula_knows_what_a_wheel_has_turned() -> None:
    gain = (make_parameter("k", "m", (-1.0, 1.0)),)
    formulas = ("left * sin(left_angle)", "right * sin(left_angle - right_angle)")
    effects = [
        FormulaEffect(name, {"v_x": f"k * {text}"}, gain, k=0.01)
        for name, text in zip(("hart-é", "hart_e9"), formulas, strict=True)
    ]
    rows = predict(make(*effects), [(-1.0, 2.0, 3.0)], 4.0)
    turned = np.arange(1, len(rows) + 1) * STEP_S
    added = 0.02 * np.sin(2.0 * turned) + 0.03 * np.sin(-turned)
    assert rows[:, 4] == pytest.approx(2.5 * HUSKY.wheel_radius_m + added, abs=1e-9)


@pytest.fixture(scope="module")
def runs() -> Mapping[str, MotionRun]:
    quiet = {"duration_s": 8.0, "encoders": None, "pose": QUIET, "disturbance": Disturbance()}
    car = {"vehicle": VEHICLES["car"], "program": Program(speed_scale=0.5)}
    kinds = {"differential": {}, "ackermann": car, "mecanum": YOUBOT}
    return {kind: simulate({}, **quiet, **more) for kind, more in kinds.items()}  # type: ignore[arg-type]


@pytest.mark.parametrize("name", [e.id for e in list_effects() if e.place is not Place.LOCALIZATION])
def test_every_effect_moves_alike_at_any_of_its_values(name: str, runs: Mapping[str, MotionRun]) -> None:
    rng = random.Random(name)  # noqa: S311 - no secret
    kind = find_effect(name)
    for vehicle, run in runs.items():
        if vehicle not in kind.kinds:
            continue
        assert run.commands is not None
        model = Model(vehicle_of(PRESETS[vehicle]))
        run_residuals = RunResiduals(run, model.vehicle, Input.COMMAND, rate_hz=200.0)
        series = run.commands
        columns = [series.times, series.left, series.right]
        columns += [series.steering if series.sideways is None else series.sideways]
        # Numbers of NumPy, as a log's arrays give them.
        rows = list(zip(*columns, strict=True))
        for _ in range(3):
            values = {
                p.name: p.neutral
                if math.isnan(p.neutral) and p.name == "at_x"
                else rng.uniform(
                    *sorted((max(p.bounds[0], -2 * abs(p.typical)), min(p.bounds[1], 2 * abs(p.typical))))
                )
                for p in kind().parameters
            }
            effect, moved = kind(**values), model
            for beside in map(find_effect, kind.acts_with):
                # Bounds that act: what acts beside them alone moves nothing otherwise.
                moved += beside(tau=0.2, reset=0.3, drag=0.05, bound=0.3, no_load=1.2, scrub=0.6, creep=0.07)
            moved += effect
            expected = run_residuals.predict_velocity(moved.effects, Timing())
            fine = predict(ModelFile(moved), rows, run.duration_s, step_s=STEP_S / 5)
            # The model's cells hold means; so do these.
            got = fine[: len(fine) // 5 * 5].reshape(-1, 5, 7).mean(axis=1)
            # Where a command changes within a cell, a limit acts here on both and in the model on their mean.
            times = run_residuals.grid.times
            kept = times < run.duration_s - 0.1
            kept &= np.abs(times[:, None] - series.times).min(axis=1) > STEP_S / 2
            times = times[kept]
            for column, channel in ((4, "x"), (5, "y"), (6, "w")):
                seen = np.interp(times, got[:, 0] - STEP_S / 10.0, got[:, column])
                wanted = getattr(expected, channel)[kept]
                typical = float(np.sqrt(np.mean(wanted**2)))
                apart = float(np.sqrt(np.mean((seen - wanted) ** 2)))
                assert apart < 0.02 * max(typical, 0.1), (values, channel, apart, typical)


TREES = st.recursive(
    st.one_of(
        st.text(max_size=8),
        st.booleans(),
        st.integers(-(2**63), 2**63 - 1),
        st.floats(allow_nan=False).map(lambda value: float(f"{value:.6g}")).filter(math.isfinite),
        st.datetimes(),
        st.dates(),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=80)
@given(
    note=st.text(max_size=20),
    fit=st.dictionaries(st.text(max_size=6), TREES, min_size=1, max_size=4),
    name=st.sampled_from(["k", "kappa", "τ", "k_2", "_k"]),
    bounds=st.tuples(st.floats(-1e9, 0.0), st.floats(0.0, 1e9)).filter(lambda pair: pair[0] < pair[1]),
    share=st.floats(0.0, 1.0),
    neutral=st.floats(0.0, 1.0),
)
def test_a_model_file_says_again_what_it_was_told(
    note: str, fit: dict[str, object], name: str, bounds: tuple[float, float], share: float, neutral: float
) -> None:
    neutral = bounds[0] + neutral * (bounds[1] - bounds[0])
    value = min(max(bounds[0] + share * (bounds[1] - bounds[0]), bounds[0]), bounds[1])
    assume(bounds[0] <= neutral <= bounds[1])
    parameter = make_parameter(name, "1", bounds, neutral=neutral)
    effect = FormulaEffect("f", {"v_x": f"({name} - {neutral!r}) * v0"}, (parameter,))
    effect = effect.change(**{name: value})
    file = ModelFile(Model(HUSKY, (effect,)), note=note, fit=fit)
    text = format_model(file)
    again = parse_model(text, HERE)
    assert again.note == note
    assert again.fit == fit
    read = again.model.effect("f")
    assert isinstance(read, FormulaEffect)
    assert read.formulas == effect.formulas
    assert read.parameter(name).bounds == bounds
    assert read.parameter(name).neutral == neutral
    assert read.values[name] == pytest.approx(value, rel=1e-5)
    assert format_model(again) == text
    assert tomllib.loads(text)["format"] == 1


def test_a_controller_advances_the_exported_state_by_commands_that_it_tries() -> None:
    effects = (
        find_effect("transport_delay")(d=0.1),
        find_effect("drive_lag")(tau=0.3),
        find_effect("effective_track")(k=1.6),
        find_effect("drive_overshoot")(tau=0.2, damping=0.5),
    )
    file, space = ModelFile(Model(HUSKY, effects)), dict[str, Any]()
    exec(compile(export_model(file, "python"), "exported", "exec"), space)  # noqa: S102 - that is what it is for
    advance, late = space["advance"], space["DELAY"]
    assert late == 0.1
    state, tried = space["REST"], []
    for number in range(100):
        before = state
        tried.append(advance(state, (-3.0, 5.0), 0.01))
        assert state == before
        state = advance(state, (5.0, 3.0) if number < 50 else (2.0, 4.0), 0.01)
    rows = predict(file, [(-late, 5.0, 3.0), (0.5 - late, 2.0, 4.0)], 1.0, step_s=0.01)
    assert state[:7] == pytest.approx(rows[-1], abs=1e-9)
    # From a moving state another command begins with the velocity that the vehicle has.
    assert tried[60][4] != pytest.approx(tried[0][4], abs=0.1)
    assert tried[60][4] == pytest.approx(rows[59][4], abs=0.1)
