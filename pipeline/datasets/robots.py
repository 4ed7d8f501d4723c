"""Notes on runs that count as those of one vehicle, though their logs name several robots."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from glob import escape
from os.path import commonprefix

from pipeline.core import enumerate_texts, format_count, group_by, name_first
from pipeline.datasets.corrections import read_topic
from pipeline.sources import FLEET_FILE, find_preset, find_robots
from pipeline.store import Manifest, recorded_path

_NAME = re.compile(r"[\w.-]*/[\w./-]+")
"""Topic or frame in the text of a source, as in ``/tf (map -> robot1/base_link)``."""
_ROBOTS = ("robot", "rover", "ugv", "unit", "vehicle")
"""Words for a robot in names of folders, beside those for its type."""
_NUMBER = r"[ _-]*(?!(?:19|20)\d\d$)\d+"
"""Number of a robot behind its word; that of a year is none."""


def note_robots(manifests: Iterable[Manifest]) -> list[str]:
    """Notes on runs of several robots of one type, which tables over runs take for one vehicle.

    Robots are told apart by the namespaces of their topics and frames, as in one log that holds several
    (`find_robots`), or else by folders that have a word for the vehicle and a number as their name. Runs
    whose robot was given a name of its own (``vehicle.name`` without a geometry) count as that name says.

    Args:
        manifests: runs; a summary that is damaged or missing says nothing.
    """
    unnamed = [one for one in manifests if not _has_own_name(one)]
    notes = list[str]()
    for vehicle, own in group_by((str(one.part("vehicle").get("id")), one) for one in unnamed).items():
        for what, named in (("topics", _find_namespaces(own)), ("folders", _find_folders(own))):
            robots = group_by(sorted((name, run) for run, name in named.items()))
            if len(robots) > 1:
                notes.append(_format(vehicle, what, robots, {one.run: recorded_path(one) for one in own}))
                break
    return notes


def _has_own_name(manifest: Manifest) -> bool:
    given = manifest.part("configuration", "vehicle")
    return bool(given.get("name")) and not given.get("kind")


def _find_namespaces(manifests: Sequence[Manifest]) -> dict[str, str]:
    """Namespace of the robot of each run, without the slashes around it; none where several fit."""
    names: dict[str, set[str]] = {}
    drives = set[str]()
    for manifest in manifests:
        driven, located = (
            [name for role in roles for name in _NAME.findall(read_topic(manifest, role))]
            for roles in (("command", "wheels"), ("pose",))
        )
        # The frame of a base tells a robot as the topic of its drive does.
        frames = [f"/{name}" for name in located if not name.startswith("/")]
        drives |= {*driven, *frames}
        names[manifest.run] = {*driven, *located, *frames}
    robots = find_robots(drives, set().union(*names.values()))
    fitting = {
        run: [one for one in robots if any(name.startswith(one) for name in own)]
        for run, own in names.items()
    }
    return {run: spaces[0].strip("/") for run, spaces in fitting.items() if len(spaces) == 1}


def _find_folders(manifests: Sequence[Manifest]) -> dict[str, str]:
    """The innermost folder of each log that is named as a robot of its type."""
    folders = dict[str, str]()
    for manifest in manifests:
        vehicle = str(manifest.part("vehicle").get("id"))
        preset = find_preset(vehicle)
        words = [*_ROBOTS, vehicle, *(preset.aliases if preset is not None else ())]
        robot = re.compile(f"(?:{'|'.join(map(re.escape, words))}){_NUMBER}", re.IGNORECASE)
        for part in recorded_path(manifest).split("/")[:-1]:
            if robot.fullmatch(part):
                folders[manifest.run] = part
    return folders


def _format(vehicle: str, what: str, robots: Mapping[str, Sequence[str]], logs: Mapping[str, str]) -> str:
    """The note on the runs of each robot, with the lines that make them vehicles of their own."""
    top = commonprefix(list(logs.values())).rpartition("/")[0]  # noqa: RUF071 - cut at a slash
    below = {run: log[len(top) + 1 :] for run, log in logs.items()}
    said = [f"{name} in {name_first(runs)}" for name, runs in robots.items()]
    lines = []
    for name, runs in robots.items():
        glob, *others = _list_globs([below[run] for run in runs], below.values())
        line = f'[[match]] glob = {json.dumps(glob)}, vehicle.name = "{name.replace("/", "_")}"'
        lines.append(line + f" (and one for each of {format_count(len(others), 'more log')})" * bool(others))
    return (
        f"runs of {vehicle} count as those of one robot, and their {what} name {len(robots)}: "
        f"{'; '.join(said)}. In {top}/{FLEET_FILE} these lines tell them apart: {enumerate_texts(lines)}; "
        "if they are one robot, write the same name in each"
    )


def _list_globs(own: Sequence[str], every: Iterable[str]) -> list[str]:
    """Globs that match these logs and no others: by a folder, by how they begin, or else one of each."""
    start = commonprefix(own)  # noqa: RUF071 - of names, too
    others = [log for log in every if log not in own]
    folders = [start[: at + 1] for at, mark in enumerate(start) if mark == "/"]
    for glob in (*folders, start):
        if glob and not any(log.startswith(glob) for log in others):
            return [f"{escape(glob)}*" if glob not in own else escape(glob)]
    return [escape(log) for log in own]
