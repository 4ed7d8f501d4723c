import math
from contextlib import suppress
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_runs import simulate, vehicle_of

from pipeline.estimation import EstimationData, Input, fit_model
from pipeline.models import Model
from pipeline.models.expression import parse_expression
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.parameter import Unit, parse_unit
from pipeline.run import MotionError
from pipeline.simulate import State as SimulatedState

KNOWN = {
    "a": parse_unit("m", ""),
    "b": parse_unit("m", ""),
    "s": parse_unit("s", ""),
    "q": parse_unit("1", ""),
}


def test_units_are_understood() -> None:
    for text, unit in [
        ("m/s", Unit(metre=Fraction(1), second=Fraction(-1))),
        ("rad/s", Unit(second=Fraction(-1))),
        ("N*m", parse_unit("J", "")),
        ("kg*m/s^2", parse_unit("N", "")),
        ("J/s", parse_unit("W", "")),
        ("1", Unit()),
        ("1/s", parse_unit("Hz", "")),
        ("s^2/m", Unit(metre=Fraction(-1), second=Fraction(2))),
    ]:
        assert parse_unit(text, "") == unit


def test_what_is_no_unit_is_refused() -> None:
    for text in ["", "m/", "furlong", "m m", "/s", "m//s", "m^", "2"]:
        with pytest.raises(MotionError, match="not a unit"):
            parse_unit(text, "file:3")


@given(st.floats(-10.0, 10.0), st.floats(0.1, 10.0))
def test_a_formula_computes_what_it_says(a: float, b: float) -> None:
    values = {"a": a, "b": b, "q": 0.5}
    expression = parse_expression("-a + 2 * b ** 2 / (abs(b) + 0 * a) - max(a, b) * sin(q) * 1e0", KNOWN, "")
    assert expression.unit == KNOWN["a"]
    assert expression.evaluate(values) == pytest.approx(-a + 2 * b * b / abs(b) - max(a, b) * math.sin(0.5))


def test_what_is_no_formula_is_refused_and_never_run() -> None:
    for text, code in [
        ("a + s", "wrong_units"),
        ("sin(a)", "wrong_units"),
        ("max(a, s)", "wrong_units"),
        ("c * 2", "unknown_signal"),
        ("__import__('os')", "bad_formula"),
        ("a.real", "bad_formula"),
        ("[a for a in (1,)]", "bad_formula"),
        ("(lambda: 1)()", "bad_formula"),
        ("a if q else b", "bad_formula"),
        ("a ** q", "bad_formula"),
        ("q ** 99", "bad_formula"),
        ("a @ b", "bad_formula"),
        ("'a'", "bad_formula"),
        ("True", "bad_formula"),
        ("a +", "bad_formula"),
        ("", "bad_formula"),
        ("a" * 600, "bad_formula"),
    ]:
        with pytest.raises(MotionError) as caught:
            parse_expression(text, KNOWN, "model.toml:7")
        assert caught.value.code == code
        assert caught.value.where == "model.toml:7"


@given(st.text(max_size=40))
def test_any_text_gives_a_formula_or_one_clear_error(text: str) -> None:
    with suppress(MotionError):
        parse_expression(text, KNOWN, "here")


def test_a_formula_must_vanish_at_its_neutral_values() -> None:
    with pytest.raises(MotionError) as caught:
        FormulaEffect("gain", {"v_x": "k * v0"}, (make_parameter("k", "1", (0.0, 2.0), neutral=1.0),))
    assert caught.value.code == "not_neutral"
    FormulaEffect("gain", {"v_x": "(k - 1) * v0"}, (make_parameter("k", "1", (0.0, 2.0), neutral=1.0),))


def test_a_formula_finds_physics_that_no_catalogue_has() -> None:
    def blow(state: SimulatedState) -> tuple[float, float, float]:
        return 0.0, 0.08 * math.sin(state.yaw), 0.0

    run = simulate({}, extra=blow, duration_s=120.0)
    wind = FormulaEffect("crosswind", {"v_y": "k * sin(yaw)"}, (make_parameter("k", "m/s", (-1.0, 1.0)),))
    data = EstimationData([run], vehicle_of("husky_a200"), Input.MEASURED)
    fitted = fit_model(data, Model(data.vehicle, (wind,)))
    assert fitted.model.effect("crosswind").values["k"] == pytest.approx(0.08, abs=0.005)


def test_rates_of_signals_can_be_used_and_are_nothing_across_holes() -> None:
    run = simulate({}, duration_s=60.0)
    effect = FormulaEffect("jerk", {"v_x": "k * v0_rate"}, (make_parameter("k", "s", (-1.0, 1.0)),), k=0.1)
    data = EstimationData([run], vehicle_of("husky_a200"), Input.MEASURED)
    model = Model(data.vehicle, (effect,))
    ideal = data.find_residuals(data.start_state())
    shaken = data.find_residuals(data.start_state(model))
    assert np.isfinite(shaken).all()
    assert np.abs(shaken - ideal)[:, 0].max() > 0.01
    assert np.array_equal(shaken[:, 2], ideal[:, 2])


def test_a_wheel_out_of_round_is_a_formula_of_what_it_has_turned() -> None:
    husky = vehicle_of("husky_a200")

    def wobble(state: SimulatedState) -> tuple[float, float, float]:
        return 0.05 * husky.wheel_radius_m * state.left_speed * math.sin(state.left_angle), 0.0, 0.0

    run = simulate({}, extra=wobble, duration_s=60.0)
    text = "left * (a * sin(left_angle) + b * cos(left_angle))"
    parameters = tuple(make_parameter(name, "m", (-0.1, 0.1)) for name in "ab")
    data = EstimationData([run], husky, Input.MEASURED)
    fitted = fit_model(data, Model(husky, (FormulaEffect("oval", {"v_x": text}, parameters),)))
    size = math.hypot(*fitted.model.effect("oval").values.values())
    assert size == pytest.approx(0.05 * husky.wheel_radius_m, rel=0.1)
