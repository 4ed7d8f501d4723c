"""One file of a recording, local or in an object store: its bytes, and their catalog.

The catalog is that of the summary if it is complete, else it is made by scanning the records.
"""

import hashlib
import os
import stat
import struct
import zlib
from collections import defaultdict
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from mcap.records import AttachmentIndex, Channel, ChunkIndex, MetadataIndex, Schema, Statistics

from pipeline.core import guess_names
from pipeline.logs import records as rec
from pipeline.logs.bags import catalog_bag
from pipeline.logs.catalog import Catalog, keep_within
from pipeline.logs.chunks import ByteSpan, SpanKind
from pipeline.logs.compressed import COMPRESSED, open_inflated
from pipeline.logs.foreign import LONGEST_START, name_foreign, name_packed
from pipeline.logs.records import (
    LONGEST_HEAD,
    LONGEST_MAGIC,
    ByteSource,
    LogError,
    Loss,
    detect_container,
    is_whole,
)
from pipeline.logs.remote import RemotePath, RemoteSource
from pipeline.logs.scan import Numbered, Scanner, find_missing
from pipeline.logs.spans import Loaded, load_spans

_HASH_BLOCK: Final = 1 << 20
_MOST_NEIGHBOURS: Final = 1000
"""Maximum number of folder entries compared with a mistyped name: more take longer than a manual look."""


def _list_neighbours(path: Path) -> list[str]:
    """Names beside a path with its suffix; all names if it has none."""
    with suppress(OSError), os.scandir(path.parent) as entries:
        beside = [entry.name for entry in islice(entries, _MOST_NEIGHBOURS)]
        return [name for name in beside if path.suffix in {"", Path(name).suffix}]
    return []


class FileSource(AbstractContextManager["FileSource"]):
    """A local file, open for the duration of a `with` block; one that is compressed as a whole is inflated.

    Args:
        path: the file.

    Attributes:
        size: count of bytes when it was opened, inflated.
        name: the path.

    Raises:
        LogError: ``log_not_found``, ``log_unreachable``, ``log_unreadable``, ``log_empty``.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        try:
            # Without O_NONBLOCK, opening a pipe would wait for a writer.
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError:
            if path.is_symlink():
                hint = "Look where it leads: ls -l"
                raise LogError(
                    "log_not_found", "it is a link to nothing", where=self.name, hint=hint
                ) from None
            hint = f"{guess_names(path.name, _list_neighbours(path), end=path.suffix)}Check the path"
            raise LogError("log_not_found", "there is no such file", where=str(path), hint=hint) from None
        except OSError as error:
            what = f"the file cannot be opened ({error.strerror})"
            raise LogError("log_unreachable", what, where=self.name, hint="Check its permissions") from None
        status = os.fstat(self._descriptor)
        self.size = status.st_size
        if not stat.S_ISREG(status.st_mode):
            self.close()
            what = "it is a pipe, a socket or a device, not a file"
            raise LogError("log_unreadable", what, where=self.name, hint="Give an .mcap file")
        if self.size == 0:
            self.close()
            hint = "The recorder was stopped before it wrote anything; omit this file"
            raise LogError("log_empty", "the file is empty", where=self.name, hint=hint)
        if path.suffix in COMPRESSED:
            compressed = self._descriptor
            try:
                self._descriptor = open_inflated(path, compressed)
            finally:
                os.close(compressed)
            self.size = os.fstat(self._descriptor).st_size

    def read_at(self, offset: int, length: int) -> bytes:
        """The bytes from ``offset``; fewer than ``length`` only at the end."""
        wanted = max(0, min(length, self.size - offset))
        try:
            data = os.pread(self._descriptor, wanted, offset) if wanted else b""
            while len(data) < wanted:
                added = os.pread(self._descriptor, wanted - len(data), offset + len(data))
                if not added:
                    break
                data += added
        except OSError as error:
            what = f"bytes {offset} to {offset + wanted} cannot be read ({error.strerror})"
            hint = "Copy the file from its origin again"
            raise LogError("log_unreachable", what, where=self.name, hint=hint) from None
        return data

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    def __exit__(self, *_exception: object) -> None:
        self.close()


def open_source(path: Path, version: str | None = None) -> AbstractContextManager[ByteSource]:
    """Open a file or an object.

    Args:
        path: the file or object.
        version: of an object, the result of `version_of` when it was last opened; another is refused.

    Raises:
        LogError: ``log_not_found``, ``log_unreadable``, ``log_empty``, ``log_changed``.
    """
    if not isinstance(path, RemotePath):
        return FileSource(path)
    if path.suffix in COMPRESSED:
        what = "a file that is compressed as a whole is not read from an object store"
        raise LogError("log_unreadable", what, where=str(path), hint="Copy it, or unpack it there: zstd -d")
    return RemoteSource(path, version)


def version_of(source: ByteSource) -> str | None:
    """Version of the open object; None for a file."""
    return source.version if isinstance(source, RemoteSource) else None


def count_fetched(sources: Sequence[ByteSource]) -> int:
    """Number of bytes fetched from object stores."""
    return sum(source.fetched for source in sources if isinstance(source, RemoteSource))


def hash_sources(sources: Sequence[ByteSource]) -> str:
    """SHA-256 (hex) of the concatenated bytes of the sources.

    An object is not fetched: the version and size reported by its store represent its bytes.
    """
    if len(sources) == 1 and isinstance(sources[0], RemoteSource):
        return sources[0].version
    digest = hashlib.sha256()
    for source in sources:
        if isinstance(source, RemoteSource):
            digest.update(bytes.fromhex(source.version))
            continue
        for offset in range(0, source.size, _HASH_BLOCK):
            digest.update(source.read_at(offset, _HASH_BLOCK))
    return digest.hexdigest()


_FOOTER: Final = struct.Struct("<QQI")
_MAX_SUMMARY: Final = 1 << 29


class _NoSummaryError(Exception):
    """The summary is absent or incomplete; the text states what is missing."""


class _DamagedSummaryError(_NoSummaryError):
    """The summary is damaged or cut off; the text states the damage."""


class _Summary(NamedTuple):
    start: int
    statistics: Statistics
    chunks: list[ByteSpan]
    side_records: set[tuple[int, int, str]]


def catalog_file(source: ByteSource, *, threads: int = 1, max_inflated: int | None = None) -> Catalog:
    """Catalog the contents of a file.

    Args:
        source: the file.
        threads: number of chunks that are inflated at once if the summary is missing.
        max_inflated: limit of the total inflated size [bytes]; None for one plausible for its size.

    Raises:
        LogError: ``not_mcap``; for a bag, ``log_unreadable``.
    """
    head = source.read_at(0, LONGEST_MAGIC)
    is_mcap = head.startswith(rec.MAGIC)
    if not is_mcap and (container := detect_container(head)):
        catalog = catalog_bag(source, container)
        catalog.most_inflated = max_inflated
        keep_within(catalog, source.size, max_inflated)
        return catalog
    catalog = Catalog()
    _check_magic(head[: len(rec.MAGIC)], source, catalog)
    ends_well = source.read_at(max(0, source.size - len(rec.MAGIC)), len(rec.MAGIC)) == rec.MAGIC
    stop = source.size - len(rec.MAGIC) if ends_well and source.size >= 2 * len(rec.MAGIC) else source.size
    summary: _Summary | None = None
    reason = _NoSummaryError()
    try:
        summary = _read_summary(source, catalog, threads)
        stop = summary.start
    except _NoSummaryError as error:
        reason, catalog = error, Catalog(losses=catalog.losses)
    listed = summary.chunks if summary is not None else []
    Scanner(source, catalog).scan(len(rec.MAGIC), stop, listed)
    unlisted = catalog.count_chunks() - len(listed)
    keep_within(catalog, source.size, max_inflated)
    if summary is None or unlisted:
        examine_spans(source, catalog, threads)
    if summary is None:
        catalog.notes.append(f"{reason}; the index was rebuilt by reading all records")
        has_loss = any(each.kind == "truncated" for each in catalog.losses)
        if isinstance(reason, _DamagedSummaryError) and not has_loss:
            text = f"{reason}; all records were read instead"
            catalog.losses.append(Loss("damaged_summary", text))
    else:
        for _, _, name in sorted(summary.side_records - catalog.side_records):
            text = f"the metadata or attachment {name!r} that the summary lists is damaged or missing"
            catalog.losses.append(Loss("contradiction", text))
        if unlisted:
            catalog.notes.append(f"{unlisted} chunks that the summary does not list were found")
        else:
            statistics = summary.statistics
            catalog.counts = dict(statistics.channel_message_counts)
            if statistics.message_count:
                times = statistics.message_start_time, statistics.message_end_time
                catalog.add_times(*map(rec.clip_time, times))
    catalog.losses += [*catalog.find_contradictions(), *catalog.extras.find_losses()]
    return catalog


def is_written_to(path: Path) -> bool:
    """Whether a transaction is in progress in an SQLite file."""
    return any(path.with_name(path.name + end).exists() for end in ("-journal", "-wal"))


def is_finished(path: Path) -> bool:
    """Whether a recorder has finished a file, judged by its first and last bytes.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(LONGEST_HEAD)
        size = stream.seek(0, os.SEEK_END)
        if path.suffix in COMPRESSED:
            # The end of the content is known only after inflating it: the time of change decides.
            return False
        if detect_container(head):
            return is_whole(head, size) and not is_written_to(path)
        stream.seek(max(0, size - len(rec.MAGIC)))
        return size >= 2 * len(rec.MAGIC) and stream.read() == rec.MAGIC


class Content(NamedTuple):
    """What a file holds, whatever its name is.

    Attributes:
        is_read: whether it is a recording that is read.
        packed: what a recording may be packed with that is not read, and how to unpack it; None without.
    """

    is_read: bool
    packed: tuple[str, str] | None


def judge_content(path: Path) -> Content:
    """What a file or object holds, by its first bytes.

    Raises:
        OSError: it cannot be read.
        LogError: ``log_unreachable``, the object store does not answer.
    """
    if path.suffix in COMPRESSED:
        return Content(is_read=True, packed=None)
    if isinstance(path, RemotePath):
        with open_source(path) as source:
            start = source.read_at(0, LONGEST_START)
    else:
        with path.open("rb") as stream:
            start = stream.read(LONGEST_START)
    is_read = start.startswith(rec.MAGIC) or bool(detect_container(start))
    return Content(is_read, name_packed(start))


_FARM_NG: Final = b"\x0a\x08protobuf"
"""Start of the address in the first event, after its length."""


def _check_magic(head: bytes, source: ByteSource, catalog: Catalog) -> None:
    if head == rec.MAGIC:
        return
    what = "this is not an MCAP file or a ROS bag"
    hint = "Give an .mcap, .bag or .db3 file: others are first converted to one of these"
    if head.startswith(b"\x89MCAP0\n"):
        what = "a copy in text mode changed line ends of the file, and with them its data"
        hint = "Copy the file again in binary mode"
    elif sum(map(int.__eq__, head, rec.MAGIC)) >= len(rec.MAGIC) - 2:
        catalog.losses.append(Loss("damaged_record", "the file's first 8 bytes are damaged", bytes=8))
        return
    elif _FARM_NG in source.read_at(0, 2 * len(_FARM_NG)):
        what = "it is a recording of farm-ng's event recorder, whose messages have no definitions in the file"
        hint = "Write them into an .mcap: farm_ng.core's EventsFileReader, and mcap_protobuf's Writer"
    elif foreign := name_foreign(source.read_at(0, LONGEST_START)):
        what, hint = foreign
    raise LogError("not_mcap", what, where=source.name, hint=hint)


def _find_summary(source: ByteSource) -> tuple[int, bytes, bool]:
    """Offset and bytes of the summary, and whether a checksum covers it.

    Raises:
        _NoSummaryError: there is none, or it is damaged.
    """
    tail_size = rec.FOOTER_SIZE + len(rec.MAGIC)
    footer_at = source.size - tail_size
    tail = source.read_at(max(0, footer_at), tail_size)
    if len(tail) < tail_size or not tail.endswith(rec.MAGIC):
        raise _DamagedSummaryError("the end of the file is not that of an MCAP file")
    start, _offsets, crc = _FOOTER.unpack_from(tail, rec.HEAD_SIZE)
    is_footer = tail.startswith(rec.HEAD.pack(rec.FOOTER, rec.LEAST_BODY[rec.FOOTER]))
    if is_footer and start == 0:
        raise _NoSummaryError("there is no summary")
    if not is_footer or not len(rec.MAGIC) <= start <= footer_at or footer_at - start > _MAX_SUMMARY:
        raise _DamagedSummaryError("the footer is damaged")
    body = source.read_at(start, footer_at - start)
    if crc and zlib.crc32(body + tail[: rec.HEAD_SIZE + 16]) != crc:
        raise _DamagedSummaryError("the summary is damaged")
    return start, body, crc != 0


def _read_summary(source: ByteSource, catalog: Catalog, threads: int) -> _Summary:
    """Read the summary; its schemas and channels become those of the catalog.

    Raises:
        _NoSummaryError: there is none that can be used.
    """
    start, body, covered = _find_summary(source)
    try:
        records = _parse_summary(memoryview(body))
    except rec.RecordError as error:
        raise _DamagedSummaryError(f"the summary is damaged ({error})") from None
    for record in records[Schema] + records[Channel]:
        catalog.add_description(record, covered=covered)
    statistics = next(iter(records[Statistics][::-1]), None)
    if statistics is None:
        raise _NoSummaryError("the summary has no statistics")
    chunks = sorted(records[ChunkIndex], key=attrgetter("chunk_start_offset"))
    counts, channels = statistics.channel_message_counts, catalog.channels
    schemas = {channel.schema_id for channel in channels.values()}
    for is_wrong, missing in (
        (len(chunks) != statistics.chunk_count, "list its chunks"),
        (sum(counts.values()) != statistics.message_count, "count its messages by channel"),
        (not counts.keys() <= channels.keys(), "list its channels"),
        (not schemas <= catalog.schemas.keys() | {0}, "list its schemas"),
    ):
        if is_wrong:
            raise _NoSummaryError(f"the summary does not {missing}")
    catalog.compressions = {chunk.compression for chunk in chunks}
    spans = [
        ByteSpan(
            SpanKind.CHUNK,
            chunk.chunk_start_offset,
            chunk.chunk_length,
            chunk.message_index_length,
            rec.clip_time(chunk.message_start_time),
            rec.clip_time(chunk.message_end_time),
            frozenset(chunk.message_index_offsets) or None,
            chunk.uncompressed_size,
        )
        for chunk in chunks
    ]
    ends = [len(rec.MAGIC), *(span.end for span in spans)]
    least = rec.LEAST_BODY[rec.CHUNK]
    if any(span.offset < end or span.length < least for span, end in zip(spans, ends, strict=False)):
        raise _DamagedSummaryError("the summary places its chunks one over the other")
    if ends[-1] > start:
        raise _DamagedSummaryError("the summary places chunks beyond the data")
    if not covered:
        _compare_summary(source, catalog, spans, threads)
    side_records = {
        (one.offset, one.length, one.name) for one in records[AttachmentIndex] + records[MetadataIndex]
    }
    return _Summary(start, statistics, spans, side_records)


def _parse_summary(body: memoryview) -> defaultdict[type, list[Any]]:
    """The records of a summary, by kind.

    Raises:
        RecordError: it is damaged.
    """
    records: defaultdict[type, list[Any]] = defaultdict(list)
    end = 0
    for opcode, start, end in rec.split_records(body, 0, len(body)):
        record = rec.parse_record(opcode, body[start + rec.HEAD_SIZE : end])
        records[type(record)].append(record)
    if end < len(body):
        raise rec.RecordError("a record is truncated")
    return records


def _compare_summary(source: ByteSource, catalog: Catalog, spans: Sequence[ByteSpan], threads: int) -> None:
    """Compare a summary without a checksum with the chunks that it lists, and those in which channels begin.

    Recorders repeat the records of a channel there.
    """
    sought = set(catalog.channels)
    chosen: list[ByteSpan] = []
    for span in spans:
        head = rec.HEAD.pack(rec.CHUNK, span.length - rec.HEAD_SIZE)
        if source.read_at(span.offset, rec.HEAD_SIZE) != head:
            raise _DamagedSummaryError("the summary disagrees with the chunks")
        if here := sought if span.channels is None else span.channels & sought:
            chosen.append(span)
            sought = sought - here
    for _, loaded in load_spans(source, chosen, _forget_chunk, threads=threads):
        _add_descriptions(catalog, loaded)
    if catalog.contradicted:
        raise _DamagedSummaryError("the summary disagrees with the chunks")


def _add_descriptions(catalog: Catalog, loaded: Loaded) -> None:
    for record in loaded.messages.descriptions:
        catalog.add_description(record, covered=not loaded.unchecked)


def _forget_chunk(span: ByteSpan, loaded: Loaded) -> tuple[ByteSpan, Loaded]:
    return span, replace(loaded, chunk=b"")


def examine_spans(source: ByteSource, catalog: Catalog, threads: int) -> None:
    """Inflate every span to determine what no index states: channels, counts, times."""
    catalog.counts = {}
    examined: list[ByteSpan] = []
    losses = dict.fromkeys(catalog.losses)
    numbered: list[Numbered] = []
    for span, loaded in load_spans(source, catalog.spans, _forget_chunk, threads=threads):
        messages = loaded.messages
        losses.update(dict.fromkeys(loaded.losses))
        _add_descriptions(catalog, loaded)
        if span.kind is SpanKind.CHUNK and not loaded.losses:
            numbered.append((span, messages.channel, messages.sequence, messages.log_time))
        numbers, counts = np.unique(messages.channel, return_counts=True)
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
            catalog.counts[number] = catalog.counts.get(number, 0) + count
        if messages.log_time.size:
            first, last = int(messages.log_time.min()), int(messages.log_time.max())
            catalog.add_times(first, last)
            if span.start_ns is None:
                span = replace(span, start_ns=first, end_ns=last)  # noqa: PLW2901
        examined.append(replace(span, channels=frozenset(numbers.tolist())))
    for record in catalog.repeated:
        catalog.add_description(record, covered=False)
    catalog.spans = examined
    catalog.losses = list(losses | dict.fromkeys(catalog.losses))
    catalog.losses += find_missing(numbered, catalog.channels)
    for number in sorted(catalog.counts.keys() - catalog.channels.keys()):
        text = f"{catalog.counts.pop(number)} messages of channel {number}, whose own record is lost"
        catalog.losses.append(Loss("unknown_channel", text, start_ns=catalog.start_ns, end_ns=catalog.end_ns))
