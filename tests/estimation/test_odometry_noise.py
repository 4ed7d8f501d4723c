"""AMCL's alphas: of odometry whose noise is drawn as AMCL draws it, and of a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from verbs import print_verb, run_verb

from pipeline.estimation.odometry_noise import fit_alphas, walk
from pipeline.export.odometry import UPDATE_M, UPDATE_RAD
from pipeline.simulate import simulate_case

ALPHAS = (0.05, 0.02, 0.04, 0.01)


def draw_stretch(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Eight updates, and where one particle of AMCL goes (Probabilistic Robotics, table 5.6)."""
    first, second, third, fourth = ALPHAS
    place = particle = 0j
    heading = own = 0.0
    rows = []
    for _ in range(8):
        turns = rng.random() < 0.5
        way = 0.0 if turns else rng.uniform(UPDATE_M, 0.4)
        before = 0.0 if turns else rng.uniform(-0.1, 0.1)
        after = rng.choice((-1, 1)) * rng.uniform(UPDATE_RAD, 0.4) if turns else rng.uniform(-0.3, 0.3)
        noise = rng.standard_normal(3)
        turned = before + noise[0] * np.sqrt(first * before**2 + second * way**2)
        moved = way + noise[1] * np.sqrt(third * way**2 + fourth * (before**2 + after**2))
        place += way * np.exp(1j * (heading + before))
        particle += moved * np.exp(1j * (own + turned))
        heading += before + after
        own += turned + after + noise[2] * np.sqrt(first * after**2 + second * way**2)
        rows.append((place, heading, particle, own))
    moved_to, turned_to, seen, seen_turned = (np.array(column) for column in zip(*rows, strict=True))
    return moved_to, turned_to, seen, seen_turned


def test_noise_that_amcl_would_draw_is_found_again() -> None:
    rng = np.random.default_rng(0)
    walks = [walk(*draw_stretch(rng)) for _ in range(4000)]
    found = fit_alphas(np.array(walks))
    assert found[:3] == pytest.approx(ALPHAS[:3], rel=0.2)
    # What the turns add to the way is the smallest part of its variance.
    assert found[3] == pytest.approx(ALPHAS[3], rel=0.5)


def test_driving_backward_is_no_turn_and_less_than_an_update_is_nothing() -> None:
    back = -0.3 * np.arange(1, 6) + 0j
    turns, ways, heading, along = walk(back, np.zeros(5), back * 1.1, np.full(5, 0.01))  # type: ignore[misc]
    assert turns == pytest.approx(0.0, abs=1e-12)
    assert ways == pytest.approx(5 * 0.09)
    assert (heading, along) == pytest.approx((0.01, 0.15))
    assert walk(back * 0.01, np.zeros(5), back * 0.01, np.zeros(5)) is None


def test_the_verb_measures_them_on_a_log(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "run.mcap", duration_s=60.0)
    model = tmp_path / "husky.toml"
    print_verb("model", "new", model, "effective_track", "--vehicle", "husky_a200")
    refused = run_verb("model", "export", model, "--to", "nav2_amcl")
    assert refused.returncode == 1
    assert "--on LOG" in refused.stderr
    text = print_verb(
        "model", "export", model, "--to", "nav2_amcl", "--on", log, "--results", tmp_path / "results"
    )
    amcl = yaml.safe_load(text)["amcl"]["ros__parameters"]
    # A tile floor and a good localization: far below the 0.2 that AMCL begins with.
    assert all(0.0 <= amcl[f"alpha{number}"] < 0.05 for number in (1, 2, 3, 4))
    assert (amcl["update_min_d"], amcl["update_min_a"]) == (UPDATE_M, UPDATE_RAD)
