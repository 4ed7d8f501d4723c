"""Frames of bases that move sideways: turned, mirrored and reversed poses, along a line and any way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import polars as pl
import pytest
from drawn_motion import STEP, measured
from few import few

from pipeline.core.arrays import Complex, Floats
from pipeline.recording.evidence import find_frame
from pipeline.recording.motion import CLEAR, Motion
from pipeline.recording.readings import Held, Reading
from pipeline.recording.signs import rate_map_axes


def drive(seed: int, *, line: bool = False) -> tuple[Floats, Complex, Floats, Complex, Floats]:
    """Times, what is asked for in the plane and of the heading, and places and headings at 10 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 60.0, STEP)
    number = (time / 2.0).astype(int)
    draws = rng.uniform(-1.0, 1.0, (3, 40))
    asked = (draws[0] + 1j * draws[1])[number]
    rate = draws[2][number]
    if line:
        # A trial along one line: it stands, and drives at one speed.
        asked = np.where((time > 3.0) & (time < 50.0), 0.3 * np.exp(0.6j), 0.0)
        rate = 0.02 * np.sin(time)
    yaw = np.cumsum(0.9 * rate) * STEP
    place = np.cumsum(0.8 * asked * np.exp(1j * yaw)) * STEP
    rows = slice(None, None, 10)
    noise = rng.normal(0.0, 0.002, (3, time[rows].size))
    return time, asked, rate, place[rows] + noise[0] + 1j * noise[1], yaw[rows] + noise[2]


def see(place: Complex, yaw: Floats) -> Motion:
    zero, count = np.zeros(yaw.size), yaw.size
    return measured(pl.DataFrame({
        "t": 0.1 * np.arange(count), "segment": np.zeros(count, dtype=np.int32),
        "x": place.real, "y": place.imag, "z": zero, "q_x": zero, "q_y": zero,
        "q_z": np.sin(0.5 * yaw), "q_w": np.cos(0.5 * yaw),
        "held": np.zeros(count, dtype=bool), "active": np.ones(count, dtype=bool),
    }))  # fmt: skip


def read(time: Floats, asked: Complex, rate: Floats) -> Reading:
    at = slice(None, None, 10)
    signals = (Held(time[at], one[at], may_stand=True) for one in (asked.real, rate, asked.imag))
    return Reading("body", "/cmd_vel", *signals)


@pytest.mark.parametrize("line", [False, True])
@pytest.mark.parametrize("degrees", few([0.0, 90.0, -90.0, 40.0, -60.0, 120.0], 3))
def test_the_angle_of_the_heading_is_found(degrees: float, *, line: bool) -> None:
    time, asked, rate, place, yaw = drive(3, line=line)
    motion = see(place, yaw - np.radians(degrees))
    command = read(time, asked, rate).fitted(motion)
    assert command.explained.is_sure
    turned, margin, _ = find_frame(motion, [command])
    assert not turned.flip
    # Along one line, a heading that is off cannot be told from a ground on which the body slips aside.
    told = degrees if not line or degrees % 90.0 == 0.0 else 0.0
    assert turned.offset_deg == pytest.approx(told, abs=3.0)
    assert (margin > 3.0) == bool(told)


@pytest.mark.parametrize(
    ("change", "flip", "signs"),
    [
        (lambda place, yaw: (place, -yaw), True, (1, 1)),
        (lambda place, yaw: (np.conj(place), -yaw), False, (1, -1)),
        (lambda place, yaw: (place, yaw + np.pi), False, (-1, -1)),
    ],
)
def test_the_hand_and_the_rear_of_a_frame_are_told_by_signs(
    change: Callable[[Complex, Floats], tuple[Complex, Floats]], signs: tuple[int, int], *, flip: bool
) -> None:
    time, asked, rate, place, yaw = drive(4)
    motion = see(*change(place, yaw))
    command = read(time, asked, rate).fitted(motion)
    turned, _, _ = find_frame(motion, [command])
    assert (turned.flip, turned.offset_deg) == (flip, 0.0)
    made = command.explain(turned)
    assert (made.sign("ahead"), made.sign("aside")) == signs


def test_a_command_that_is_the_same_throughout_says_where_the_body_should_go() -> None:
    time, _, rate, place, yaw = drive(5, line=True)
    driven = (time > 3.0) & (time < 50.0)
    asked = np.full(int(driven.sum()), 0.3 * np.exp(0.6j))
    command = read(time[driven], asked, 0.0 * rate[driven]).fitted(see(place, yaw - 0.5 * np.pi))
    assert command.is_constant
    assert command.explained.is_sure


@pytest.mark.parametrize("of_map", [False, True], ids=["body", "map"])
def test_commands_along_the_axes_of_a_map_are_told_from_those_of_the_body(*, of_map: bool) -> None:
    """A formula with the heading in the map was offered for them."""
    time, asked, rate, _, yaw = drive(5)
    turned = np.cumsum(0.9 * rate) * STEP
    place = np.cumsum(0.8 * asked * (1.0 if of_map else np.exp(1j * turned))) * STEP
    noise = np.random.default_rng(6).normal(0.0, 0.002, (2, yaw.size))
    command = read(time, asked, rate).fitted(see(place[::10] + noise[0] + 1j * noise[1], yaw))
    assert (rate_map_axes(command) > CLEAR) == of_map
