"""The real recordings: what the right effects, given by hand, leave of the ideal model's held-out error."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from real_recordings import CASES, INERTIA, TRACK, C, Case, M, Recordings, make_model, measure

from pipeline.estimation import Problem, carry_over, climb, fit_model
from pipeline.estimation.ladder import CHANCE, list_rises
from pipeline.models import Model, find_effect

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.long

WITHIN = 1.1
MARGIN = 1.08
# What benchmarks/recordings.py printed: x, y, w, T, R, and R with whole turns counted.
REACHED = {
    ("husky_wheels-deflated_tile_2023_12_12_16h16", M): (0.703, 0.195, 0.054, 0.219, 0.038, 0.038),
    ("husky_wheels-deflated_tile_2023_12_12_16h16", C): (0.530, 0.224, 0.133, 0.251, 0.119, 0.119),
    ("husky_snow_boreal", M): (0.657, 0.721, 0.171, 0.353, 0.160, 0.159),
    ("husky_snow_boreal", C): (0.445, 0.729, 0.034, 0.291, 0.108, 0.025),
    ("husky_wheels_wetgrass", M): (1.000, 0.958, 0.140, 0.800, 0.100, 0.100),
    ("husky_wheels_wetgrass", C): (0.939, 0.958, 0.099, 0.661, 0.071, 0.071),
    ("warthog_wheels_asphalt_2024_8_7_11h30s30", M): (0.604, 0.317, 0.113, 0.276, 0.100, 0.100),
    ("warthog_wheels_asphalt_2024_8_7_11h30s30", C): (0.357, 0.346, 0.164, 0.195, 0.111, 0.099),
    ("warthog_wheels_asphalt", M): (0.531, 0.244, 0.097, 0.241, 0.083, 0.083),
    ("warthog_wheels_asphalt", C): (0.402, 0.264, 0.163, 0.181, 0.100, 0.091),
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", M): (0.962, 0.446, 0.053, 0.294, 0.049, 0.049),
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", C): (0.338, 0.530, 0.196, 0.219, 0.076, 0.076),
    ("warthog_gravel_1", M): (0.354, 0.220, 0.102, 0.182, 0.091, 0.090),
    ("warthog_gravel_1", C): (0.310, 0.227, 0.095, 0.206, 0.129, 0.062),
    ("warthog_wheels_gravel_2024_8_6_11h37s32", M): (0.357, 0.193, 0.110, 0.175, 0.086, 0.086),
    ("warthog_wheels_gravel_2024_8_6_11h37s32", C): (0.271, 0.212, 0.152, 0.160, 0.093, 0.087),
    ("warthog_wheels_sand_2024_9_25_14h32s32", M): (0.569, 0.452, 0.110, 0.276, 0.104, 0.091),
    ("warthog_wheels_sand_2024_9_25_14h32s32", C): (0.419, 0.462, 0.101, 0.244, 0.113, 0.070),
    ("warthog_wheels_ice_2024_7_30_16h30s21", M): (0.481, 0.495, 0.331, 0.334, 0.269, 0.225),
    ("warthog_wheels_ice_2024_7_30_16h30s21", C): (0.419, 0.670, 0.264, 0.266, 0.241, 0.183),
    ("warthog_wheels_grass_2024_7_29_14h46s15", M): (0.867, 0.755, 0.085, 0.540, 0.062, 0.062),
    ("warthog_wheels_grass_2024_7_29_14h46s15", C): (0.525, 0.753, 0.212, 0.357, 0.121, 0.121),
    ("warthog_wheels_grass_2024_8_8_16h19s23", M): (0.686, 0.384, 0.086, 0.367, 0.075, 0.075),
    ("warthog_wheels_grass_2024_8_8_16h19s23", C): (0.303, 0.430, 0.245, 0.213, 0.115, 0.115),
}
# Channels that stay further than ten percent above the table of METHODS section 5.
BEYOND = {
    ("husky_wheels-deflated_tile_2023_12_12_16h16", C): "x",
    ("husky_wheels_wetgrass", M): "R",
    ("husky_wheels_wetgrass", C): "R",
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", M): "x",
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", C): "T",
    ("warthog_wheels_ice_2024_7_30_16h30s21", C): "R",
    ("warthog_wheels_grass_2024_7_29_14h46s15", C): "w",
    ("warthog_wheels_grass_2024_8_8_16h19s23", C): "w",
}


@pytest.fixture(scope="module")
def recordings(shared_logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Recordings:
    return Recordings(shared_logs, tmp_path_factory.mktemp("recordings"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.log}-{case.source.value}")
def test_the_right_effects_reach_the_table(case: Case, recordings: Recordings) -> None:
    run, vehicle = recordings.load(case.log)
    reached = measure(run, vehicle, case.source, case.effects)
    ratios = np.array((*reached.ratios, reached.turned))
    assert np.all(ratios <= MARGIN * np.array(REACHED[case.log, case.source])), ratios.round(3)
    # The table counts whole turns: commands turn the ideal model by more than a wrapped angle can say.
    shares = np.append(ratios[:4], ratios[4:].min()) / np.array(case.table)
    beyond = {channel for channel, share in zip("xywTR", shares.tolist(), strict=True) if share > WITHIN}
    assert beyond <= set(BEYOND.get((case.log, case.source), "")), shares.round(3)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.log}-{case.source.value}")
def test_the_ladder_falls_or_stops(case: Case, recordings: Recordings) -> None:
    run, vehicle = recordings.load(case.log)
    ladder = climb(Problem([run], vehicle, case.source), make_model(vehicle, case.effects))
    errors = [rung.errors for rung in ladder.steps]
    # What rises by less than chance is marked where it is shown.
    assert not any(list_rises(before, after, CHANCE) for before, after in pairwise(errors)), errors
    assert set(ladder.steps[-1].effects) | set(ladder.idle) == set(case.effects)
    assert len(errors) > 1


def test_a_model_of_one_asphalt_predicts_another_but_not_ice(recordings: Recordings) -> None:
    run, vehicle = recordings.load("warthog_wheels_asphalt_2024_8_7_11h30s30")
    others = [
        recordings.load(name)[0]
        for name in ("warthog_wheels_asphalt", "warthog_wheels_ice_2024_7_30_16h30s21")
    ]
    problem = Problem([run], vehicle, M)
    fitted = fit_model(problem, Model(vehicle, (find_effect(TRACK)(), find_effect(INERTIA)())))
    asphalt, ice = carry_over(fitted.model, others, M, fitted_on=["asphalt"])
    assert asphalt.ratio <= 1.1
    assert asphalt.warning == ""
    assert ice.ratio > 1.1
    assert "does not transfer" in ice.warning
