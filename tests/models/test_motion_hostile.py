"""A model file or a formula that nobody would write is one clear line that names its place, at once."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from motion_runs import vehicle_of

from pipeline.models.formula import FormulaEffect, make_parameter, parse_expression
from pipeline.models.model_file import parse_model
from pipeline.models.parameter import parse_unit
from pipeline.run import MotionError

HEAD = '[vehicle]\npreset = "husky_a200"\n'
EFFECT = HEAD + "[[effect]]\n"
TRACK = EFFECT + 'id = "effective_track"\n'
FORMULA = EFFECT + 'id = "f"\nv_x = "k * v0"\n'


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        (TRACK + "k = inf\n", 5, "not a finite number"),
        (TRACK + "k = nan\n", 5, "not a finite number"),
        (TRACK + "k = { value = -inf }\n", 5, "not a finite number"),
        (FORMULA + "k = { value = inf }\n", 6, "not a finite number"),
        (FORMULA + "k = { neutral = nan }\n", 6, "neutral"),
        (FORMULA + 'k = { neutral = "a" }\n', 6, "neutral"),
        (FORMULA + "k = { bounds = [nan, 1] }\n", 6, "bounds"),
        (FORMULA + f"k = 1{'0' * 350}\n", None, "64 bits"),
        (HEAD + "wheel_radius_m = inf\n", 3, "wheel_radius_m"),
        (HEAD + "mass_kg = nan\n", 3, "mass_kg"),
        ("note = " + "[" * 100_000, None, "deep"),
        (HEAD + "[fit]\na = " + "[" * 60 + "]" * 60 + "\n", None, "deep"),
        ("a." * 200_000 + "b = 1\n", 1, "parts"),
        (EFFECT + 'id = "two\\nlines"\n', 4, "id of an effect"),
        (EFFECT + 'id = "a\\"b"\n', 4, "id of an effect"),
        (EFFECT + f'id = "{"a" * 100}"\n', 4, "id of an effect"),
        (FORMULA + '"a b" = 1\n', 6, "name of a parameter"),
        (FORMULA + '"\\u00b5" = 1\n', 3, "name of a parameter"),
        *(
            (FORMULA.replace("k *", f"{name} *") + f"{name} = 0.5\n", 6, "")
            for name in ("where", "self", "fixed", "v_y")
        ),
    ],
)
def test_a_model_file_is_one_line_that_names_its_own(text: str, line: int | None, says: str) -> None:
    begin = time.monotonic()
    with pytest.raises(MotionError) as caught:
        parse_model(text, Path("m.toml"))
    assert time.monotonic() - begin < 2.0
    assert says in str(caught.value)
    if says:
        assert caught.value.where == (f"m.toml:{line}" if line else "m.toml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "text",
    [
        "v0 * 1" + "0" * 350,
        "v0 * 1e999",
        "v0 * 9**9**9",
        "v0 * 9**(9**9)",
        "(" * 240 + "v0" + ")" * 240,
        "v0" + "-" * 400 + "v0",
        "-" * 480 + "v0",
        "sin(" * 100 + "v0" + ")" * 100,
        "v0 # a comment",
        "v0 ; v0",
        "'''v0'''",
        "v0 * 1if",
        "v0 * 0x10",
        "v0 * 1_000",
        "v0\\\n",
        "v0 := 1",
        "\ud800",
        "v0\x00",
        "v\u043e0",
    ],
)
def test_a_formula_nobody_would_write_is_refused_at_once(text: str) -> None:
    begin = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(MotionError) as caught:
            parse_expression(text, {"v0": parse_unit("m/s", "")}, "m.toml:7")
    assert time.monotonic() - begin < 0.5
    assert caught.value.where == "m.toml:7"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value", "says"),
    [
        ("k * u * log(v0 / u - 2)", 0.5, "invalid"),
        ("k * u / (1 - 1)", 0.5, "divide"),
        ("k * u * exp(k * 9999)", 0.5, "overflow"),
        ("k * u * (k - 1) ** 0.5", 0.5, "invalid"),
        ("k * u / k", 0.0, "invalid"),
        ("k * u * 1e300 ** 16", 0.5, "overflow"),
    ],
)
def test_what_is_no_finite_number_is_one_line_and_no_warning(text: str, value: float, says: str) -> None:
    parameters = (make_parameter("k", "1", (-1.0, 1.0)), make_parameter("u", "m/s", (0.0, 2.0), neutral=1.0))

    def evaluate() -> None:
        effect = FormulaEffect("f", {"v_x": text}, parameters, where="m.toml:7", k=value)
        effect.expressions["v_x"].evaluate({"v0": np.linspace(0.1, 1.0, 4), **effect.values})

    with pytest.raises(MotionError, match=says) as caught:
        evaluate()
    assert caught.value.code == "not_finite"
    assert caught.value.where == "m.toml:7"
    assert "\n" not in str(caught.value)


def test_what_is_not_known_goes_through_a_formula() -> None:
    expression = parse_expression(
        "sign(v0) * min(v0, 2 * v0) + max(v0, v0)", {"v0": parse_unit("m/s", "")}, ""
    )
    got = expression.evaluate({"v0": np.array([np.nan, 1.0])})
    assert np.array_equal(got, [np.nan, 2.0], equal_nan=True)


@pytest.mark.parametrize("text", ["m^" + "9" * 5000, "m*" * 1000 + "m", "m^999", "m\n*s" * 100])
def test_a_unit_nobody_would_write_is_refused(text: str) -> None:
    with pytest.raises(MotionError, match="not a unit") as caught:
        parse_unit(text, "m.toml:3")
    assert len(str(caught.value)) < 300


def test_a_name_that_means_something_else_is_refused_in_one_line() -> None:
    for name in ("where", "id", "note", "v_x", "yaw", "t", "pi", "self", "lambda", "a b", "a\nb", "", "ﬁ"):
        with pytest.raises(MotionError, match="parameter") as caught:
            FormulaEffect("f", {"v_x": "k * v0"}, (make_parameter(name, "1", (-1.0, 1.0)),))
        assert "\n" not in str(caught.value)
    assert vehicle_of("husky_a200").kind == "differential"
