"""A model file or a formula that nobody would write is one clear line that names its place, at once."""

import numpy as np
import pytest

from pipeline.models.expression import parse_expression
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.parameter import parse_unit
from pipeline.run import MotionError


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
