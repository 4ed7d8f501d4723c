"""Every effect says in one plain sentence what the vehicle does, with its numbers."""

from __future__ import annotations

import pytest

from pipeline.models import find_effect, list_effects
from pipeline.sources import Vehicle, list_presets

PRESETS: dict[str, Vehicle] = {vehicle.id: vehicle for vehicle in list_presets()}
HUSKY, CAR = PRESETS["husky_a200"], PRESETS["ackermann_car"]


@pytest.mark.parametrize(
    ("name", "values", "sentence"),
    [
        ("wheel_radius", {"k": 0.71}, "travels 29% less than its wheels turn"),
        ("wheel_radius", {"k": 1.04}, "travels 4% more than its wheels turn"),
        ("drive_lag", {"tau": 0.3}, "follows its commands 0.30 s late, gradually"),
        ("steering_offset", {"o": 0.02}, "steers 0.02 rad to the left when straight ahead is asked"),
        ("steering_offset", {"o": -0.02}, "steers 0.02 rad to the right when straight ahead is asked"),
        ("clock_offset", {"d": -0.12}, "stamps its poses 120 ms early"),
        ("slope_drift", {"k": 0.6}, "slides downhill at 0.1 m/s on a slope of 10 degrees"),
        (
            "terrain_change",
            {"k_v": 0.8, "k_w": 0.7, "at_s": 90.0},
            "travels 80% and turns 70% of before from 90 s on",
        ),
        (
            "effective_track",
            {"k": 1.8},
            (
                f"turns as if its wheels stood {1.8 * (HUSKY.track_width_m or 0.0):.2f} m apart "
                f"instead of {HUSKY.track_width_m:.2f}"
            ),
        ),
    ],
)
def test_the_sentence_has_the_number_and_the_side(name: str, values: dict[str, float], sentence: str) -> None:
    assert find_effect(name)().change(**values).describe_motion(HUSKY) == sentence


@pytest.mark.parametrize("kind", list_effects(), ids=lambda kind: str(kind.id))
def test_every_effect_has_a_sentence_of_its_own_that_moves_with_its_numbers(kind: type) -> None:
    vehicle = next(v for v in (HUSKY, CAR, PRESETS["dingo_o"]) if v.kind in kind.kinds)
    usual = {p.name: p.typical for p in kind.parameters if not p.instead_of}
    effect = kind().change(**usual)
    sentence = effect.describe_motion(vehicle)
    assert sentence
    assert kind.id not in sentence
    assert "nan" not in sentence
    assert len(sentence) < 80
    for parameter in kind.parameters:
        if parameter.instead_of:
            continue
        low, high = parameter.bounds
        other = min(max(1.7 * parameter.typical, low), high)
        assert effect.change(**{parameter.name: other}).describe_motion(vehicle) != sentence, parameter.name


def test_understeer_is_told_at_a_speed() -> None:
    """w = v tan(delta) / (l + K v^2): at 3 m/s with K = l / 9 half the turning is left."""
    wheelbase = CAR.wheelbase_m or 1.0
    sentence = find_effect("understeer")().change(K=wheelbase / 9.0).describe_motion(CAR)
    assert sentence.startswith("turns 50% less than it steers at 3 m/s")
