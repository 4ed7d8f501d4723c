"""A map whose axes have unequal scales is told of by the wheels, and only where the headings vary."""

from dataclasses import replace

import numpy as np
import pytest
from few import few
from stage_logs import FIELD, TakeThrough

from pipeline.simulate import Ground, Program, Scenario, simulate_run
from pipeline.words import format_finding

STEPS = replace(FIELD, duration_s=300.0, seed=4)


def stretch(scenario: Scenario, share: float, along_rad: float = 0.5) -> Scenario:
    return replace(scenario, pose=replace(scenario.pose, map_stretch=share, map_stretch_rad=along_rad))


@pytest.mark.parametrize(
    ("seed", "along_rad"),
    [(4, 0.5), *(pytest.param(*more, marks=pytest.mark.long) for more in ((4, 2.2), (5, 0.5), (5, 2.2)))],
)
def test_a_map_that_is_longer_along_one_direction_is_told_with_its_interval(
    drive: TakeThrough, seed: int, along_rad: float
) -> None:
    told = drive(replace(stretch(STEPS, 0.03, along_rad), seed=seed)).finding("map_uneven")
    assert told.severity == "warning"
    assert told.value == pytest.approx(0.03, abs=0.01)
    words = format_finding(told).split()
    assert float(words[words.index("of") + 1]) == pytest.approx(np.degrees(along_rad) % 180.0, abs=12.0)
    low, high = (float(words[words.index("to") + step].strip("(")) for step in (-2, 1))
    assert low < 3.0 < high


def test_a_map_of_another_scale_is_the_wheels_radius(drive: TakeThrough) -> None:
    scaled = replace(STEPS, effects={**STEPS.effects, "wheel_radius": 0.9})
    assert "map_uneven" not in drive(scaled).ids()


@pytest.mark.parametrize(
    "more",
    few(
        [
            {},
            {
                "ground": Ground(pitch_rad=0.12),
                "effects": {"drive_lag": 0.3, "slope_creep": 0.6, "side_slope_creep": 0.6},
            },
            {
                "effects": {
                    "drive_lag": 0.3,
                    "effective_track": 1.8,
                    "speed_slip": 0.1,
                    "turning_resistance": 0.2,
                }
            },
        ],
        2,
    ),
    ids=["plain", "slope", "slip"],
)
def test_an_even_map_is_not_told_of(drive: TakeThrough, more: dict[str, object]) -> None:
    assert "map_uneven" not in drive(replace(STEPS, **more)).ids()  # type: ignore[arg-type]


def test_where_all_roads_are_parallel_nothing_is_told(drive: TakeThrough) -> None:
    assert "map_uneven" not in drive(stretch(replace(STEPS, program=Program("straight")), 0.05)).ids()


def test_the_simulated_map_is_longer_along_its_direction_and_as_long_across() -> None:
    plain, stretched = (simulate_run(stretch(STEPS, share)).poses.position for share in (0.0, 0.1))
    along, across = np.array([np.cos(0.5), np.sin(0.5), 0.0]), np.array([-np.sin(0.5), np.cos(0.5), 0.0])
    extent = np.ptp(plain @ along)
    assert np.ptp(stretched @ along) == pytest.approx(1.1 * extent, rel=0.01)
    assert stretched @ across == pytest.approx(plain @ across)
