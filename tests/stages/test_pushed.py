"""A robot that people push or carry while nothing drives it, and one whose localization only jitters."""

from typing import cast

import numpy as np
import polars as pl
import pytest
from few import few
from motion_runs import vehicle_of

from pipeline.core import Floats
from pipeline.stages.inputs import Ideal
from pipeline.stages.spans import Span, find_spans

STEP_S = 0.05
JACKAL = vehicle_of("jackal")
PAUSES = (30.0, 70.0, 100.0)
"""Starts of pauses of ten seconds [s]."""


def find_incidents(moved: Floats, drift: Floats, *, rolls: bool = False, counted: bool = True) -> list[Span]:
    """Incidents of two minutes of driving with pauses.

    Args:
        moved: velocity ahead that people add [m/s], shape (n,).
        drift: what the localization adds to it [m/s], shape (n,).
        rolls: whether the wheels turn with it.
        counted: whether there are encoders.
    """
    random = np.random.default_rng(4)
    times = np.arange(0.0, 120.0, STEP_S)
    speed = np.repeat(random.uniform(0.3, 0.8, 40) * random.choice([-1.0, 1.0], 40), 60)
    turn = np.repeat(random.uniform(-0.8, 0.8, 40), 60)
    for start in PAUSES:
        pause = (times >= start) & (times < start + 10.0)
        speed[pause] = turn[pause] = 0.0
    asked = np.column_stack((speed, 0.0 * speed, turn))
    kernel = np.exp(-np.arange(0.0, 2.0, STEP_S) / 0.25)
    driven = np.column_stack([np.convolve(one, kernel / kernel.sum())[: times.size] for one in asked.T])
    body = (
        driven + np.column_stack((moved + drift, drift, 0.0 * drift)) + random.normal(0, 0.004, driven.shape)
    )
    if rolls:
        driven = driven + np.column_stack((moved, 0.0 * moved, 0.0 * moved))
    velocities = pl.DataFrame({"t": times} | dict(zip(("v_x", "v_y", "v_w"), body.T, strict=True)))
    poses = pl.DataFrame({"t": times, "held": np.zeros(times.size, dtype=bool)})
    never, always = np.zeros(times.size, dtype=bool), np.ones(times.size, dtype=bool)
    inputs = {"command": Ideal(asked, never, always)}
    if counted:
        inputs["measured"] = Ideal(driven, never, always)
    return list(find_spans(velocities, poses, inputs, JACKAL, 0.5).incidents)


def push(start: float, seconds: float, metres: float) -> Floats:
    """Velocity of a body that is moved this far."""
    times = np.arange(0.0, 120.0, STEP_S)
    inside = (times >= start) & (times < start + seconds)
    peak = 0.5 * np.pi * metres / seconds
    return cast("Floats", np.where(inside, peak * np.sin(np.pi * (times - start) / seconds), 0.0))


@pytest.mark.parametrize(
    ("rolls", "counted", "kind"),
    [(False, True, "pushed"), (True, True, "manual_driving"), (False, False, "manual_driving")],
)
@pytest.mark.parametrize(("metres", "seconds"), few([(0.11, 2.0), (-0.3, 2.0), (0.2, 1.5), (0.2, 1.0)], 2))
def test_who_pushes_a_robot_is_found_with_its_times(
    metres: float, seconds: float, kind: str, *, rolls: bool, counted: bool
) -> None:
    moved = push(74.0, seconds, metres)
    (found,) = find_incidents(moved, 0.0 * moved, rolls=rolls, counted=counted)
    assert found.kind == kind
    assert found.start == pytest.approx(74.0, abs=1.0)
    assert found.end == pytest.approx(74.0 + seconds, abs=1.0)


def test_poses_that_jitter_at_rest_are_no_push() -> None:
    """As matches of scans do while people walk by: fast at times, and never far."""
    times = np.arange(0.0, 120.0, STEP_S)
    jitter = np.where((times > 72.0) & (times < 78.0), 0.05 * np.sin(5.0 * times), 0.0)
    assert find_incidents(0.0 * jitter, jitter) == []
