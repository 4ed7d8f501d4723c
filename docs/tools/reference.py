"""Pages of the handbook that the program itself knows: effects, verbs, configuration, tables, vehicles."""

from __future__ import annotations

import inspect
import re
import tomllib
import types
import typing
from importlib import resources
from typing import TYPE_CHECKING, Any

import msgspec
from effects_pages import escape, table, write_effect_pages

import schemas
from pipeline.cli import build_app
from pipeline.export import list_targets
from pipeline.logs import TRANSFORM_TYPES
from pipeline.sources import Configuration, list_presets

if TYPE_CHECKING:
    from cyclopts import App

SOURCES = {
    "effects/index.md": "pipeline/models/effects",
    "verbs.md": "pipeline/cli",
    "configuration-keys.md": "pipeline/sources/configuration.py",
    "tables.md": "schemas",
    "vehicles.md": "pipeline/sources/presets",
    "message-types.md": "pipeline/sources/message_types",
    "targets.md": "pipeline/export",
}
"""What a generated page is made of, in the repository. A page written by hand links to this, which a reader
of a checkout can open; in the built handbook the link leads to the page."""

_FIELDS = ("field", "name", "velocity", "position", "orientation", "angle", "rate")
_META = ("--help", "-h", "--version", "--install-completion")


def write_reference() -> dict[str, str]:
    """Every generated page by its path."""
    return {
        **write_effect_pages(),
        "verbs.md": write_verbs(),
        "configuration-keys.md": write_configuration(),
        "tables.md": write_tables(),
        "vehicles.md": write_vehicles(),
        "message-types.md": write_message_types(),
        "targets.md": write_targets(),
    }


def find_page(path: str) -> str | None:
    """The page of the handbook that shows a file or folder of the repository; None where none does."""
    found = {source: page for page, source in SOURCES.items()}.get(path)
    folder, _, name = path.rpartition("/")
    if folder == SOURCES["effects/index.md"]:
        return f"effects/{name.removesuffix('.py')}.md"
    return f"notebooks/{name}" if folder == "examples" and name.endswith(".ipynb") else found


def list_verbs(app: App | None = None, before: str = "slip") -> dict[str, App]:
    """Every verb with the words that call it, verbs of verbs included: `slip model add`."""
    top = app or build_app()
    found: dict[str, App] = {}
    for name in top:
        verb = top[name]
        spelled = {one.default_command for one in (top, *found.values())} - {None}
        if name in _META or verb.default_command in spelled:
            continue  # another spelling of the same verb
        if verb.default_command and inspect.isfunction(verb.default_command):
            found[f"{before} {name}"] = verb
        found |= list_verbs(verb, f"{before} {name}")
    return found


def write_verbs() -> str:
    """Every verb with its arguments and options, as `--help` has them."""
    parts = [
        "# Commands",
        (
            "`slip COMMAND --help` prints the same. Exit codes: 0 clean; 1 failed, with one line that says "
            "what to do; 2 usage; 3 done, but the log had losses or something could not be looked at, "
            "which is listed; 4 a change that `slip check` found."
        ),
    ]
    shared = build_app().default_parameter
    for words, verb in list_verbs().items():
        about = inspect.cleandoc(verb.default_command.__doc__ or "").split("\nArgs:")[0].strip()
        rows = []
        for argument in verb.assemble_argument_collection(default_parameter=shared, parse_docstring=True):
            if not argument.show:
                continue
            names = ", ".join(f"`{name}`" for name in argument.names)
            default = argument.field_info.default
            given = default not in (None, inspect.Parameter.empty, False, (), [])
            choices = ", ".join(map(str, argument.get_choices() or ()))
            says = [escape(argument.parameter.help or "").rstrip("."), f"one of {choices}" if choices else ""]
            shown = f"`{default}`" if given and default is not True else ("yes" if default is True else "")
            rows.append((names, "; ".join(filter(None, says)), shown))
        parts += [f"## {words}", escape(about), table(("argument", "what", "default"), rows)]
    return "\n\n".join(filter(None, parts)) + "\n"


def write_configuration() -> str:
    """Every section and key of run.toml and fleet.toml."""
    parts = [
        "# Configuration, key by key",
        (
            "What `run.toml` beside a log and `fleet.toml` above a folder may hold. Every section and "
            "every key may be left out; a key that is not in this list is an error, with its line. How "
            "the files work together: [Configuration](configuration.md)."
        ),
    ]
    hints = typing.get_type_hints(Configuration)
    for field in msgspec.structs.fields(Configuration):
        section = hints[field.name]
        inner = [each for each in (section, *typing.get_args(section)) if _is_struct(each)]
        if not inner:
            parts += [f"## {field.name}", f"`{field.name}`: {_say_type(section)}; default `{field.default}`."]
            continue
        said = _read_attributes(inner[0])
        about = inspect.cleandoc(inner[0].__doc__ or "").split("\n\nAttributes:")[0].replace("``", "`")
        rows = [
            (f"`{key.name}`", said.get(key.name, ""), escape(_say_type(key.type)), _say_default(key.default))
            for key in msgspec.structs.fields(inner[0])
        ]
        parts += [f"## {field.name}", about, table(("key", "what", "value", "default"), rows)]
    return "\n\n".join(parts) + "\n"


def _is_struct(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _read_attributes(struct: type[Any]) -> dict[str, str]:
    _, _, text = inspect.cleandoc(struct.__doc__ or "").partition("Attributes:\n")
    found = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", text, re.MULTILINE)
    return {name: escape(" ".join(about.split())).replace("``", "`") for name, about in found}


def _say_type(kind: Any) -> str:  # noqa: ANN401 - any annotation
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        meta = inner[1]
        ends = [
            f"{word} {end:g}"
            for word, end in (("above", meta.gt), ("at least", meta.ge), ("at most", meta.le))
            if end is not None
        ]
        return " ".join([_say_type(inner[0]), *ends])
    if origin is typing.Literal:
        return ", ".join(map(repr, inner)).replace("'", '"')
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_say_type(each) for each in inner if each is not type(None))
    if origin is list:
        return f"list of {_say_type(inner[0])}"
    words = {float: "number", str: "text", int: "whole number", bool: "true or false"}
    return words.get(kind, getattr(kind, "__name__", str(kind)))


def _say_default(value: object) -> str:
    return "" if value in (None, msgspec.NODEFAULT) else f"`{value}`"


def write_tables() -> str:
    """Every table of the results, column by column."""
    parts = [
        "# Tables, column by column",
        (
            "The contract of the Parquet files of a run, out of `schemas/`. Units and frames stand in the "
            "files' "
            "field metadata as well. `base_link` is the frame of the vehicle: x forward, y left, z up. "
            "Where the files stand and how they are read: [Results and file formats](formats.md)."
        ),
    ]
    for contract in schemas.list_contracts():
        about = inspect.cleandoc(contract.schema.__doc__ or "")
        rows = []
        for name, column in contract.schema.columns().items():
            known = contract.metadata_of(name)
            kind = type(column).__name__ + (" or null" if column.nullable else "")
            rows.append(
                (
                    f"`{name}`",
                    known.get("unit", ""),
                    known.get("frame", ""),
                    kind,
                    escape(known.get("description", "")),
                )
            )
        parts += [
            f"## {contract.name}",
            f"{escape(about)} Version {contract.version} of the contract.",
            table(("column", "unit", "frame", "type", "what"), rows),
        ]
        if contract.facts:
            facts = [(f"`{name}`", escape(what)) for name, what in contract.facts.items()]
            parts += ["In the metadata of the file:", table(("key", "what"), facts)]
    return "\n\n".join(parts) + "\n"


def write_vehicles() -> str:
    """Every preset with its numbers and where they were read."""
    rows = [
        (
            f"`{vehicle.id}`",
            escape(vehicle.name),
            vehicle.kind,
            *(
                _say_number(each)
                for each in (vehicle.wheel_radius_m, vehicle.track_width_m, vehicle.wheelbase_m)
            ),
        )
        for vehicle in list_presets()
    ]
    return (
        "# Vehicles that are known\n\n"
        "`--vehicle ID` names one; mostly the log tells. Numbers of one's own go into `run.toml` and win. "
        "Each is a file in `pipeline/sources/presets` that says where its numbers were read.\n\n"
        + table(("id", "name", "kind", "wheel radius [m]", "track width [m]", "wheelbase [m]"), rows)
        + "\n"
    )


def _say_number(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def write_message_types() -> str:
    """Every message type that can serve, by role."""
    rows = []
    folder = resources.files("pipeline.sources.message_types")
    for file in sorted(folder.iterdir(), key=lambda each: each.name):
        if not file.name.endswith(".toml"):
            continue
        package = file.name.removesuffix(".toml")
        for name, content in sorted(tomllib.loads(file.read_text(encoding="utf-8")).items()):
            if isinstance(content, dict) and name[0].isupper():
                rows.append((f"`{package}/{name}`", *_say_roles(content)))
    rows += [(f"`{name}`", "pose, along a chain of frames", "") for name in TRANSFORM_TYPES]
    rows.sort()
    return (
        "# Message types that are read\n\n"
        "Types that can serve as command, wheels, pose or gyro without any configuration; each package is a "
        "file in `pipeline/sources/message_types`. A number in any other message can be named by its "
        "path, such as "
        '`left_topic = "/drive/status.states[0].rpm"`: see [Configuration](configuration.md).\n\n'
        + table(("type", "serves as", "fields"), rows)
        + "\n"
    )


def _say_roles(content: dict[str, Any]) -> tuple[str, str]:
    words = {
        "joints": "wheels or command, by the names of joints",
        "pose": "pose",
        "imu": "gyro",
        "number": "one side, or one of two numbers",
        "numbers": "sides, if the configuration names its elements",
    }
    roles, fields = [], []
    for key, value in content.items():
        if key == "drive":
            for each in value if isinstance(value, list) else [value]:
                role = {"either": "command or wheels"}.get(each.get("role", "either"), each.get("role", ""))
                roles.append(role)
                fields += [f"`{each['first']}`", f"`{each['second']}`"]
        elif key in words:
            roles.append(words[key])
            named = [value[each] for each in _FIELDS if each in value]
            fields += [f"`{one}`" for each in named for one in ([each] if isinstance(each, str) else each)]
    return ", ".join(dict.fromkeys(roles)), ", ".join(dict.fromkeys(fields))


def write_targets() -> str:
    """Every target of `slip model export`, and where its names were read."""
    rows = [
        (
            f"`{each.name}`",
            escape(each.about),
            ", ".join(f"`{name}`" for name in each.corrects),
            escape(each.source),
        )
        for each in list_targets()
    ]
    return (
        "# Targets of `slip model export`\n\n"
        "What is written, which parameters of the robot's own are read with `--current` and corrected, and "
        "where names and meanings were read. Which effect changes which parameter stands on the "
        "[effect's page](effects/index.md); how to use it: [Give the answer to a controller](exports.md).\n\n"
        + table(("`--to`", "writes", "`--current` corrects", "names read in"), rows)
        + "\n"
    )
