"""`slip simulate`: logs with known effects, for teaching and tests."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.cli.output import print_result
from pipeline.core.errors import SlipError


def simulate(  # noqa: D417 - arguments document themselves
    case: Annotated[str | None, Parameter(help="a named case; without one, a plain vehicle")] = None,
    /,
    *,
    effect: Annotated[
        list[str] | None,
        Parameter(help="ID, ID=VALUE or ID=NAME:VALUE,NAME:VALUE; may be repeated", negative=()),
    ] = None,
    out: Path = Path("run.mcap"),
    seed: int | None = None,
    duration: PositiveFloat | None = None,
    vehicle: str | None = None,
    layout: str | None = None,
    program: str | None = None,
    platform: str | None = None,
    play: Path | None = None,
    cases: Annotated[bool, Parameter(negative=())] = False,
    json: bool = False,
) -> int:
    """Write a log with known physics; the truth stays out of it.

    Args:
        out: the log to write.
        seed: seed of driving and noise.
        duration: length of the run [s].
        vehicle: simulated vehicle.
        layout: layout of topics.
        program: how the vehicle is driven.
        platform: whose vehicle, topics, types and frames the log has (husky_a200, turtlebot4, ...).
        play: commands to drive the hidden physics with in place of a program, as `slip plan` writes them.
        cases: list the cases and effects instead.
        json: print one JSON object.
    """
    from pipeline.simulate import PLATFORMS, list_cases, list_effects, simulate_case  # noqa: PLC0415 - heavy

    if cases:
        topics = {name: [one.topic for one in PLATFORMS[name].topics] for name in sorted(PLATFORMS)}
        lists = {
            "cases": {found.name: found.shows for found in list_cases()},
            "effects": {found.id: found.formula for found in list_effects()},
            "platforms": {name: ", ".join(published) for name, published in topics.items()},
        }
        return print_result(lists, lambda: _describe(lists), json=json)
    effects = dict(_parse_effect(text) for text in effect or [])
    path = simulate_case(
        case,
        effects,
        out=out,
        seed=seed,
        duration_s=duration,
        vehicle=vehicle,
        layout=layout,
        program=program,
        platform=platform,
        play=play,
    )
    return print_result({"path": str(path), "effects": effects}, lambda: [str(path)], json=json)


def _parse_effect(text: str) -> tuple[str, dict[str, float] | float]:
    """`drive_lag`, `drive_lag=0.6` or `turn_lag=tau_mean:0.4,tau_diff:1.2`."""
    name, given, values = text.partition("=")
    if not given:
        return name, {}
    try:
        if ":" not in values:
            return name, float(values)
        pairs = (pair.partition(":") for pair in values.split(","))
        return name, {key.strip(): float(value) for key, _, value in pairs}
    except ValueError:
        raise SlipError(
            "bad_effect",
            f"the effect {text!r} has no number where one belongs",
            hint="Write ID, ID=VALUE or ID=NAME:VALUE,NAME:VALUE; `slip simulate --cases` lists them.",
        ) from None


def _describe(lists: dict[str, dict[str, str]]) -> list[str]:
    lines = []
    for title, rows in lists.items():
        width = max(len(name) for name in rows)
        lines += [title, *(f"  {name:<{width}}  {text}" for name, text in rows.items())]
    return lines
