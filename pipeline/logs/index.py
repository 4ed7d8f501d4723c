"""Index of a recording's contents, built without decoding messages, and coverage by its checksums."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pipeline.core.untrusted import PathError, resolve_inside
from pipeline.logs.catalog import Catalog
from pipeline.logs.part import catalog_file
from pipeline.logs.records import LogError, Loss
from pipeline.logs.remote import to_location
from pipeline.logs.source import (
    ByteSource,
    count_fetched,
    hash_sources,
    is_fetched,
    open_source,
    usable_threads,
    version_of,
)
from pipeline.logs.spans import checksum_holds
from pipeline.logs.text_folders import list_tables

if TYPE_CHECKING:
    import os
    from concurrent.futures import Executor, Future

SUFFIXES: Final = (".mcap", ".db3", ".bag")
"""Suffixes of the files of recordings."""

_LONGEST_SHOWN: Final = 100
_MAX_LISTING: Final = 4 << 20
LONGEST_NAME: Final = 200
"""Maximum length of a name from a log in tables and sentences [characters]."""
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
        """Message type by topic."""
        return {channel.topic: channel.type_name for channel in self.channels}

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
        return {key: shorten(text) for key, text in self.metadata.get("deployment", {}).items()}

    @property
    def message_count(self) -> int:
        """Number of messages of all channels."""
        return sum(channel.message_count for channel in self.channels)

    def topics(self) -> tuple[str, ...]:
        """Names of all topics, sorted."""
        return tuple(sorted({channel.topic for channel in self.channels}))


def shorten(name: str) -> str:
    """Shorten a name from a log for use in tables; a cut name states its full length."""
    if len(name) <= LONGEST_NAME:
        return name
    return f"{name[:LONGEST_NAME]} (cut, of {len(name)} characters)"


def open_log(path: str | os.PathLike[str], *, max_inflated: int | None = None) -> LogIndex:
    """Build the index of a recording.

    Args:
        path: an MCAP file or object (``s3://bucket/key``), a ROS 1 bag, an SQLite file of rosbag2, the
            folder of a split recording (with or without the ``metadata.yaml`` of rosbag2), or the folder of
            text tables of a known data set.
        max_inflated: limit of the inflated size of all chunks of a file [bytes], by default a plausible one
            for its size; chunks beyond it are omitted and reported as a loss.

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
    return merge_parts(location, parts, losses, fetched)


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
    if every and every[0].suffix not in SUFFIXES:
        return every, []
    here = [file for file in every if file.suffix == every[0].suffix]
    if listing.is_file():
        if listing.stat().st_size > _MAX_LISTING:
            raise LogError(
                "not_a_recording",
                f"metadata.yaml holds {listing.stat().st_size / 1e6:.0f} MB, which no listing of files does",
                where=str(listing),
                hint="Put it back from where it was recorded, or remove it: the files are then found by name",
            )
        listed = [
            name for name in _listed_files(listing.read_text("utf-8", "replace")) if name.endswith(SUFFIXES)
        ]
        named = {name: _find_listed(path, name) for name in listed}
        parts = [file for file in named.values() if file is not None] or here
        missing = [_show(name) for name, file in named.items() if file is None]
        if parts:
            losses = [
                Loss("missing_part", f"{name} of the recording is not in its folder") for name in missing
            ]
            return parts, losses
    stems = {re.sub(r"_\d+$", "", file.stem) for file in here}
    if here and len(stems) == 1:
        return here, []
    what, hint = "the folder holds no recording", "Give one .mcap, .db3 or .bag file, or one rosbag2 folder"
    if here:
        what = "the folder holds several recordings"
        hint = f"{hint}; `slip batch {path}` analyzes all of them"
    elif any(path.glob("*.zstd")):
        what, hint = (
            "the recording's files are compressed as a whole",
            "Unpack them: zstd -d --rm *.zstd",
        )
    raise LogError("not_a_recording", what, where=str(path), hint=hint)


def list_files(folder: Path) -> list[Path]:
    """The files of recordings in a folder, MCAP first, by name and number.

    If there are none, the text tables of a known data set.
    """
    named = (file for end in SUFFIXES for file in sorted(folder.glob(f"*{end}"), key=_split_number))
    return [file for file in named if not file.is_dir()] or list_tables(folder)


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
    return plain if plain.isprintable() and len(plain) <= _LONGEST_SHOWN else repr(name[:_LONGEST_SHOWN])


def _split_number(file: Path) -> tuple[str, int]:
    match = re.search(r"_(\d+)$", file.stem)
    return (file.stem[: match.start()], int(match[1])) if match else (file.stem, -1)


def _listed_files(text: str) -> list[str]:
    """Entries of ``relative_file_paths`` in a rosbag2 ``metadata.yaml``."""
    entry = r"(?:[ \t\r]*\n)*+[ \t]*-[ \t].*\n?"
    block = re.search(rf"^[ \t]*relative_file_paths:[ \t\r]*\n((?:{entry})*)", text, re.MULTILINE)
    if block is None:
        return []
    entries = [line.strip()[1:].strip() for line in block[1].splitlines() if line.strip()]
    return [entry.strip("\"'") for entry in entries]


def merge_parts(path: Path, parts: Sequence[Part], losses: Sequence[Loss], fetched: int) -> LogIndex:
    """Merge the catalogs of the files of a recording; channels of one topic and type get one number."""
    channels: dict[tuple[object, ...], ChannelInfo] = {}
    alone = len(parts) == 1
    catalogs = [part.catalog for part in parts]
    for part in parts:
        for number, channel in sorted(part.catalog.channels.items()):
            schema = part.catalog.schemas.get(channel.schema_id)
            described = (schema.name, schema.data) if schema else ()
            key = (number,) if alone else (channel.topic, channel.message_encoding, *described)
            known = channels.get(key)
            if known is None:
                known = ChannelInfo(
                    number if alone else len(channels) + 1,
                    channel.topic,
                    schema.name if schema else "",
                    schema.encoding if schema else "",
                    channel.message_encoding,
                    0,
                    dict(channel.metadata),
                )
            count = known.message_count + part.catalog.counts.get(number, 0)
            channels[key] = replace(known, message_count=count)
            part.numbers[number] = known.id
    return LogIndex(
        path=path,
        size_bytes=sum(part.size_bytes for part in parts),
        profile=catalogs[0].profile,
        library=catalogs[0].library,
        compressions=tuple(sorted(set().union(*(catalog.compressions for catalog in catalogs)))),
        chunk_count=sum(span.kind.value != "loose" for catalog in catalogs for span in catalog.spans),
        start_ns=min((each.start_ns for each in catalogs if each.start_ns is not None), default=0),
        end_ns=max((each.end_ns for each in catalogs if each.end_ns is not None), default=0),
        channels=tuple(channels.values()),
        metadata=dict(record for catalog in catalogs for record in catalog.metadata),
        attachments=tuple(name for catalog in catalogs for name in catalog.attachments),
        losses=(*losses, *(loss for catalog in catalogs for loss in catalog.losses)),
        notes=tuple(note for catalog in catalogs for note in catalog.notes),
        parts=tuple(parts),
        fetched_bytes=fetched,
    )


_NOTHING_COVERED: Final = "no checksum covers its messages: damage in them cannot be seen"

_LISTED: Final = 12
"""Maximum number of topics listed in a message."""


class DataSection:
    """Check of the checksum of a file's data section, computed once and in parallel with reading.

    Args:
        source: the file.
        catalog: catalog of the file.
        beside: executor of the computation.
    """

    def __init__(self, source: ByteSource, catalog: Catalog, beside: Executor) -> None:
        self._source = source
        self._catalog = catalog
        self._beside = beside
        self._check: Future[bool] | None = None
        # The check fetches a whole object, so it is started only if no other checksum covers its messages.
        if not is_fetched(source):
            self._begin()

    def _begin(self) -> None:
        end, crc = self._catalog.data_end, self._catalog.data_crc
        if self._check is None and end is not None and crc:
            self._check = self._beside.submit(checksum_holds, self._source, end, crc)

    def holds(self) -> bool:
        """Whether there is such a checksum and it is valid."""
        self._begin()
        return self._check is not None and self._check.result()

    def judge(self, unchecked: int, *, is_damaged: bool) -> Loss | None:
        """Loss if the checksum is invalid, else None.

        Args:
            unchecked: number of spans with messages that were read and have no checksum of their own.
            is_damaged: whether damage to this file is already reported, which explains a mismatch.
        """
        if unchecked:
            self._begin()
        if self._check is None or (is_damaged and not unchecked) or self._check.result():
            return None
        wrong = "the checksum of the data section does not match its bytes"
        if unchecked:
            text = (
                f"{wrong}, and its messages have none of their own: some are damaged, and it is not "
                "known which. They were read; any value may be wrong"
            )
        else:
            text = (
                f"{wrong}: the messages that were read are whole, as their chunks' own checksums say; "
                "something else is damaged, such as metadata or chunks that were not read"
            )
        times = [span.start_ns for span in self._catalog.spans if span.start_ns is not None]
        ends = [span.end_ns for span in self._catalog.spans if span.end_ns is not None]
        return Loss(
            "checksum_mismatch",
            text,
            bytes=self._catalog.data_end or 0,
            start_ns=min(times, default=None),
            end_ns=max(ends, default=None),
        )


@dataclass(slots=True)
class Coverage:
    """Number of spans with messages that were read, and of those without a checksum.

    ``topics`` are those whose definitions have neither a checksum nor a second copy.
    """

    spans: int = 0
    unchecked: int = 0
    topics: list[str] = field(default_factory=list)

    def format_coverage(self) -> str:
        """Description of the unchecked data; empty if all data read is covered."""
        said = []
        if self.unchecked and self.unchecked == self.spans:
            said.append(_NOTHING_COVERED)
        elif self.unchecked:
            said.append(
                f"{self.unchecked} of {self.spans} stretches of it carry no checksum: "
                "damage in them cannot be seen"
            )
        if self.topics:
            listed = ", ".join(self.topics[:_LISTED]) + (", ..." if len(self.topics) > _LISTED else "")
            said.append(
                f"no checksum and no second copy covers what the log says of {listed}: "
                "names and types of their fields may be damaged"
            )
        return "; ".join(said)


def count_missing(counted: Iterable[tuple[ChannelInfo, int]], losses: Sequence[Loss]) -> list[Loss]:
    """Losses of messages that the summary counts but that were not found, if no other loss explains them.

    Args:
        counted: channels with the number of their messages that were found.
        losses: known losses.
    """
    if losses:
        return []
    return [
        Loss(
            "missing_messages",
            f"the summary counts {info.message_count} messages of {info.topic}, {counted_here} were found",
        )
        for info, counted_here in counted
        if counted_here < info.message_count
    ]
