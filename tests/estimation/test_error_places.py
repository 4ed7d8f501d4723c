"""Times and places of an error: said only where the commands there do not explain it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_diagnosis import _SCENE, _diagnose

from pipeline.estimation.error_regions import _expect_square, _list_responses, pick_regions
from pipeline.results import Region
from pipeline.words.errors import name_region

_NOISE = np.full(3, 1e-3)


def _find_circumstances(
    effects: Mapping[str, float | Mapping[str, float]], seed: int, folder: Path
) -> list[Region]:
    scenario = replace(_SCENE, effects=effects, duration_s=150.0, seed=seed)
    (run,) = _diagnose(scenario, folder).runs
    assert run.where
    return [region for region in run.where if region.kind in {"time", "place"}]


@pytest.mark.long
def test_commands_that_differ_from_place_to_place_are_no_effect_of_place(tmp_path: Path) -> None:
    # A half of the map has two thirds of the forward error, a fifth of the time 40 % of it.
    assert _find_circumstances({"effective_track": 1.8, "drive_lag": 0.4}, 2, tmp_path) == []


def test_a_wet_patch_is_a_place(tmp_path: Path) -> None:
    patch = {"terrain_change": {"k_v": 0.85, "k_w": 0.6, "at_x": -1.5}}
    found = _find_circumstances(patch, 1, tmp_path)
    assert {region.kind for region in found} == {"time", "place"}
    assert all(region.share > 1.5 * region.expected for region in found)
    assert name_region(found[0]).startswith("where ")


def test_what_a_region_holds_is_compared_with_the_same_commands_elsewhere() -> None:
    rng = np.random.default_rng(0)
    lags = np.repeat(rng.normal(size=(400, 1, 2)), 9, axis=1)
    # Within the region the vehicle is driven three times as fast.
    rows = np.arange(400) < 100
    lags[rows] *= 3.0
    response = _list_responses(lags, 0)
    assert np.abs(response).max() == pytest.approx(1.0)
    error = -0.2 * lags[:, 0, 0]
    inside = float((error[rows] ** 2).sum())
    assert inside > 0.7 * float((error**2).sum())
    assert _expect_square(response, error, rows) == pytest.approx(inside, rel=0.1)
    # What more there is in the region is its own.
    error[rows] *= 2.0
    assert _expect_square(response, error, rows) == pytest.approx(inside, rel=0.1)


def test_a_region_counts_beyond_what_is_no_matter_of_it() -> None:
    for kind, share, expected, counts in [
        ("command", 0.40, 0.30, True),
        ("command", 0.38, 0.30, False),
        ("place", 0.75, 0.70, False),
        ("place", 0.75, 0.45, True),
        ("time", 0.30, 0.19, True),
        # In a fifth of the time there is a fifth of the error, whatever the commands let expect.
        ("time", 0.21, 0.10, False),
    ]:
        time_share = {"place": 0.5, "time": 0.2}.get(kind, expected)
        region = Region("x", kind, "turning", (1.0,), share, time_share, 0.1, expected)
        assert (pick_regions([region], np.ones((4, 3)), _NOISE) == [region]) == counts
