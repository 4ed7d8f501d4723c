"""Commands on drives: plan, what to drive next; and simulate."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline import api, models
from pipeline.cli.conventions import (
    CLEAN,
    LOSSY,
    Choices,
    Force,
    Results,
    build_options,
    open_shown,
    print_json,
    print_lines,
    print_note,
    print_result,
    require_new,
    show_progress,
    spell_choices,
    spell_flags,
)
from pipeline.core import SlipError, align_rows

if TYPE_CHECKING:
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
    force: Force = False,
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
    names, silent = list(runs or []), quiet or json
    opened, progress = partial(open_shown, quiet=silent), partial(show_progress, quiet=silent)
    if check is not None:
        driven = api.check_drive(check, names, options, opened=opened, progress=progress)
        home = (check if check.is_dir() else check.parent).resolve()
        said += spell_flags({"folder": f"{home.name}_next"})
        following = None
        if driven.following is not None:
            together = shlex.join(dict.fromkeys([*driven.earlier, *names]))
            following = f"slip plan {together}{driven.following}{said}"
        if json:
            checked = driven.checked
            print_json({"kept": checked.outcomes, "open": checked.open, "next": following, "errors": []})
        elif not quiet:
            print_lines([*driven.describe(), *([f"next      {following}"] if following else [])])
        return LOSSY if driven.lossy else CLEAN
    require_new(*api.list_plan_files(folder), force=force)
    made = api.plan_drive(
        names,
        options,
        folder,
        vehicle=vehicle,
        time=time,
        area=area,
        max_speed=max_speed,
        max_yaw_rate=max_yaw_rate,
        max_acceleration=max_acceleration,
        topic=topic,
        type_name=type_name,
        opened=opened,
        progress=progress,
    )
    if made.warning:
        print_note(f"slip: {made.warning}")
    if json:
        print_json({**made.to_json(), "errors": []})
    elif not quiet:
        print_lines(made.describe(said))
    return LOSSY if made.lossy else CLEAN


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
    file: Path = Path("run.mcap"),
    force: Force = False,
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
        file: the log to write, or a folder to write it to, named after the case.
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
    path = file / f"{case or 'simulated'}.mcap" if file.is_dir() else file
    require_new(path, force=force)
    simulate_case(
        case,
        effects,
        out=path,
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
