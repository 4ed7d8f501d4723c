"""One log, its configuration, its vehicle and its name among the runs."""

import os
from dataclasses import dataclass
from pathlib import Path

from pipeline.analysis.choice import Choice, choose
from pipeline.analysis.errors import JobError
from pipeline.analysis.options import Options
from pipeline.logs import LogIndex, open_log, spell_location
from pipeline.stages.errors import blame_damage
from pipeline.store import Store
from pipeline.vehicles import Configuration, Sources, Vehicle, load_configuration

UNKNOWN = "unknown"


@dataclass(frozen=True)
class LogSetup:
    """Everything known about a log before its messages are read."""

    path: Path
    index: LogIndex
    configuration: Configuration
    vehicle: Vehicle
    terrain: str
    dataset: str
    sources: Sources
    choice: Choice


def set_up_log(path: Path, options: Options) -> LogSetup:
    """Open a log and settle configuration, vehicle and topics.

    Args:
        path: the recording.
        options: what the user asked for.

    Raises:
        LogError: the log cannot be read.
        ConfigurationError: the configuration is wrong or the vehicle unknown.
        JobError: the log has no pose, or neither command nor measured wheels.
    """
    index = open_log(path, max_inflated=options.max_inflated)
    path = index.path
    configuration = load_configuration(
        path, given=options.config, fleet=options.fleet, overrides=options.overrides
    )
    recorded = index.deployment
    if not index.channels:
        what = "no message of the log can be read" if index.losses else "the log holds no message"
        hint = "Check that the recording was not cut off before its first message."
        what += blame_damage(index.losses)
        raise JobError("log_without_messages", what, where=str(path), hint=hint)
    chosen = choose(index, configuration, options.overrides)
    _require_sources(chosen.sources, index, options)
    vehicle = chosen.vehicle
    terrain = configuration.run.terrain or recorded.get("terrain") or UNKNOWN
    dataset = configuration.run.dataset or f"{vehicle.id}_{terrain}"
    return LogSetup(path, index, configuration, vehicle, terrain, dataset, chosen.sources, chosen)


def _require_sources(sources: Sources, index: LogIndex, options: Options) -> None:
    topics = {channel.topic: f"{channel.topic} ({channel.type_name})" for channel in index.channels}
    empty = {channel.topic for channel in index.channels if channel.message_count == 0}
    there = ", ".join(text for topic, text in sorted(topics.items()) if topic not in empty)
    there += f". Without any message: {', '.join(sorted(empty))}" if empty else ""
    if sources.pose is None:
        what = "no topic can serve as pose (an odometry, a pose, or transforms)" + blame_damage(index.losses)
        hint = f"Name it in run.toml ([pose] topic = ...). The log has: {there}."
        raise JobError("no_pose", what, where=str(index.path), hint=hint)
    wanted = {"command": sources.command, "measured": sources.wheels}
    if all(wanted[name] is None for name in options.inputs):
        roles = " or ".join("command" if name == "command" else "measured wheels" for name in options.inputs)
        what = f"no topic can serve as {roles}{blame_damage(index.losses)}"
        where_to = "Name it in run.toml ([command] topic = ..., or left_topic and right_topic)."
        raise JobError("no_command", what, where=str(index.path), hint=f"{where_to} The log has: {there}.")


def name_plainly(path: Path) -> str:
    r"""Name of the run of a log where no other run has it: folder/stem.

    Bytes of a file name that are no UTF-8 are spelt ``\xe9`` in it.
    """
    name = f"{path.parent.name}/{path.stem}" if path.parent.name else path.stem
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def name_run(path: Path, sha256: str, store: Store) -> str:
    """Name of the run of a log: folder/stem, with eight digits of its hash where another run has that name.

    Equal content counts once: a copy of a log that has results already gets their name.
    """
    absolute = path.resolve()
    plain = name_plainly(absolute)
    manifest = store.manifest(plain)
    if manifest is None:
        for known in store.survey().manifests:
            if known.part("log").get("sha256") == sha256:
                return known.run
        return plain
    before = manifest.part("log")
    if before.get("sha256") == sha256 or before.get("path") == spell_location(absolute):
        return plain
    return f"{plain}-{sha256[:8]}"
