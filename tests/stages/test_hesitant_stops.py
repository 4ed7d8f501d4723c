"""A stop under commands that a driver hesitates with is one stop."""

import numpy as np
import polars as pl
import pytest

from pipeline.core.arrays import Flags, Floats
from pipeline.sources import find_preset
from pipeline.stages.inputs import Ideal
from pipeline.stages.motion_events import find_events
from pipeline.stages.spans import find_spans

STEP_S = 0.05


def find(command: Floats, is_stopped: Flags, times: Floats | None = None) -> list[tuple[str, float, float]]:
    """Incidents of a vehicle that follows its commands, but for some time."""
    vehicle = find_preset("husky_a200")
    times = np.arange(command.size) * STEP_S if times is None else times
    follows = np.where(is_stopped, 0.0, command)
    flags = np.zeros(command.size, dtype=bool)
    asked, driven = (np.outer(one, [1.0, 0.0, 0.0]) for one in (command, follows))
    inputs = {"command": Ideal(asked, flags, ~flags), "measured": Ideal(driven, flags, ~flags)}
    velocities = pl.DataFrame(dict(zip(("t", "v_x", "v_y", "v_w"), (times, *driven.T), strict=True)))
    poses = pl.DataFrame({"t": times, "held": flags})
    spans = find_spans(velocities, poses, inputs, vehicle, 0.5).incidents
    return [(one.kind, one.start, one.end) for one in spans]


# Live for 1.5 s, then a dip of 0.4 s; live for 0.6 s, then a pause of 1.8 s: never two seconds on end. All of
# it moves this vehicle at other times.
@pytest.mark.parametrize(("period_s", "live_s"), [(1.9, 1.5), (2.4, 0.6)])
def test_a_driver_who_hesitates_under_a_stop_does_not_hide_it(period_s: float, live_s: float) -> None:
    times = np.arange(0.0, 100.0, STEP_S)
    ((kind, start, end),) = find(
        np.where(times % period_s < live_s, 0.5, 0.15), (times >= 50.0) & (times < 58.0)
    )
    assert kind == "stopped"
    assert abs(start - 50.0) < 1.0
    assert abs(end - 58.0) < 1.0


def test_commands_that_never_move_it_show_no_stop() -> None:
    """The slow ones do not overcome friction, at any time."""
    times = np.arange(0.0, 100.0, STEP_S)
    command = np.where(times % 10.0 < 5.0, 0.5, 0.1)
    assert find(command, command < 0.2) == []


def test_segments_that_overlap_where_the_poses_jump_hide_no_stop() -> None:
    times = np.arange(0.0, 100.0, STEP_S)
    twice = np.concatenate((times[times < 30.0], times[times >= 29.5]))
    ((kind, start, end),) = find(
        np.where(twice % 1.9 < 1.5, 0.5, 0.15), (twice >= 50.0) & (twice < 58.0), twice
    )
    assert kind == "stopped"
    assert abs(start - 50.0) < 1.0
    assert abs(end - 58.0) < 1.0


@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["left", "right"])
def test_a_side_that_stands_while_the_other_one_follows_is_told_and_left_out(side: float) -> None:
    """A stuck wheel made all turning of the run an unknown effect."""
    vehicle, rng = find_preset("husky_a200"), np.random.default_rng(3)
    times, half = np.arange(0.0, 120.0, STEP_S), 0.5 * vehicle.track_width_m
    number = (times // 2.5).astype(int)
    asked = np.column_stack(
        (rng.uniform(0.2, 0.8, 60)[number], 0.0 * times, rng.uniform(-0.8, 0.8, 60)[number])
    )
    stuck = (times >= 60.0) & (times < 75.0)
    rim = 0.5 * (asked[:, 0] - side * half * asked[:, 2])
    driven = np.where(stuck[:, None], np.column_stack((rim, 0.0 * rim, -side * rim / half)), asked)
    flags = np.zeros(times.size, dtype=bool)
    inputs = {"command": Ideal(asked, flags, ~flags), "measured": Ideal(driven, flags, ~flags)}
    columns = ("t", "v_x", "v_y", "v_w", "x", "y")
    still = np.zeros((2, times.size))
    velocities = pl.DataFrame(dict(zip(columns, (times, *driven.T, *still), strict=True)))
    poses = pl.DataFrame({"t": times, "held": flags})
    spans = find_spans(velocities, poses, inputs, vehicle, 0.5)
    (told,) = spans.incidents
    assert told.kind == "side_stopped"
    assert abs(told.start - 60.0) < 1.0
    assert abs(told.end - 75.0) < 1.0
    events = find_events(velocities, inputs, vehicle, spans).table
    assert events.filter(pl.col("kind") == "side_stopped")["t_start"].to_list() == [told.start]
