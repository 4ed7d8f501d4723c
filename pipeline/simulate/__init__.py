"""Logs with known physics: for teaching, and for judging the estimators.

A `Scenario` says everything about a run; `simulate_run` drives it and `write_log` records it. The
physics is written here a second time, independently: nothing is shared with the models that are fitted.
Scenarios that have a name stand here, simulated and written as logs: never a word of the truth.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, TypedDict, TypeVar, Unpack, get_args

import numpy as np

from pipeline.core import Floats, Ints
from pipeline.simulate.facts import (
    CATALOGUE,
    LAYOUTS,
    VEHICLES,
    EffectSpec,
    Field,
    Layout,
    ParameterSpec,
    SimulateError,
    Vehicle,
    find_layout,
    find_vehicle,
    read_facts,
    resolve_effects,
    unknown_name,
)
from pipeline.simulate.messages import list_topics, publish
from pipeline.simulate.path import SLOPE_EFFECTS
from pipeline.simulate.programs import read_played
from pipeline.simulate.run import SimulatedRun, simulate_run
from pipeline.simulate.scenario import (
    Clock,
    Disturbance,
    Drive,
    Encoders,
    Ground,
    Imu,
    Messages,
    PoseSensor,
    Program,
    ProgramName,
    Recording,
    Scenario,
    State,
)

_MARK = ("simulation", {"by": "slip simulate"})
"""Metadata record of every simulated log: it is never pooled with recordings."""


def write_log(run: SimulatedRun, path: Path, *, marked: bool = True) -> None:
    """Write a run as an MCAP log; the same run gives the same bytes.

    Args:
        run: what was simulated.
        path: file to write; its folder must exist.
        marked: whether its metadata say that it is simulated, as they must wherever it may meet recordings.

    Raises:
        SimulateError: ``unknown_layout`` or ``wrong_vehicle``, before anything is written.
    """
    # Naming cases and effects on the command line must not wait for the writer.
    from pipeline.logs.writer import LogWriter  # noqa: PLC0415

    scenario = run.scenario
    layout = find_layout(scenario.recording.layout, scenario.vehicle)
    tables = publish(run, list_topics(layout, scenario))
    with LogWriter(path) as writer:
        for table in map(scenario.recording.lose, tables) if scenario.recording.lose else tables:
            header = None if table.header_s is None else scenario.clock.stamp_headers(table.header_s)
            writer.write_columns(
                table.topic,
                table.type_name,
                scenario.clock.stamp_log(table.log_s),
                table.fields,
                header_time=header,
            )
        if marked:
            writer.metadata(*_MARK)
        if scenario.recording.deployment == "written":
            writer.metadata(
                "deployment", {"vehicle": scenario.vehicle.name, "terrain": scenario.recording.terrain}
            )


Made = TypeVar("Made")


@dataclass(frozen=True)
class Case:
    """A named scenario and what it shows, in one line."""

    name: str
    shows: str
    scenario: Scenario


def _ride_oval_wheel(state: State) -> tuple[float, float, float]:
    # An out-of-round left wheel: 4 % of radius, once a turn.
    vehicle, uneven = VEHICLES["husky"], 0.04 * math.sin(state.left_angle)
    rim = vehicle.wheel_radius_m * state.left_speed
    return 0.5 * uneven * rim, 0.0, -uneven * rim / vehicle.track_width_m


_EXTRAS = {"oval_wheel": _ride_oval_wheel}


def _change(base: Made, changes: Mapping[str, Any]) -> Made:
    """A copy with other fields; a table changes fields of what stands there."""
    fields = {}
    for name, given in changes.items():
        before = getattr(base, name)
        inner = is_dataclass(before) and isinstance(given, dict)
        fields[name] = _change(before, given) if inner else given
    return replace(base, **fields)  # type: ignore[type-var]


def _change_scenario(base: Scenario, given: dict[str, Any]) -> Scenario:
    if isinstance(given.get("vehicle"), str):
        given["vehicle"] = VEHICLES[given["vehicle"]]
    if "extra" in given:
        given["extra"] = _EXTRAS[given["extra"]]
    return _change(base, given)


_BASES: dict[str, Scenario] = {}
for _name, _given in read_facts("bases.toml").items():
    _BASES[_name] = _change_scenario(_BASES.get(_given.pop("base", ""), Scenario()), _given)


def _make_case(name: str, given: dict[str, Any]) -> Case:
    shows, base = given.pop("shows"), _BASES[given.pop("base")]
    return Case(name, shows, _change_scenario(base, given))


CASES = tuple(_make_case(name, given) for name, given in read_facts("cases.toml").items())

_BY_NAME = {case.name: case for case in CASES}
_LESSON_HILLS = Ground(hill_m=0.5, hill_length_m=20.0)
"""Ground of a run that is asked for an effect of slopes: hills of up to a quarter of slope."""


class Changes(TypedDict, total=False):
    """What is otherwise than in a case; None keeps what it has.

    Attributes:
        seed: of all random numbers.
        duration_s: length of the run.
        vehicle: one, or a name of `VEHICLES`; brings its usual layout along.
        layout: one, or a name of `LAYOUTS`.
        program: what is driven.
        written: see `Scenario`.
    """

    seed: int | None
    duration_s: float | None
    vehicle: str | Vehicle | None
    layout: str | Layout | None
    program: str | None
    written: tuple[EffectSpec, ...]


def list_cases() -> tuple[Case, ...]:
    """Every named case."""
    return CASES


def list_effects() -> tuple[EffectSpec, ...]:
    """Every effect that can be asked for, in the order of the command path."""
    return tuple(CATALOGUE.values())


def find_case(name: str) -> Case:
    """The named case.

    Raises:
        SimulateError: ``unknown_case``.
    """
    if name not in _BY_NAME:
        raise unknown_name("case", name, sorted(_BY_NAME))
    return _BY_NAME[name]


def simulate_case(
    name: str | None,
    effects: Mapping[str, Mapping[str, float] | float] | None = None,
    *,
    out: Path,
    play: Path | None = None,
    **changes: Unpack[Changes],
) -> Path:
    """Simulate a named case, or a plain one, with changes, and write its log.

    Args:
        name: a case of `list_cases`; None for a plain vehicle without any effect.
        effects: added to the case's own, or in place of them where the id is the same. An empty mapping means
            the effect's usual size.
        out: file to write.
        play: a recording of commands that are driven in place of a program, for as long as they last.
        changes: see `Changes`.

    Returns:
        The file that was written.

    Raises:
        SimulateError: an unknown case, effect, parameter, vehicle, layout or program, an impossible value or
            combination, or a folder that cannot be written.
    """
    scenario = make_scenario(name, effects, **changes)
    if play is not None:
        scenario = _play(scenario, play)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_log(simulate_run(scenario), out)
    except OSError as problem:
        what = f"the log cannot be written ({problem.strerror})"
        raise SimulateError("cannot_write", what, where=str(out), hint="Choose another --file") from problem
    return out


def _play(scenario: Scenario, path: Path) -> Scenario:
    """The scenario driven with the commands of a recording."""
    played = read_played(path, scenario.vehicle)
    return replace(scenario, played=played, duration_s=max(float(played.time_s[-1]) + 0.5, 1.0))


def make_scenario(
    name: str | None,
    effects: Mapping[str, Mapping[str, float] | float] | None = None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    vehicle: str | Vehicle | None = None,
    layout: str | Layout | None = None,
    program: str | None = None,
    written: tuple[EffectSpec, ...] = (),
) -> Scenario:
    """The scenario of a named case with changes; see `Changes`."""
    scenario = Scenario() if name is None else find_case(name).scenario
    if vehicle is not None:
        usual = replace(scenario.recording, layout="usual")
        made = find_vehicle(vehicle) if isinstance(vehicle, str) else vehicle
        scenario = replace(scenario, vehicle=made, recording=usual)
    if layout is not None:
        scenario = replace(scenario, recording=replace(scenario.recording, layout=layout))
    find_layout(scenario.recording.layout, scenario.vehicle)
    if program is not None:
        known = get_args(ProgramName)
        if program not in known:
            raise unknown_name("program", program, sorted(known))
        scenario = replace(scenario, program=replace(scenario.program, name=program))  # type: ignore[arg-type]
    asked = {**scenario.effects, **_fill_usual_sizes(effects or {}, written)}
    resolve_effects(asked, scenario.vehicle.kind, written)
    ground = scenario.ground
    if not {*SLOPE_EFFECTS, "grade_load"}.isdisjoint(asked) and ground == Ground():
        # On level ground these effects would leave no trace at all.
        ground = _LESSON_HILLS
    return replace(
        scenario,
        effects=asked,
        written=written,
        ground=ground,
        seed=scenario.seed if seed is None else seed,
        duration_s=scenario.duration_s if duration_s is None else duration_s,
    )


def _fill_usual_sizes(
    effects: Mapping[str, Mapping[str, float] | float], written: tuple[EffectSpec, ...]
) -> dict[str, Mapping[str, float] | float]:
    filled: dict[str, Mapping[str, float] | float] = dict(effects)
    known = CATALOGUE | {spec.id: spec for spec in written}
    for name, given in effects.items():
        if given == {} and name in known:
            filled[name] = {
                item.name: item.typical for item in known[name].parameters if not math.isnan(item.typical)
            }
    return filled
