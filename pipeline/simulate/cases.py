"""Named scenarios with changes: what the command line asks for, made into a log."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, Unpack, get_args

from pipeline.simulate.case_table import CASES, Case
from pipeline.simulate.effects import CATALOGUE, EffectSpec, resolve_effects
from pipeline.simulate.errors import SimulateError, unknown_name
from pipeline.simulate.layouts import find_layout
from pipeline.simulate.mujoco_vehicle import simulate_skid_steer
from pipeline.simulate.platforms import find_platform
from pipeline.simulate.played import read_played
from pipeline.simulate.record import write_log
from pipeline.simulate.run import simulate_run
from pipeline.simulate.scenario import Ground, ProgramName, Scenario
from pipeline.simulate.vehicles import find_vehicle

_BY_NAME = {case.name: case for case in CASES}
_SAMPLES = ("husky_tile", "warthog_ice", "ackermann_gravel")
_LESSON_SLOPE_RAD = math.radians(8.0)


class Changes(TypedDict, total=False):
    """What is otherwise than in a case; None keeps what it has.

    Attributes:
        seed: of all random numbers.
        duration_s: length of the run.
        vehicle: a name of `VEHICLES`; brings its usual layout along.
        layout: a name of `LAYOUTS`.
        program: what is driven.
        platform: a name of `PLATFORMS`; brings its vehicle and topics along.
    """

    seed: int | None
    duration_s: float | None
    vehicle: str | None
    layout: str | None
    program: str | None
    platform: str | None


def list_cases() -> tuple[Case, ...]:
    """Every named case."""
    return CASES


def list_effects() -> tuple[EffectSpec, ...]:
    """Every effect that can be asked for, in the order of a command's way."""
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
        out: file to write, or a folder, which gets ``<case>.mcap``.
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
        scenario = _play(scenario, play, name)
    target = out / f"{name or 'simulated'}.mcap" if out.is_dir() else out
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        machine = None if name is None else find_case(name).machine
        run = simulate_run(scenario) if machine is None else simulate_skid_steer(scenario, machine)
        write_log(run, target)
    except OSError as problem:
        what = f"the log cannot be written ({problem.strerror})"
        raise SimulateError("cannot_write", what, where=str(target), hint="Choose another --out") from problem
    return target


def _play(scenario: Scenario, path: Path, name: str | None) -> Scenario:
    """The scenario driven with the commands of a recording."""
    _refuse_machine(name, "drives its own program", "Leave --play out")
    played = read_played(path, scenario.vehicle)
    return replace(scenario, played=played, duration_s=max(float(played.time_s[-1]) + 0.5, 1.0))


def _refuse_machine(name: str | None, why: str, hint: str) -> None:
    if name is not None and find_case(name).machine is not None:
        what, hint = f"a case of rigid bodies {why}", f"{hint} or choose another case"
        raise SimulateError("wrong_vehicle", what, where=name, hint=hint)


def make_scenario(
    name: str | None,
    effects: Mapping[str, Mapping[str, float] | float] | None = None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    vehicle: str | None = None,
    layout: str | None = None,
    program: str | None = None,
    platform: str | None = None,
) -> Scenario:
    """The scenario of a named case with changes; see `Changes`."""
    scenario = Scenario() if name is None else find_case(name).scenario
    if vehicle or platform:
        _refuse_machine(name, "keeps its own vehicle", "Leave the vehicle out")
    if vehicle is not None:
        usual = replace(scenario.recording, layout="usual")
        scenario = replace(scenario, vehicle=find_vehicle(vehicle), recording=usual)
    if layout is not None:
        scenario = replace(scenario, recording=replace(scenario.recording, layout=layout))
    if platform is not None:
        made = find_platform(platform)
        recording = replace(scenario.recording, layout=made.layout, deployment="absent")
        scenario = replace(scenario, vehicle=made.vehicle, recording=recording)
    find_layout(scenario.recording.layout, scenario.vehicle)
    if program is not None:
        known = get_args(ProgramName)
        if program not in known:
            raise unknown_name("program", program, sorted(known))
        scenario = replace(scenario, program=replace(scenario.program, name=program))  # type: ignore[arg-type]
    asked = {**scenario.effects, **_fill_usual_sizes(effects or {})}
    resolve_effects(asked, scenario.vehicle.kind)
    ground = scenario.ground
    if "slope_drift" in asked and ground == Ground():
        # On level ground the effect would leave no trace at all.
        ground = Ground(pitch_rad=_LESSON_SLOPE_RAD)
    return replace(
        scenario,
        effects=asked,
        ground=ground,
        seed=scenario.seed if seed is None else seed,
        duration_s=scenario.duration_s if duration_s is None else duration_s,
    )


def _fill_usual_sizes(
    effects: Mapping[str, Mapping[str, float] | float],
) -> dict[str, Mapping[str, float] | float]:
    filled: dict[str, Mapping[str, float] | float] = dict(effects)
    for name, given in effects.items():
        if given == {} and name in CATALOGUE:
            filled[name] = {
                item.name: item.typical for item in CATALOGUE[name].parameters if not math.isnan(item.typical)
            }
    return filled


def write_samples(directory: Path) -> list[Path]:
    """Write the three sample logs into a folder, which is made if need be.

    Returns:
        The files written: ``husky_tile.mcap``, ``warthog_ice.mcap`` and ``ackermann_gravel.mcap``.
    """
    directory.mkdir(parents=True, exist_ok=True)
    return [simulate_case(name, out=directory / f"{name}.mcap") for name in _SAMPLES]
