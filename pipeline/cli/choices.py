"""Options that several verbs share: the vehicle, the inputs, where results go."""

import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline.analysis.options import INPUTS, Options

KeyFile: TypeAlias = Annotated[
    Path | None, Parameter(name="--key", help="file of the key that seals the results (or SLIP_KEY_FILE)")
]


def use_key(path: Path | None) -> None:
    """Write and verify results with a key from here on, also in processes that this one starts.

    Raises:
        StoreError: ``bad_key_file``.
    """
    if path is not None:
        from pipeline.store.keys import KEY_VARIABLE, read_key  # noqa: PLC0415 - only where there is a key

        read_key(path)
        os.environ[KEY_VARIABLE] = str(path.absolute())


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What may be said on the command line in place of a configuration file."""

    vehicle: Annotated[str | None, Parameter(help="vehicle preset, for example husky_a200")] = None
    wheel_radius: Annotated[
        PositiveFloat | None, Parameter(help="wheel radius [m], in place of a vehicle")
    ] = None
    track_width: Annotated[PositiveFloat | None, Parameter(help="track width [m], in place of a vehicle")] = (
        None
    )
    dataset: Annotated[str | None, Parameter(help="dataset the run belongs to")] = None
    terrain: Annotated[str | None, Parameter(help="terrain driven on")] = None
    input: Annotated[
        Literal["command", "measured", "both"], Parameter(help="what the ideal model is fed with")
    ] = "both"
    config: Annotated[
        Path | None, Parameter(help="configuration file in place of run.toml beside the log")
    ] = None
    yaw: Annotated[
        Literal["pose", "imu"] | None, Parameter(help="whose yaw rate the slip tables use (default: pose)")
    ] = None
    interval: Annotated[
        Literal["recorded", "all"], Parameter(help="live intervals as the log says, or all of it")
    ] = "recorded"
    max_inflated: Annotated[
        str | None,
        Parameter(
            help="most that the chunks of a log may inflate to, as 20GB (default: 200 times its size, at "
            "least 512 MiB)"
        ),
    ] = None
    out: Annotated[Path, Parameter(help="results folder")] = Path("results")
    key: KeyFile = None


def build_options(choices: Choices) -> Options:
    """Options of a job from the choices on the command line, without a report.

    Raises:
        BatchError: ``bad_size``.
        StoreError: ``bad_key_file``.
    """
    from pipeline.batch import parse_size  # noqa: PLC0415 - heavy

    use_key(choices.key)
    return Options(
        max_inflated=None if choices.max_inflated is None else parse_size(choices.max_inflated),
        out=choices.out,
        config=choices.config,
        overrides=_list_overrides(choices),
        inputs=INPUTS if choices.input == "both" else (choices.input,),
        report=False,
    )


def spell_choices(choices: Choices) -> str:
    """What was said on the command line, to be said again: ` --input measured`; empty where nothing was."""
    said = ((each.name, getattr(choices, each.name)) for each in fields(choices))
    return spell_flags({name: value for name, value in said if value != getattr(Choices(), name)})


def spell_flags(values: Mapping[str, object]) -> str:
    """Flags with their values, a space before each; what is None is left out."""
    said = {name: value for name, value in values.items() if value is not None}
    return "".join(f" --{name.replace('_', '-')} {shlex.quote(str(value))}" for name, value in said.items())


def _list_overrides(choices: Choices) -> Mapping[str, object]:
    """Configuration values that were said on the command line."""
    said: dict[str, dict[str, object]] = {
        "vehicle": {
            "preset": choices.vehicle,
            "wheel_radius_m": choices.wheel_radius,
            "track_width_m": choices.track_width,
        },
        "run": {"dataset": choices.dataset, "terrain": choices.terrain},
        "velocity": {"yaw": choices.yaw},
    }
    kept: dict[str, object] = {}
    for section, values in said.items():
        given = {key: value for key, value in values.items() if value is not None}
        if given:
            kept[section] = given
    if choices.interval == "all":
        kept["use_intervals"] = "all"
    return kept
