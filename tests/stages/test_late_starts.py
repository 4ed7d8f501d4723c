"""Starts that the drive follows late, by a different delay each: marked, applied late, and reported."""

import numpy as np
import polars as pl
import pytest
from few import few

from pipeline.run import Alignment, load_run, tabulate_alignment
from pipeline.sources import Vehicle, find_preset
from pipeline.stages.drive_numbers import mark_late_starts, measure_responses
from pipeline.words import format_finding

Arrays = np.ndarray
RATE, DEAD_S, RAMP = 20.0, 0.15, 4.0


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return find_preset("warthog")


def drive(
    seed: int, lateness: Arrays, *, stops: bool = True, back: bool = True, ramp: float = RAMP
) -> tuple[pl.DataFrame, pl.DataFrame, Arrays]:
    """Commands and wheels [rad/s] of steps of 4 s: every third one starts from rest, with its lateness.

    The sides follow a ramp after a dead time; they share no code with the estimate. Without steps `back`,
    every start is followed by a stop.
    """
    generator = np.random.default_rng(seed)
    times, step_s = np.arange(0.0, 12.0 * lateness.size, 0.001), 0.001
    asked, delay, starts = np.zeros((times.size, 2)), np.full(times.size, DEAD_S), []
    for number, late in enumerate(lateness.tolist()):
        for part in range(3):
            rows = slice(
                int((12.0 * number + 4.0 * part) / step_s), int((12.0 * number + 4.0 * part + 4.0) / step_s)
            )
            if (part == 0 and stops) or (part == 2 and not back):
                continue
            size = generator.uniform(4.0, 10.0) * generator.choice((-1.0, 1.0))
            asked[rows] = size + generator.uniform(-2.0, 2.0) * np.array([-1.0, 1.0])
            if part == 1:
                starts.append(times[rows.start])
                delay[rows] = DEAD_S + late
    wheels, state = np.zeros_like(asked), np.zeros(2)
    for index in range(times.size):
        source = max(index - int(delay[index] / step_s), 0)
        pull = np.clip((asked[source] - state) / 0.1, -ramp / 0.3, ramp / 0.3)
        state = state + step_s * pull
        wheels[index] = state
    rows = slice(None, None, int(1.0 / RATE / step_s))
    frames = [
        pl.DataFrame({"t": times[rows], "left": one[rows, 0], "right": one[rows, 1]}).with_columns(
            pl.lit(value=True).alias("active")
        )
        for one in (asked, wheels)
    ]
    return frames[0], frames[1], np.array(starts)


def find_marked(commands: pl.DataFrame, starts: Arrays) -> Arrays:
    """Seconds from each start for which the commands are not followed."""
    times, followed = commands["t"].to_numpy(), commands["followed"].to_numpy()
    return np.array([np.count_nonzero(~followed[(times >= t) & (times < t + 2.0)]) / RATE for t in starts])


def test_late_starts_are_marked_for_as_long_as_they_are_late(vehicle: Vehicle) -> None:
    lateness = np.array([0.0, 0.35, 0.0, 0.8, 0.0, 0.2, 0.0, 0.0, 0.5, 0.0])
    commands, wheels, starts = drive(1, lateness)
    marked, findings = mark_late_starts(commands, wheels, vehicle)
    assert np.abs(find_marked(marked, starts) - lateness).max() <= 0.1
    assert (~marked["followed"]).sum() == round(RATE * find_marked(marked, starts).sum())
    (found,) = findings
    assert (found.id, found.count) == ("late_start", 4)
    assert found.value == pytest.approx(0.8, abs=0.06)
    assert "in 4 of 10 starts" in format_finding(found)


@pytest.mark.parametrize("seed", few(range(6), 3))
def test_a_drive_that_is_never_late_has_no_late_start(vehicle: Vehicle, seed: int) -> None:
    commands, wheels, _ = drive(seed, np.zeros(8))
    marked, findings = mark_late_starts(commands, wheels, vehicle)
    assert marked["followed"].all()
    assert not findings


@pytest.mark.parametrize("seed", few(range(2), 2))
def test_starts_that_are_alike_are_a_property_of_the_drive(vehicle: Vehicle, seed: int) -> None:
    commands, wheels, _ = drive(seed, np.full(40, 0.4))
    steps = measure_responses(commands, wheels, vehicle)
    assert np.median(steps.late[steps.is_first]) == pytest.approx(0.4, abs=0.08)
    marked, findings = mark_late_starts(commands, wheels, vehicle)
    assert marked["followed"].all()
    assert not findings


@pytest.mark.parametrize("ramp", few([0.8, 1.5], 2))
def test_a_limit_that_shows_in_starts_and_stops_alone_is_no_lateness(vehicle: Vehicle, ramp: float) -> None:
    commands, wheels, _ = drive(6, np.zeros(25), back=False, ramp=ramp)
    marked, findings = mark_late_starts(commands, wheels, vehicle)
    assert marked["followed"].all()
    assert not findings


def test_starts_outside_the_live_intervals_do_not_count(vehicle: Vehicle) -> None:
    lateness = np.array([0.0] * 6 + [0.35, 0.8, 0.2, 0.5])
    commands, wheels, _ = drive(1, lateness)
    live = commands.with_columns((pl.col("t") < 72.0).alias("active"))
    marked, findings = mark_late_starts(live, wheels, vehicle)
    assert marked["followed"].all()
    assert not findings


def test_the_first_command_after_a_gap_of_the_recording_may_be_late(vehicle: Vehicle) -> None:
    lateness = np.array([0.0, 0.4, 0.0, 0.0, 0.7, 0.0, 0.2, 0.0])
    commands, wheels, starts = drive(3, lateness, stops=False)
    times = commands["t"].to_numpy()
    lost = np.zeros(times.size, dtype=bool)
    for start in starts:
        lost |= (times >= start - 1.0) & (times < start)
    marked, findings = mark_late_starts(
        commands.filter(pl.Series(~lost)), wheels.filter(pl.Series(~lost)), vehicle
    )
    assert np.abs(find_marked(marked, starts) - lateness).max() <= 0.1
    assert findings


def test_commands_that_are_not_repeated_stay(vehicle: Vehicle) -> None:
    commands, wheels, _ = drive(4, np.array([0.0, 0.5, 0.0, 0.9, 0.0, 0.3]))
    changes = commands.filter((pl.col("left").diff() != 0.0) | (pl.col("t") == 0.0))
    marked, findings = mark_late_starts(changes, wheels, vehicle)
    assert marked["followed"].all()
    assert not findings


def test_a_log_without_commands_or_wheels_has_none(vehicle: Vehicle) -> None:
    commands, wheels, _ = drive(5, np.zeros(2))
    assert mark_late_starts(pl.DataFrame(), wheels, vehicle)[0].is_empty()
    assert mark_late_starts(commands, pl.DataFrame(), vehicle)[0]["followed"].all()


def make_poses(times: pl.Series) -> pl.DataFrame:
    """A table of poses of a vehicle that stands."""
    numbers = dict.fromkeys(("x", "y", "z", "q_x", "q_y", "q_z", "latency"), 0.0) | {"q_w": 1.0}
    still = pl.DataFrame({"t": times}).with_columns(
        pl.lit(value).alias(name) for name, value in numbers.items()
    )
    return still.with_columns(
        pl.lit(0).alias("segment"), pl.lit(value=False).alias("held"), pl.lit(value=True).alias("active")
    )


def test_models_get_no_command_before_the_drive_followed_it(vehicle: Vehicle) -> None:
    lateness = np.array([0.0, 0.35, 0.0, 0.8, 0.0, 0.2, 0.0, 0.0])
    commands, wheels, starts = drive(1, lateness)
    marked, _ = mark_late_starts(commands, wheels, vehicle)
    aligned = tabulate_alignment(Alignment())
    tables = {"commands": marked, "wheels": wheels, "poses": make_poses(commands["t"]), "alignments": aligned}
    run = load_run(tables, vehicle, name="run")
    late = starts[3]
    between = (run.commands.times >= late) & (run.commands.times < late + 0.7)
    assert not between.any()


def test_a_short_gap_and_a_late_start_put_no_stop_into_the_commands(vehicle: Vehicle) -> None:
    lateness = np.array([0.0, 0.7, 0.0, 0.0, 0.9, 0.0, 0.4, 0.0])
    commands, wheels, starts = drive(3, lateness, stops=False)
    lost = np.zeros(commands.height, dtype=bool)
    for start in starts:
        lost |= (commands["t"].to_numpy() >= start - 0.3) & (commands["t"].to_numpy() < start)
    marked, findings = mark_late_starts(commands.filter(pl.Series(~lost)), wheels, vehicle)
    assert findings
    aligned = tabulate_alignment(Alignment(hold_s=0.5))
    tables = {"commands": marked, "wheels": wheels, "poses": make_poses(commands["t"]), "alignments": aligned}
    run = load_run(tables, vehicle, name="run")
    assert np.count_nonzero(run.commands.left[:-1] == 0.0) == 0
