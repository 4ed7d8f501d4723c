"""Bags of ROS 1: the list of their chunks, and the messages in one of them.

A record is a header of named fields and its data, each with its length (u32) before it. At the end of a bag
are its connections and its chunks; after every chunk are the places of its messages, by connection.
"""

import struct
from collections.abc import Iterator
from typing import Final

import numpy as np
from mcap.records import Channel, Schema

from pipeline.core import Ints, format_count
from pipeline.logs import records as rec
from pipeline.logs.catalog import Catalog
from pipeline.logs.chunks import ByteSpan, Messages, SpanKind, inflate
from pipeline.logs.records import Buffer, ByteSource, Loss

_WORD: Final = struct.Struct("<I")
_START: Final = len(b"#ROSBAG V2.0\n")
_MESSAGE, _HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = (bytes([code]) for code in range(2, 8))

_LONGEST_HEADER: Final = 1 << 16
"""Maximum size of the header of a record [bytes]: it holds numbers, and the name of a topic."""

_MAX_LIST: Final = 1 << 29
"""Maximum size of the lists at the end of a bag [bytes]."""

_MOST_BETWEEN: Final = 100
"""Maximum number of records of connections in front of a message."""

_COMPRESSIONS: Final = {b"none": "", b"bz2": "bz2", b"lz4": "lz4"}


def _split(content: Buffer, offset: int) -> tuple[bytes, int, int]:
    """Header of the record at an offset, and where its data start and end.

    Raises:
        struct.error: there is none.
        RecordError: its header is longer than any.
    """
    (size,) = _WORD.unpack_from(content, offset)
    if size > _LONGEST_HEADER:
        raise rec.RecordError("the header of a record is longer than any")
    start = offset + 2 * _WORD.size + size
    (length,) = _WORD.unpack_from(content, start - _WORD.size)
    return bytes(content[offset + _WORD.size : start - _WORD.size]), start, start + length


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Named values of a header, or of the data of a connection."""
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        (length,) = _WORD.unpack_from(header, position)
        position += _WORD.size + length
        name, _, value = header[position - length : position].partition(b"=")
        fields[name] = value
    return fields


def _records(content: Buffer) -> Iterator[tuple[dict[bytes, bytes], Buffer]]:
    """Headers and data of the records of a stretch; raises an error where bytes are none."""
    position = 0
    while position < len(content):
        header, start, position = _split(content, position)
        if position > len(content):
            raise rec.RecordError("a record is longer than what holds it")
        yield _fields(header), content[start:position]


def _time(stored: bytes) -> int:
    seconds, nanoseconds = struct.unpack("<II", stored)
    return rec.clip_time(seconds * 10**9 + nanoseconds)


def catalog_ros1(source: ByteSource, catalog: Catalog) -> None:
    """Catalog the contents of a bag from the lists at its end.

    Raises:
        Exception: of many types, if they are damaged.
    """
    header, _, _ = _split(source.read_at(_START, rec.LONGEST_HEAD), 0)
    end, count = (int.from_bytes(_fields(header)[name], "little") for name in (b"index_pos", b"chunk_count"))
    if not _START < end <= source.size or source.size - end > _MAX_LIST:
        raise rec.RecordError("its end is missing")
    starts: list[tuple[int, int, int, dict[int, int]]] = []
    for fields, data in _records(memoryview(source.read_at(end, source.size - end))):
        if fields[b"op"] == _CONNECTION:
            number, described = int.from_bytes(fields[b"conn"], "little"), _fields(bytes(data))
            name, text = described[b"type"].decode(), described[b"message_definition"]
            catalog.schemas[number] = Schema(number, text, "ros1msg", name)
            catalog.channels[number] = Channel(number, fields[b"topic"].decode(), "ros1", {}, number)
            catalog.counts.setdefault(number, 0)
        elif fields[b"op"] == _CHUNK_INFO:
            position, times = int.from_bytes(fields[b"chunk_pos"], "little"), (b"start_time", b"end_time")
            first, last = (_time(fields[name]) for name in times)
            starts.append((position, first, last, dict(struct.iter_unpack("<II", data))))
    if len(starts) != count:
        raise rec.RecordError("its end is missing")
    starts = sorted((one for one in starts if _START < one[0] < end), key=lambda one: one[0])
    stops = [*(start for start, *_ in starts[1:]), end]
    for (start, first, last, counts), stop in zip(starts, stops, strict=True):
        inflated = 0
        try:
            fields = _fields(_split(source.read_at(start, rec.LONGEST_HEAD), 0)[0])
            inflated = int.from_bytes(fields[b"size"], "little")
            catalog.compressions.add(_COMPRESSIONS[fields[b"compression"]])
        except (struct.error, KeyError, rec.RecordError):
            pass  # reading it says so
        numbers = frozenset(counts) & catalog.channels.keys()
        span = ByteSpan(SpanKind.BAG_CHUNK, start, stop - start, 0, first, last, numbers, inflated)
        catalog.spans.append(span)
        if numbers:
            catalog.add_times(first, last)
        for number in numbers:
            catalog.counts[number] += counts[number]


def load_ros1(span: ByteSpan, blob: Buffer) -> tuple[Buffer, Messages, list[Loss]]:
    """Content, messages and losses of a chunk with the index after it.

    Raises:
        RecordError, struct.error, InflateError: it is damaged.
    """
    header, start, end = _split(blob, 0)
    fields = _fields(header)
    if fields.get(b"op") != _CHUNK or fields.get(b"compression") not in _COMPRESSIONS or end > len(blob):
        raise rec.RecordError("its header is damaged")
    content = inflate(blob[start:end], _COMPRESSIONS[fields[b"compression"]], span.inflated)
    entries: list[tuple[int, int, bytes]] = []
    why = ""
    try:
        for fields, data in _records(blob[end:]):
            number = int.from_bytes(fields[b"conn"], "little")
            entries += [(offset, number, at) for at, offset in struct.iter_unpack("<8sI", data)]
    except (KeyError, struct.error, rec.RecordError) as error:
        why = f"its index is damaged: {error}"
    located: list[tuple[int, int, int, int]] = []
    lost: list[int] = []
    entries.sort()
    limits = [*(offset for offset, *_ in entries[1:]), len(content)]
    for (offset, number, at), limit in zip(entries, limits, strict=False):
        try:
            start, end = _find_message(content, offset, number, at, limit)
        except (struct.error, rec.RecordError) as error:
            why = why or str(error)
            lost.append(_time(at))
        else:
            located.append((start, end - start, number, _time(at)))
    losses = []
    if why:
        count = format_count(len(lost), "message")
        text = f"{count} in the chunk at byte {span.offset} cannot be read ({why})"
        first, last = min(lost, default=span.start_ns), max(lost, default=span.end_ns)
        losses.append(Loss("damaged_record", text, 0, 1, first, last))
    columns: Ints = np.array(located, dtype=np.int64).reshape(-1, 4).T
    messages = Messages(
        columns[0], columns[1], columns[2], np.zeros(len(located), dtype=np.uint32), columns[3], columns[3]
    )
    return content, messages, losses


def _find_message(content: Buffer, offset: int, number: int, at: bytes, limit: int) -> tuple[int, int]:
    """Start and end of the message of a connection and time that the index places from an offset to a limit.

    Raises:
        RecordError, struct.error: there is another record, or none.
    """
    for _ in range(_MOST_BETWEEN):
        header, start, end = _split(content, offset)
        if b"op=" + _CONNECTION not in header:
            break
        offset = end
    if not all(part in header for part in (b"op=" + _MESSAGE, b"conn=" + _WORD.pack(number), b"time=" + at)):
        raise rec.RecordError("the index names a message that is not there")
    if end > limit:
        raise rec.RecordError("a message is longer than its place")
    return start, end
