"""Commands on drives: plan, what to drive next; and simulate."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, cast

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline import estimation, models, sources, store
from pipeline import plan as planning
from pipeline.cli.conventions import (
    CLEAN,
    LOSSY,
    Choices,
    Results,
    build_options,
    open_shown,
    print_json,
    print_lines,
    print_note,
    print_result,
    show_progress,
    spell_choices,
)
from pipeline.core import SlipError, align_rows, format_count, format_duration

if TYPE_CHECKING:
    from pipeline.analysis import Options
    from pipeline.simulate import EffectSpec
    from pipeline.simulate.facts import Kind


def plan(  # noqa: D417 - the runs document themselves
    runs: Annotated[list[str] | None, Parameter(help="logs, or runs of the results folder")] = None,
    /,
    *,
    vehicle: str | None = None,
    time: str = "60s",
    area: str = "20x10m",
    max_speed: PositiveFloat | None = None,
    max_yaw_rate: PositiveFloat | None = None,
    max_acceleration: PositiveFloat | None = None,
    topic: str | None = None,
    type_name: Annotated[str | None, Parameter(name="--type")] = None,
    check: Path | None = None,
    config: Path | None = None,
    results: Results = Path("results"),
    folder: Path = Path("plan"),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Plan the drive that tells most of what your logs left open.

    The drive is the shortest list of five standard manoeuvres that decides most; an MCAP file plays it.

    Args:
        vehicle: vehicle preset; without logs the plan covers all effects of that vehicle.
        time: longest duration, for example 60s or 2min.
        area: free area: length along the initial heading, and width; the start is in its middle.
        max_speed: highest speed [m/s] (default, as of the yaw rate: what the runs commanded).
        max_yaw_rate: highest yaw rate [rad/s].
        max_acceleration: highest acceleration [m/s^2].
        topic: topic of the commands (default: the recorded one).
        type_name: message type of that topic.
        check: plan.toml, or the plan's folder, to compare with the log of the drive.
        config: configuration file of the logs.
        folder: folder of the plan, to write.
        json: print one JSON object.
        quiet: print no progress and no summary.
    """
    options = build_options(Choices(vehicle=vehicle, config=config, results=results))
    said = spell_choices(Choices(results=results))
    at_work = runs[0] if runs else str(check or vehicle or "plan")
    names = list(runs or [])
    if check is not None:
        return _check(check, names, options, said, json=json, quiet=quiet)
    from pipeline.report.drive_pages import write_drive  # noqa: PLC0415 - heavy

    seconds = planning.parse_time(time)
    gathered = _gather(names, options, quiet=quiet or json) if names else None
    chosen = sources.find_preset(vehicle or "") if gathered is None else gathered.vehicle
    if chosen is None:
        known = ", ".join(preset.id for preset in sources.list_presets())
        what = f"no preset is called {vehicle!r}" if vehicle else "a plan needs a run or a vehicle"
        raise SlipError("no_vehicle", what, hint=f"Give a log, a run, or --vehicle as one of {known}.")
    # Report wrong options before a long diagnosis.
    ground = planning.parse_area(area, chosen)
    with show_progress(at_work, quiet=quiet or json) as progress:
        progress("diagnosis")
        studied, first = planning.Studied(chosen), None
        if gathered is not None:
            studied = planning.study(gathered.recordings, chosen, progress)
            first = gathered.manifests[0]
        limits = planning.choose_limits(
            chosen,
            studied.largest,
            speed_mps=max_speed,
            yaw_rate_radps=max_yaw_rate,
            acceleration_mps2=max_acceleration,
        )
        usual = planning.choose_topic(chosen, first)
        played = (topic or usual[0], type_name or usual[1])
        made = planning.make_plan(studied, limits, ground, seconds, played, progress)
    files = write_drive(made, folder, results)
    shown = _show_in_report(results, gathered.manifests, made) if gathered is not None else []
    if json:
        print_json({**made.to_json(), "files": [str(file) for file in files], "errors": []})
    elif not quiet:
        print_lines([*format_plan(made, studied.driven_s, files, said), *shown])
    return LOSSY if gathered is not None and gathered.lossy else CLEAN


def _show_in_report(results: Path, manifests: Sequence[store.Manifest], made: planning.Plan) -> list[str]:
    """Store the plan with its run, if it is for one stored run, and name the report that shows it."""
    from pipeline.report.drive_pages import leave_plan  # noqa: PLC0415 - heavy

    if len(manifests) != 1:
        return []
    try:
        shown = leave_plan(store.Store(results), manifests[0], made)
    except (SlipError, OSError) as error:
        print_note(f"slip: the report of the run does not show the plan: {error}")
        return []
    return [f"report       {shown} shows it"] if shown is not None else []


class _Gathered(NamedTuple):
    """Runs of one vehicle, and whether one had losses."""

    vehicle: sources.Vehicle
    recordings: list[estimation.Recording]
    manifests: list[store.Manifest]
    lossy: bool


def _gather(
    names: Sequence[str], options: Options, *, quiet: bool, known: _Gathered | None = None
) -> _Gathered:
    """Runs of one vehicle, each once, after those that are known already."""
    from pipeline.estimation.stored_diagnosis import read_recording  # noqa: PLC0415 - heavy

    recordings = [] if known is None else [*known.recordings]
    manifests = [] if known is None else [*known.manifests]
    vehicles = [] if known is None else [known.vehicle] * len(recordings)
    lossy = known is not None and known.lossy
    for name in names:
        with open_shown(name, options, quiet=quiet) as opened:
            vehicle, recording = read_recording(opened.manifest)
        lossy |= opened.lossy
        if recording.sha256 and any(recording.sha256 == known.sha256 for known in recordings):
            continue
        vehicles.append(vehicle)
        recordings.append(recording)
        manifests.append(opened.manifest)
    if other := next((vehicle for vehicle in vehicles if vehicle != vehicles[0]), None):
        fields = other.__struct_fields__
        differing = [name for name in fields if getattr(other, name) != getattr(vehicles[0], name)]
        what = f"the runs are of different vehicles (in {', '.join(differing)}), and a plan is for one"
        where = ", ".join(recording.name for recording in recordings)
        raise SlipError("several_vehicles", what, where=where, hint="Give runs of one vehicle.")
    return _Gathered(vehicles[0], recordings, manifests, lossy)


def _check(path: Path, names: list[str], options: Options, said: str, *, json: bool, quiet: bool) -> int:
    """Compare the plan's predictions with the joint diagnosis of the earlier runs and the drive."""
    stored = planning.read_plan(path)
    if not names:
        what = "a check needs the log that was driven"
        raise SlipError("no_log", what, where=str(path), hint="Give it as well.")
    drive = _gather(names, options, quiet=quiet)
    new = len(drive.recordings)
    before = [name for name in stored.runs if name not in {*names, *(one.name for one in drive.recordings)}]
    if stored.vehicle != drive.vehicle.id:
        what = f"the plan is for {stored.vehicle}, and the log is of {drive.vehicle.id}"
        hint = "Check a plan with logs of the vehicle it was made for."
        raise SlipError("other_vehicle", what, where=str(path), hint=hint)
    vehicle, recordings, _, lossy = _gather(before, options, quiet=quiet, known=drive)
    with show_progress(names[0], quiet=quiet or json) as progress:
        progress("diagnosis")
        driven = [estimation.load_recording(recording, vehicle) for recording in drive.recordings]
        planning.require_played((path if path.is_dir() else path.parent) / "plan.csv", driven, vehicle)
        diagnosis = estimation.diagnose_runs([*recordings[new:], *drive.recordings], vehicle).runs[0]
    checked = planning.check_plan(stored, diagnosis)
    following = f"slip plan {shlex.join(dict.fromkeys([*before, *names]))}{said}"
    if json:
        following_up = following if diagnosis.undecided else None
        print_json({"kept": checked.outcomes, "open": checked.open, "next": following_up, "errors": []})
    elif not quiet:
        rows = [
            f"{'kept' if one['kept'] else 'NOT KEPT':<9} {one['question']}: "
            f"promised {one['promised']}, {one['measured']}"
            for one in checked.outcomes
        ]
        rows += [f"open      {text}" for text in checked.open]
        rows = rows or ["the plan promised nothing"]
        print_lines([*rows, f"next      {following}"] if diagnosis.undecided else rows)
    return LOSSY if lossy else CLEAN


def format_plan(made: planning.Plan, driven_s: float, files: Sequence[Path], said: str = "") -> list[str]:
    """The plan on one screen, what it will decide first.

    Args:
        made: the plan.
        driven_s: length of the logs so far [s]; 0 without logs.
        files: the files that were written.
        said: flags that the next command needs again.
    """
    runs = f"after {format_count(len(made.runs), 'run')} of {format_duration(driven_s)}" if made.runs else ""
    if not made.questions:
        return [f"no open question {runs}: no cause is undecided, and each number is known well enough"]
    ground = f"{made.area.length_m:g} x {made.area.width_m:g} m"
    rows = align_rows([(f"open {runs}".strip(), "so far", "with this drive"), *made.list_rows()])
    most = f"limits       {made.limits.format(steered=made.steered)}"
    if not made.manoeuvres:
        nothing = f"no drive on {ground} of level ground answers an open question: no file is written"
        return [nothing, *(f"  {row}" for row in rows), most]
    names = [f"{number} x {name}" for name, number in Counter(name for name, _ in made.manoeuvres).items()]
    return [
        made.summarize(),
        *(f"  {row}" for row in rows),
        f"drive        {made.commands.duration_s:.0f} s on {ground}: {', '.join(names)}",
        f"place        start in the middle, heading along the length; end within {made.home_m:.1f} m of it",
        most,
        f"play         ros2 bag play {files[2]}    # {made.type_name} on {made.topic}",
        f"page         {files[-1]}",
        *(f"safety       {text}" for text in planning.SAFETY),
        f"afterwards   slip plan --check {shlex.quote(str(files[0]))} NEW.mcap{said}",
    ]


def simulate(  # noqa: D417 - arguments document themselves
    case: Annotated[
        str | None,
        Parameter(help="a named case; without one, a plain vehicle"),
    ] = None,
    /,
    *,
    effect: Annotated[
        list[str] | None,
        Parameter(help="ID, ID=VALUE or ID=NAME:VALUE,NAME:VALUE; may be repeated"),
    ] = None,
    file: Path | None = None,
    seed: int | None = None,
    duration: PositiveFloat | None = None,
    vehicle: str | None = None,
    layout: str | None = None,
    program: str | None = None,
    play: Path | None = None,
    cases: Annotated[bool, Parameter(negative=())] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Write a log with known physics.

    The log does not contain the true values.

    Args:
        file: the log to write (run.mcap).
        seed: seed of driving and noise.
        duration: length of the run [s].
        vehicle: simulated vehicle.
        layout: layout of topics.
        program: how the vehicle is driven.
        play: commands to drive the hidden physics with in place of a program, as `slip plan` writes them.
        cases: list the cases and effects instead.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.simulate import list_cases, list_effects, simulate_case  # noqa: PLC0415 - heavy

    if cases:
        lists = {
            "cases": {one.name: one.shows for one in list_cases()},
            "effects": {one.id: one.formula for one in (*list_effects(), *list_written_effects())},
        }
        lines = [
            line
            for title, rows in lists.items()
            for line in (title, *(f"  {row}" for row in align_rows(list(rows.items()))))
        ]
        return print_result(lists, lambda: lines, json=json)
    effects = dict(_parse_effect(text) for text in effect or [])
    if len(effects) < len(effect or []):
        hint = "Give all its numbers at once: --effect ID=NAME:VALUE,NAME:VALUE."
        raise SlipError("effect_twice", "an effect is given twice", where=" ".join(effect or []), hint=hint)
    path = simulate_case(
        case,
        effects,
        out=file or Path("run.mcap"),
        seed=seed,
        duration_s=duration,
        vehicle=vehicle,
        layout=layout,
        program=program,
        play=play,
        written=() if effects.keys() <= {one.id for one in list_effects()} else list_written_effects(),
    )
    content = {"path": str(path), "effects": effects}
    return print_result(content, lambda: [str(path)], json=json, quiet=quiet)


def list_written_effects() -> tuple[EffectSpec, ...]:
    """Effects of the catalogue that the simulator does not have, by the formulas of their files."""
    from pipeline import simulate  # noqa: PLC0415 - heavy

    known = {effect.id for effect in simulate.list_effects()}
    return tuple(
        simulate.EffectSpec(
            effect.id,
            "; ".join(f"{channel} += {text}" for channel, text in adds.items()),
            tuple(simulate.ParameterSpec(p.name, p.unit, p.neutral, p.typical) for p in effect.parameters),
            cast("tuple[Kind, ...]", effect.kinds),
            adds,
        )
        for effect in models.list_effects()
        if effect.id not in known and (adds := models.list_terms(effect))
    )


def _parse_effect(text: str) -> tuple[str, dict[str, float] | float]:
    """Parse `drive_lag`, `drive_lag=0.6` or `turn_lag=tau_mean:0.4,tau_diff:1.2`."""
    name, given, values = text.partition("=")
    if not given:
        return name, {}
    try:
        if ":" not in values:
            return name, float(values)
        pairs = [pair.partition(":") for pair in values.split(",")]
        numbers = {key.strip(): float(value) for key, _, value in pairs}
    except ValueError:
        raise SlipError(
            "bad_effect",
            f"the effect {text!r} has no number where one belongs",
            hint="Write ID, ID=VALUE or ID=NAME:VALUE,NAME:VALUE; `slip simulate --cases` lists them.",
        ) from None
    if len(numbers) < len(pairs):
        hint = "Give each number of an effect once."
        raise SlipError("number_twice", "a number is given twice", where=text, hint=hint)
    return name, numbers
