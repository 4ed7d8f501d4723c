"""Configuration of one log from its layers: presets, fleet files, `run.toml`, and the command line."""

import fnmatch
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from pipeline.core import (
    TomlError,
    name_first,
    objects_in,
    parse_toml,
    read_bounded_text,
    require_finite,
    shorten,
)
from pipeline.logs import RemotePath, stem_of
from pipeline.sources.configuration import (
    Configuration,
    ConfigurationError,
    explain_range,
    find_preset,
    list_bounds,
    suggest_presets,
)

_PLACE = re.compile(r"at `\$\.?([^`]*)`")
_UNKNOWN = re.compile(r"unknown field `([^`]*)`")
_MISMATCH = re.compile(r"Expected `([^`]*)`, got `([^`]*)`")
_VALUE = re.compile(r"value '([^']*)'")
_STEP = re.compile(r"[A-Za-z_]\w*|\[")

Tree = Mapping[str, object]
Section = TypeVar("Section", bound=msgspec.Struct)


class Fault(NamedTuple):
    """A key or a value of a table that its schema refuses.

    Attributes:
        what: what is wrong, one line without a full stop.
        hint: what to do about it; empty if that is not known.
        steps: names of the keys that lead to it.
        value: the refused word; empty if it is a number.
    """

    what: str
    hint: str
    steps: list[str]
    value: str = ""


def convert_to(kind: type[Section], tree: Tree) -> Section | Fault:
    """Validate a table that a user wrote: unknown keys, words, types and the range of every number.

    Args:
        kind: the class of its content.
        tree: the table.

    Returns:
        The content, or what is wrong with it.
    """
    outside = next(_list_outside(msgspec.inspect.type_info(kind), tree, ""), None)
    if outside is not None:
        what, hint = explain_range(*outside)
        return Fault(what, hint, [step for step in outside[0].split(".") if not step.startswith("[")])
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        message = str(error)
    key_path, unknown, value = (_find(pattern, message) for pattern in (_PLACE, _UNKNOWN, _VALUE))
    steps = _STEP.findall(key_path)
    if unknown:
        keys = ", ".join(sorted(_list_keys(kind, steps)))
        hint = f"The keys there are: {keys}." if keys else ""
        steps.append(unknown)
    else:
        words = ", ".join(str(word) for word in _list_words(kind, steps))
        hint = f"Write one of: {words}." if words else ""
        wanted, got = mismatch.groups() if (mismatch := _MISMATCH.search(message)) else ("", "")
        if wanted.startswith("object") and steps:
            hint = f"Write it as a section, [{'.'.join(steps)}], with its keys below."
        elif (wanted, got) == ("array", "object") and steps:
            hint = f"Write [[{'.'.join(steps)}]], with two brackets: there may be several."
        elif got == "str" and wanted.startswith(("float", "int")):
            hint = "Write the number without quotes."
    return Fault(shorten(_readable(message)), hint, [step for step in steps if step != "["], value)


def _list_outside(
    kind: msgspec.inspect.Type, value: object, key: str
) -> Iterator[tuple[str, float, tuple[float, float]]]:
    """Numbers of a table outside the range of their type: dotted key, number, range."""
    for one in _spread([kind]):
        if isinstance(value, int | float) and not isinstance(value, bool):
            bounds = list_bounds(one)
            if bounds is not None and not bounds[0] <= value <= bounds[1]:
                yield key, value, bounds
        elif isinstance(value, Mapping):
            inner = dict.fromkeys(value, one.value_type) if isinstance(one, msgspec.inspect.DictType) else {}
            if isinstance(one, msgspec.inspect.StructType):
                inner = {field.encode_name: field.type for field in one.fields}
            for name in inner.keys() & value.keys():
                yield from _list_outside(inner[name], value[name], f"{key}.{name}" if key else str(name))
        elif isinstance(value, list) and isinstance(one, msgspec.inspect.ListType):
            for number, item in enumerate(value, start=1):
                yield from _list_outside(one.item_type, item, f"{key}.[{number}]")


def check_preset(tree: Mapping[str, object], source: Path) -> None:
    """Reject an unknown preset where it is named, not where a log needs it.

    Raises:
        ConfigurationError: ``vehicle_unknown``.
    """
    vehicle = tree.get("vehicle")
    name = vehicle.get("preset") if isinstance(vehicle, dict) else None
    if isinstance(name, str) and find_preset(name) is None:
        raise ConfigurationError(
            "vehicle_unknown",
            f"no vehicle preset is called {name!r}",
            where=_name_line(str(source), source, ["vehicle", "preset"], name),
            hint=suggest_presets(name),
        )


def _find(pattern: re.Pattern[str], message: str) -> str:
    match = pattern.search(message)
    return match[1] if match else ""


_KINDS = {
    "object": "a section", "array": "a list", "str": "a text", "float": "a number", "int": "a whole number",
    "bool": "true or false",
}  # fmt: skip
"""What a value is, for people."""


def _describe_kinds(mismatch: re.Match[str]) -> str:
    wanted = [_KINDS.get(one, one) for one in mismatch[1].split(" | ") if one != "null"]
    return f"{' or '.join(wanted)} belongs there, not {_KINDS.get(mismatch[2], mismatch[2])},"


def _readable(message: str) -> str:
    return (
        _MISMATCH.sub(_describe_kinds, message)
        .replace("Object contains unknown field", "unknown key")
        .replace(" - at `$.", " in `")
        .replace("`$`", "the top level")
    )


def _walk(kind: type[msgspec.Struct], steps: Iterable[str]) -> Iterator[msgspec.inspect.Type]:
    """Possible types at a path in a section."""
    kinds: list[msgspec.inspect.Type] = [msgspec.inspect.type_info(kind)]
    for step in steps:
        inner: list[msgspec.inspect.Type] = []
        for one in _spread(kinds):
            if step == "[" and isinstance(one, msgspec.inspect.ListType | msgspec.inspect.VarTupleType):
                inner.append(one.item_type)
            elif step == "[" and isinstance(one, msgspec.inspect.DictType):
                inner.append(one.value_type)
            elif isinstance(one, msgspec.inspect.StructType):
                inner += [field.type for field in one.fields if field.encode_name == step]
        kinds = inner
    return _spread(kinds)


def _spread(kinds: Iterable[msgspec.inspect.Type]) -> Iterator[msgspec.inspect.Type]:
    for kind in kinds:
        if isinstance(kind, msgspec.inspect.UnionType):
            yield from _spread(kind.types)
        else:
            yield kind


def _list_words(kind: type[msgspec.Struct], steps: Iterable[str]) -> list[object]:
    literals = (one for one in _walk(kind, steps) if isinstance(one, msgspec.inspect.LiteralType))
    return [word for one in literals for word in one.values]


def _list_keys(kind: type[msgspec.Struct], steps: Iterable[str]) -> list[str]:
    structs = (one for one in _walk(kind, steps) if isinstance(one, msgspec.inspect.StructType))
    return [field.encode_name for one in structs for field in one.fields]


def name_key(source: Path, key: str) -> str:
    """The file and, if it can be located, the line that sets a dotted key."""
    return _name_line(str(source), source, key.split("."), "")


def _name_line(where: str, source: Path | None, steps: list[str], value: str) -> str:
    number = None if source is None else _find_line(source, steps, value)
    return where if number is None else f"{where}, line {number}"


def _find_line(source: Path, names: list[str], value: str) -> int | None:
    """Number of the line that sets a key, or opens its section; None if it cannot be located."""
    try:
        lines = read_bounded_text(source).splitlines()
    except (OSError, UnicodeDecodeError):
        return None
    if not names:
        return None
    above = names[:-1]
    key = re.compile(rf"\s*\"?{re.escape(names[-1])}\"?\s*=")
    section: list[str] = []
    for number, line in enumerate(lines, start=1):
        opened = _read_header(line)
        if opened:
            section = opened.split(".")
            if section[-len(names) :] == names and not value:
                return number
        elif key.match(line) and section[len(section) - len(above) :] == above and value in line:
            return number
    return None


def _read_header(line: str) -> str:
    """Name of the section that a line opens; empty if it opens none."""
    text = line.strip()
    name, closed, _ = text.lstrip("[").partition("]")
    return name.strip() if text.startswith("[") and closed else ""


FLEET_FILE = "fleet.toml"
RUN_FILE = "run.toml"
_BEGINNING = 10_000
_MODEL = re.compile(rb"(?:\s|#[^\n]*\n)*format\s*=")
_PLAN = re.compile(rb'(?:\s|#[^\n]*\n)*vehicle = "[^\n]*\nruns = ')


def load_configuration(
    log: Path,
    *,
    given: Path | None = None,
    fleet: Path | None = None,
    listed: Path | None = None,
    overrides: Tree | None = None,
) -> Configuration:
    """The configuration of one log.

    Every `fleet.toml` from the root of the file system down to the log's folder is read, nearer ones with
    priority, with those above the links that lead to it, then the given fleet file; then `run.toml` and
    `<log's stem>.toml` beside the log and `run.toml` in a log that is a folder, or the file given instead;
    then overrides. A model file or a plan of that name is skipped.

    Args:
        log: the recording.
        given: a configuration file that replaces the one beside the log.
        fleet: a fleet file that need not be above the log; its globs are matched against every end of the
            log's path that begins with a whole folder.
        listed: path of the log by the links that lead to it; None for the path that is given.
        overrides: values from the command line, nested like the file.

    Raises:
        ConfigurationError: a file is missing, not TOML, or has an unknown key or a wrong value.
    """
    layers: list[Tree] = []
    for path in list_configuration_files(log, given=given, fleet=fleet, listed=listed):
        if path == fleet or (path.name == FLEET_FILE and path != given):
            layers += _match_fleet(path, (_follow(log), _keep_links(listed or log)))
        else:
            layers.append(_checked(read_toml(path), path))
    if overrides:
        layers.append(overrides)
    return convert(merge(_forget_other_vehicles(layers)), "the command line")


def list_configuration_files(
    log: Path, *, given: Path | None = None, fleet: Path | None = None, listed: Path | None = None
) -> tuple[Path, ...]:
    """Files that configure a log, later ones with priority; arguments as of `load_configuration`.

    A fleet file above the log counts only if the user, root or the owner of the log's folder owns it: anybody
    may create one in a folder like `/tmp`.
    """
    path = _follow(log)
    beside = [path.parent / RUN_FILE, path.parent / f"{stem_of(log)}.toml"]
    folder = path if path.is_dir() else path.parent
    if folder == path:
        beside.append(folder / RUN_FILE)
    shown = _keep_links(listed or log)
    above = [*reversed(path.parents), *reversed(shown.parents), *([path] if folder == path else [])]
    fleets = [
        _follow(parent / FLEET_FILE)
        for parent in dict.fromkeys(above)
        if _may_speak(parent / FLEET_FILE, folder)
    ]
    # Of a file that is above both, its nearer place counts.
    fleets = list(dict.fromkeys(reversed(fleets)))[::-1]
    files = [file for file in fleets if fleet is None or file != _follow(fleet)]
    files += [] if fleet is None else [fleet]
    own = [file for file in beside if file.is_file() and not (is_model(file) or is_model(file, _PLAN))]
    return (*files, *(own if given is None else [given]))


def explain_unread(log: Path) -> str:
    """Which files beside a log, or in it, look like its configuration and are not read, and what to do.

    They hold sections of `run.toml`, or its name in other letters, and have the name of no other log there.

    Returns:
        One clause; empty where there are none.
    """
    path = _follow(log)
    if isinstance(path, RemotePath):
        return ""
    read = list_configuration_files(log)
    unread = []
    for folder in (path.parent, *([path] if path.is_dir() else [])):
        files = sorted(folder.iterdir()) if os.access(folder, os.R_OK) else []
        others = {
            stem_of(one) for one in files if folder != path and one.suffix.lower() != ".toml" and one != path
        }
        for file in files:
            is_own = file.suffix.lower() == ".toml" and file.stem not in others and file.is_file()
            if is_own and not any(file.samefile(one) for one in read) and _is_configuration(file):
                unread.append(file.name)
    if not unread:
        return ""
    names = dict.fromkeys((RUN_FILE, RUN_FILE if path.is_dir() else f"{stem_of(log)}.toml"))
    name = " or ".join(names)
    verb, it = ("is", "it") if len(unread) == 1 else ("are", "one of them")
    return f"{name_first(unread)} beside the log {verb} not read: name {it} {name}, or give it with --config"


def _is_configuration(file: Path) -> bool:
    """Whether a file has the name of those that are read in other letters, or has their sections."""
    if file.name.lower() == RUN_FILE:
        return True
    if file.name == FLEET_FILE or is_model(file) or is_model(file, _PLAN):
        return False
    try:
        sections = read_toml(file).items()
    except ConfigurationError:
        return False
    return any(key in Configuration.__struct_fields__ and isinstance(one, dict) for key, one in sections)


def _follow(log: Path) -> Path:
    """The path of a log, links resolved; a link to itself, which may be ignored, stays as it is."""
    try:
        return log.resolve()
    except RuntimeError:
        return log


def _keep_links(log: Path) -> Path:
    """The absolute path of a log, by the links that lead to it."""
    return log if isinstance(log, RemotePath) else Path(os.path.abspath(log))  # noqa: PTH100 - keeps links


def is_model(file: Path, beginning: re.Pattern[bytes] = _MODEL) -> bool:
    """Whether a file begins as model files do: beside a log and with its name, it configures nothing."""
    try:
        with file.open("rb") as opened:
            return beginning.match(opened.read(_BEGINNING)) is not None
    except OSError:
        return False


def _may_speak(file: Path, folder: Path) -> bool:
    """Whether a fleet file exists and its owner is trusted for the logs in a folder."""
    if not file.is_file():
        return False
    owners = {0, getattr(os, "getuid", int)(), folder.stat().st_uid if folder.is_dir() else 0}
    return file.stat().st_uid in owners


def _forget_other_vehicles(layers: list[Tree]) -> list[Tree]:
    """Drop the vehicle values of lower layers if a higher layer names another preset.

    A track width given beside `preset = "husky_a200"` must not apply to a Warthog.
    """
    others: list[Tree] = []
    named: object = None
    for layer in layers:
        vehicle = layer.get("vehicle")
        preset = vehicle.get("preset") if isinstance(vehicle, Mapping) else None
        known = find_preset(preset) if isinstance(preset, str) else None
        preset = preset if known is None else known.id
        if preset is not None and named is not None and preset != named:
            others = [{key: value for key, value in below.items() if key != "vehicle"} for below in others]
        named = preset or named
        others.append(layer)
    return others


def merge(layers: Iterable[Tree]) -> dict[str, object]:
    """Merge nested tables; later layers win, lists are replaced whole."""
    merged: dict[str, object] = {}
    for layer in layers:
        for key, value in layer.items():
            below = merged.get(key)
            if isinstance(value, Mapping) and isinstance(below, Mapping):
                merged[key] = merge([below, value])
            else:
                merged[key] = value
    return merged


def convert(tree: Tree, where: str, *, source: Path | None = None) -> Configuration:
    """Validate a merged table and convert it to a `Configuration`.

    Args:
        tree: the table.
        where: source of the table, for the error.
        source: file of the table, to locate the line.

    Raises:
        ConfigurationError: unknown key or wrong value, with its location.
    """
    content = convert_to(Configuration, tree)
    if isinstance(content, Fault):
        what = f"the configuration is not valid: {content.what}"
        where = _name_line(where, source, content.steps, content.value)
        hint = content.hint or "The handbook, Configuration, lists keys and units."
        raise ConfigurationError("config_invalid", what, where=where, hint=hint)
    return content


def read_toml(path: Path) -> dict[str, object]:
    """Parse a TOML file.

    Raises:
        ConfigurationError: the file is missing, unreadable or not TOML (with the line).
    """
    try:
        tree = parse_toml(read_bounded_text(path))
        require_finite(tree)
    except FileNotFoundError:
        raise ConfigurationError(
            "config_not_found", "there is no such configuration file", where=str(path), hint="Check the path."
        ) from None
    except TomlError as error:
        where = str(path) if error.line is None else f"{path}, line {error.line}"
        if error.key:
            where = name_key(path, error.key)
        raise ConfigurationError(
            "config_not_toml", error.what, where=where, hint="Correct that line."
        ) from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(
            "config_not_toml", f"not a valid TOML file: {error}", where=str(path), hint="Correct that line."
        ) from None
    except OSError as error:
        what, hint = f"cannot be read: {error.strerror}", "Check its permissions."
        raise ConfigurationError("config_unreadable", what, where=str(path), hint=hint) from None
    return tree


def _checked(tree: dict[str, object], path: Path) -> dict[str, object]:
    """Validate one file alone first, so that an error names the right file."""
    convert(tree, str(path), source=path)
    check_preset(tree, path)
    return tree


def _match_fleet(path: Path, log: tuple[Path, Path]) -> list[Tree]:
    """Layers of a fleet file for one log, by both of its paths: its plain keys, then every match in order."""
    tree = read_toml(path)
    tree.pop("ignore", None)
    matches = tree.pop("match", [])
    layers: list[Tree] = [_checked(tree, path)]
    names = [name for one in log for name in _names_under(path.resolve().parent, one)]
    if not isinstance(matches, list):
        raise _bad_match(path, 1)
    for number, match in enumerate(matches, start=1):
        if not isinstance(match, dict) or not isinstance(match.get("glob"), str):
            raise _bad_match(path, number)
        values = {key: value for key, value in match.items() if key != "glob"}
        _checked(values, path)
        if any(fnmatch.fnmatchcase(name, match["glob"]) for name in names):
            layers.append(values)
    return layers


def match_globs(log: Path, fleet: Path | None = None) -> dict[tuple[Path, str, str], bool]:
    """Globs of the fleet files of a log, and whether they match it.

    Args:
        log: the recording, by the links that lead to it.
        fleet: a fleet file that need not be above the log.

    Returns:
        By the file, ``ignore`` (a batch does not open the log) or ``match``, and the glob.

    Raises:
        ConfigurationError: ``config_invalid``, `ignore` must be a list of globs.
    """
    matches: dict[tuple[Path, str, str], bool] = {}
    paths = (_follow(log), _keep_links(log))
    for path in list_configuration_files(log, fleet=fleet):
        if path != fleet and path.name != FLEET_FILE:
            continue
        tree = read_toml(path)
        ignored = tree.get("ignore", [])
        if not isinstance(ignored, list) or not all(isinstance(one, str) for one in ignored):
            hint = 'Write: ignore = ["2026/dead.mcap", "*/tests/*"], above the first [table].'
            raise ConfigurationError(
                "config_invalid", "`ignore` must be a list of globs", where=str(path), hint=hint
            )
        # What is wrong with a match is told when it is applied.
        matched = [one.get("glob") for one in objects_in(tree, "match")]
        rules = [*(("ignore", glob) for glob in ignored), *(("match", glob) for glob in matched)]
        names = [name for one in paths for name in _names_under(path.resolve().parent, one)]
        matches |= {
            (path, kind, glob): any(fnmatch.fnmatchcase(name, glob) for name in names)
            for kind, glob in rules
            if isinstance(glob, str)
        }
    return matches


def _names_under(folder: Path, log: Path) -> list[str]:
    """Texts for a glob: the log's path below the fleet file, or its name; else any end of its path."""
    if log.is_relative_to(folder):
        return [log.relative_to(folder).as_posix(), log.name]
    parts = log.parts[1:]
    return ["/".join(parts[start:]) for start in range(len(parts))]


def _bad_match(path: Path, number: int) -> ConfigurationError:
    hint = 'Write: [[match]] glob = "2026/*/warthog*" and the keys it sets.'
    return ConfigurationError(
        "config_invalid", f"[[match]] number {number} has no `glob`", where=str(path), hint=hint
    )
