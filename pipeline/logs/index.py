"""Index of a recording's contents, built without decoding messages."""

import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from pipeline.core import (
    LONGEST_NAME,
    PathError,
    format_size,
    name_first,
    resolve_inside,
    shorten,
    usable_threads,
)
from pipeline.logs.catalog import Catalog
from pipeline.logs.compressed import COMPRESSED, uncompressed_name
from pipeline.logs.part import (
    catalog_file,
    count_fetched,
    hash_sources,
    is_finished,
    open_source,
    version_of,
)
from pipeline.logs.records import LATEST_NS, LogError, Loss
from pipeline.logs.remote import to_location

SUFFIXES: Final = (".mcap", *(f".mcap{end}" for end in COMPRESSED), ".db3", ".bag")
"""Suffixes of the files of recordings."""

_MAX_LISTING: Final = 4 << 20
_MOST_TOPICS: Final = 3000
"""Maximum number of channels of a recording that are read: the fullest of real logs have hundreds."""
LISTING: Final = "metadata.yaml"
"""File that rosbag2 writes into its folder at the end of a recording."""


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """One channel of a recording.

    Attributes:
        id: channel number in the recording (over all parts of a split one).
        topic: name of the topic.
        type_name: ``package/msg/Name``; empty if the channel has no schema.
        schema_encoding: ``ros2msg``, ``ros2idl``, ``protobuf``, ...
        message_encoding: ``cdr``, ``json``, ``protobuf``, ``ros1``, ...
        message_count: number of messages in the readable part of the log.
        metadata: metadata written by the recorder.
    """

    id: int
    topic: str
    type_name: str
    schema_encoding: str
    message_encoding: str
    message_count: int
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Part:
    """One file of a recording.

    Attributes:
        path: the file.
        size_bytes: size of the file [bytes].
        catalog: catalog of its contents.
        version: version of an object in an object store, None for a file.
        numbers: channel number in the recording by that in the file, set by `merge_parts`.
    """

    path: Path
    size_bytes: int
    catalog: Catalog
    version: str | None
    numbers: dict[int, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LogIndex:
    """Index of a recording's contents.

    Attributes:
        path: file or folder.
        size_bytes: total size of its files [bytes].
        profile: profile stated by the recorder, such as ``ros2`` or ``ros1``.
        library: library that wrote it.
        compressions: compressions of its chunks, sorted; ``""`` is none.
        chunk_count: number of chunks of all parts.
        start_ns: first log time [ns], 0 if empty.
        end_ns: last log time [ns], 0 if empty.
        channels: channels of all parts, by number.
        metadata: metadata records by name; the last of several with one name.
        attachments: names of the attachments.
        losses: losses detected without reading the messages.
        notes: remarks that are not losses.
        parts: the files.
        fetched_bytes: number of bytes fetched from an object store to build the index.
    """

    path: Path
    size_bytes: int
    profile: str
    library: str
    compressions: tuple[str, ...]
    chunk_count: int
    start_ns: int
    end_ns: int
    channels: tuple[ChannelInfo, ...]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: tuple[str, ...]
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]
    parts: tuple[Part, ...] = field(repr=False)
    fetched_bytes: int = 0

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def types(self) -> dict[str, str]:
        """Message type by topic; of several types the one with most messages."""
        return find_types(self.channels)

    @property
    def containers(self) -> frozenset[str]:
        """Kinds of its files: empty for MCAP, else the name of the kind."""
        return frozenset(part.catalog.container for part in self.parts)

    @property
    def complete(self) -> bool:
        """Whether no losses are known."""
        return not self.losses

    @property
    def deployment(self) -> dict[str, str]:
        """Metadata record ``deployment`` (vehicle, terrain), with its values shortened."""
        return {key: shorten(text, LONGEST_NAME) for key, text in self.metadata.get("deployment", {}).items()}

    @property
    def is_simulated(self) -> bool:
        """Whether the log says that it is no recording: by a record ``simulation``, or as its terrain."""
        return "simulation" in self.metadata or self.deployment.get("terrain") == "simulated"

    @property
    def message_count(self) -> int:
        """Number of messages of all channels."""
        return sum(channel.message_count for channel in self.channels)

    def topics(self) -> tuple[str, ...]:
        """Names of all topics, sorted."""
        return tuple(sorted({channel.topic for channel in self.channels}))


def find_types(channels: Iterable[ChannelInfo]) -> dict[str, str]:
    """Message type by topic; of several types the one with most messages."""
    fullest: dict[str, ChannelInfo] = {}
    for channel in channels:
        known = fullest.setdefault(channel.topic, channel)
        if (channel.message_count or 0) >= (known.message_count or 0):
            fullest[channel.topic] = channel
    return {topic: channel.type_name for topic, channel in fullest.items()}


def open_log(
    path: str | os.PathLike[str], *, max_inflated: int | None = None, is_one: bool = False
) -> LogIndex:
    """Build the index of a recording.

    Args:
        path: an MCAP file or object (``s3://bucket/key``), a ROS 1 bag, an SQLite file of rosbag2, or
            the folder of a split recording (with or without the ``metadata.yaml`` of rosbag2).
        max_inflated: limit of the inflated size of all chunks of a file [bytes], by default a plausible one
            for its size; chunks beyond it are omitted and reported as a loss.
        is_one: whether the files of a folder are known to be parts of one recording; otherwise its
            ``metadata.yaml`` says so, or they follow one another in time.

    Raises:
        LogError: ``log_not_found``, ``log_empty``, ``not_mcap``, ``not_a_recording``, ``log_unreadable``.
    """
    location = to_location(path)
    files, losses = find_parts(location)
    parts: list[Part] = []
    fetched = 0
    for file in files:
        with open_source(file) as source:
            catalog = catalog_file(source, threads=usable_threads(), max_inflated=max_inflated)
            parts.append(Part(file, source.size, catalog, version_of(source)))
            fetched += count_fetched([source])
    unlisted = len(parts) > 1 and not is_one and not (location / LISTING).is_file()
    if unlisted and files[0].name.endswith(SUFFIXES):
        _require_one_recording(location, parts)
    return merge_parts(location, parts, losses, fetched)


def _require_one_recording(folder: Path, parts: Sequence[Part]) -> None:
    """Refuse files that are named as parts of one recording and do not follow one another in time."""
    times = [(part.path, part.catalog.start_ns, part.catalog.end_ns) for part in parts]
    pair = _find_overlap(times)
    if pair is None:
        return
    first, second = (file.name for file in pair)
    raise LogError(
        "not_a_recording",
        f"the folder holds {len(parts)} recordings, not parts of one: {second} begins before {first} ends",
        where=str(folder),
        hint=f"Give one of its files; `slip batch {folder}` analyzes each as a log of its own",
    )


_OVERLAP_NS: Final = 1_000_000_000, 5_000_000_000
"""Overlap of parts of one recording [ns]: what a recorder holds in its cache when it begins the next file,
as half of a part, within these limits."""

_Times = tuple[Path, int | None, int | None]


def _find_overlap(times: Iterable[_Times]) -> tuple[Path, Path] | None:
    """The first two files, in their order, of which the second begins before the first ends; None without.

    Args:
        times: each file with its first and last log time [ns]; those without are left out.
    """
    known = [(file, start, end) for file, start, end in times if start is not None and end is not None]
    for (first, start, end), (second, begin, last) in itertools.pairwise(known):
        half = min(end - start, last - begin) // 2
        if end - begin > min(max(half, _OVERLAP_NS[0]), _OVERLAP_NS[1]):
            return first, second
    return None


def are_separate(files: Iterable[Path]) -> bool:
    """Whether files, in their order, do not follow one another in time, as parts of a recording do."""
    times: list[_Times] = []
    for file in files:
        with suppress(LogError, OSError):
            # The times of an unfinished file are known only after reading all of it.
            if is_finished(file):
                with open_source(file) as source:
                    catalog = catalog_file(source)
                times.append((file, catalog.start_ns, catalog.end_ns))
    return _find_overlap(times) is not None


def hash_log(path: str | os.PathLike[str]) -> str:
    """SHA-256 (hex) of a recording's bytes; for a split one, of all its parts in order.

    Raises:
        LogError: as ``open_log``.
    """
    files, _ = find_parts(to_location(path))
    with ExitStack() as stack:
        return hash_sources([stack.enter_context(open_source(file)) for file in files])


def find_parts(path: Path) -> tuple[list[Path], list[Loss]]:
    """The files of a recording in order, and losses for missing files.

    Raises:
        LogError: ``not_a_recording``.
    """
    if not path.is_dir():
        return [path], []
    listing = path / "metadata.yaml"
    every = list_files(path)
    if every and not every[0].name.endswith(SUFFIXES):
        return every, []
    here = [file for file in every if file.suffix == every[0].suffix]
    if listing.is_file():
        if listing.stat().st_size > _MAX_LISTING:
            raise LogError(
                "not_a_recording",
                f"metadata.yaml holds {format_size(listing.stat().st_size)}, which no listing of files does",
                where=str(listing),
                hint="Put it back from where it was recorded, or remove it: the files are then found by name",
            )
        listed = [
            name
            for name in _listed_files(listing.read_bytes().decode("utf-8", "replace"))
            if name.endswith(SUFFIXES)
        ]
        named = {
            name: next(filter(None, (_find_listed(path, f"{name}{end}") for end in ("", *COMPRESSED))), None)
            for name in listed
        }
        parts = [file for file in named.values() if file is not None] or here
        missing = [_show(name) for name, file in named.items() if file is None]
        if parts:
            losses = [
                Loss("missing_part", f"{name} of the recording is not in its folder") for name in missing
            ]
            return parts, losses
    stems = {re.sub(r"_\d+$", "", stem_of(file)) for file in here}
    if here and len(stems) == 1:
        return here, []
    what, hint = "the folder holds no recording", "Give one .mcap, .db3 or .bag file, or one rosbag2 folder"
    if here:
        what = "the folder holds several recordings"
        hint = (
            f"{hint}; `slip batch {path}` analyzes all of them, `slip diagnose {path}` judges them together"
        )
    elif any(path.glob("*.zstd")):
        what, hint = ("the recording's files are compressed as a whole", "Unpack them: zstd -d --rm *.zstd")
    raise LogError("not_a_recording", what, where=str(path), hint=hint)


def list_files(folder: Path) -> list[Path]:
    """The files of recordings in a folder, MCAP first, by name and number.

    Whoever lists a folder opens what it holds: pipes, sockets, devices and dead links are no files.
    """
    named = (file for end in SUFFIXES for file in sorted(folder.glob(f"*{end}"), key=split_number))
    return [file for file in named if file.is_file()]


def stem_of(file: Path) -> str:
    """Name of a file of a recording without its suffixes."""
    return Path(uncompressed_name(file)).stem


def _find_listed(folder: Path, name: str) -> Path | None:
    """Path of a file in the listing of a recording; None if it is not in the folder."""
    try:
        # Parts of a recording are often links to files in another folder.
        file = resolve_inside(folder, name, follow_links=True)
    except PathError:
        return None
    return file if file.is_file() else None


def _show(name: str) -> str:
    """Format a file name from a listing, which is untrusted, for a message."""
    plain = name.rpartition("/")[2]
    return plain if plain.isprintable() and len(plain) <= LONGEST_NAME else repr(shorten(name, LONGEST_NAME))


def split_number(file: Path) -> tuple[str, int]:
    """Name of a file without its number, and the number; -1 without."""
    stem = stem_of(file)
    match = re.search(r"_(\d+)$", stem)
    return (stem[: match.start()], int(match[1])) if match else (stem, -1)


def _listed_files(text: str) -> list[str]:
    """Entries of ``relative_file_paths`` in a rosbag2 ``metadata.yaml``."""
    entry = r"(?:[ \t\r]*\n)*+[ \t]*-[ \t].*\n?"
    block = re.search(rf"^[ \t]*relative_file_paths:[ \t\r]*\n((?:{entry})*)", text, re.MULTILINE)
    if block is None:
        return []
    entries = [line.strip()[1:].strip() for line in block[1].splitlines() if line.strip()]
    return [entry.strip("\"'") for entry in entries]


def merge_parts(path: Path, parts: Sequence[Part], losses: Sequence[Loss], fetched: int) -> LogIndex:
    """Merge the catalogs of the files of a recording; channels of one topic and type get one number.

    Names have at most `LONGEST_NAME` characters here, and of very many channels the first ones are taken:
    whatever is said of a log stays readable.
    """
    channels: dict[tuple[object, ...], ChannelInfo] = {}
    omitted: list[str] = []
    alone = len(parts) == 1
    catalogs = [part.catalog for part in parts]
    for part in parts:
        for number, channel in sorted(part.catalog.channels.items()):
            schema = part.catalog.schemas.get(channel.schema_id)
            described = (schema.name, schema.data) if schema else ()
            key = (number,) if alone else (channel.topic, channel.message_encoding, *described)
            known = channels.get(key)
            if known is None and len(channels) == _MOST_TOPICS:
                omitted.append(channel.topic)
                continue
            if known is None:
                known = ChannelInfo(
                    number if alone else len(channels) + 1,
                    shorten(channel.topic, LONGEST_NAME),
                    shorten(schema.name, LONGEST_NAME) if schema else "",
                    shorten(schema.encoding, LONGEST_NAME) if schema else "",
                    shorten(channel.message_encoding, LONGEST_NAME),
                    0,
                    dict(channel.metadata),
                )
            count = known.message_count + part.catalog.counts.get(number, 0)
            channels[key] = replace(known, message_count=count)
            part.numbers[number] = known.id
    if omitted:
        text = (
            f"the log has {len(channels) + len(omitted):,} topics: the first {len(channels):,} are read, "
            f"and not {name_first(omitted)}"
        )
        losses = [*losses, Loss("too_large", text)]
    end_ns = max((each.end_ns for each in catalogs if each.end_ns is not None), default=0)
    unset = ("the recorder's clock is not set: it shows times after the year 2116",)
    return LogIndex(
        path=path,
        size_bytes=sum(part.size_bytes for part in parts),
        profile=shorten(catalogs[0].profile, LONGEST_NAME),
        library=shorten(catalogs[0].library, LONGEST_NAME),
        compressions=tuple(
            sorted({shorten(name, LONGEST_NAME) for one in catalogs for name in one.compressions})
        ),
        chunk_count=sum(catalog.count_chunks() for catalog in catalogs),
        start_ns=min((each.start_ns for each in catalogs if each.start_ns is not None), default=0),
        end_ns=end_ns,
        channels=tuple(channels.values()),
        metadata=dict(record for catalog in catalogs for record in catalog.metadata),
        attachments=tuple(name for catalog in catalogs for name in catalog.attachments),
        losses=(*losses, *(loss for catalog in catalogs for loss in catalog.losses)),
        notes=(*(note for catalog in catalogs for note in catalog.notes), *unset * (end_ns >= LATEST_NS)),
        parts=tuple(parts),
        fetched_bytes=fetched,
    )


def take_start(index: LogIndex, chunks: int) -> LogIndex:
    """Index of the first chunks of each file alone, for what every message of a topic repeats."""
    starts = (replace(part.catalog, spans=part.catalog.spans[:chunks]) for part in index.parts)
    parts = tuple(replace(part, catalog=start) for part, start in zip(index.parts, starts, strict=True))
    return replace(index, parts=parts)
