"""The catalog of a file's contents, its coverage by checksums, and the limit of its inflated size."""

import zlib
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import Any, Final

from mcap.records import Channel, Schema

from pipeline.core import format_size, name_first
from pipeline.logs.chunks import ByteSpan, SpanKind, largest_plausible
from pipeline.logs.records import ByteSource, Loss
from pipeline.logs.remote import RemoteSource

_MAX_EXTRAS: Final = 64 << 20
"""Maximum size of a file's metadata and names of attachments [bytes]; the largest recorded is a robot
description of some MB."""

_ENTRY: Final = 640
"""What an entry is charged besides its bytes [bytes], for the time and the memory that it takes."""


@dataclass(slots=True)
class Extras:
    """Remaining budget for metadata and attachments, of which a file may contain any number.

    Attributes:
        remaining: remaining size [bytes].
        omitted: number of records beyond the budget.
    """

    remaining: int = _MAX_EXTRAS
    omitted: int = 0

    @property
    def most(self) -> int:
        """Maximum number of entries of the next record."""
        return max(self.remaining, 0) // _ENTRY

    def take(self, entries: int, size: int) -> bool:
        """Charge a record; returns whether it fits."""
        self.remaining -= size + _ENTRY * (1 + entries)
        self.omitted += self.remaining < 0
        return self.remaining >= 0

    def find_losses(self) -> list[Loss]:
        """The loss for the omitted records, if any."""
        if not self.omitted:
            return []
        text = (
            f"{self.omitted} metadata records and attachments were left out: no more than "
            f"{_MAX_EXTRAS >> 20} MiB of them are read, or {_MAX_EXTRAS // _ENTRY:,} entries"
        )
        return [Loss("too_large", text)]


@dataclass(slots=True)
class Catalog:
    """Contents of a file.

    ``container`` is the kind of file, empty for MCAP. ``most_inflated`` is the user's limit of the inflated
    size [bytes]; that of a database, which has no spans, is counted while it is read. ``metadata`` and
    ``attachments`` are in the order of the file, ``side_records`` are their offsets, lengths and names.
    ``counts`` are messages by channel number. ``bare`` are the schemas and channels that no checksum covers,
    ``contradicted`` those with differing copies, ``repeated`` the copies after the data section.
    """

    container: str = ""
    most_inflated: int | None = None
    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    bare: set[tuple[type, int]] = field(default_factory=set)
    contradicted: set[tuple[type, int]] = field(default_factory=set)
    repeated: list[Schema | Channel] = field(default_factory=list)
    spans: list[ByteSpan] = field(default_factory=list)
    compressions: set[str] = field(default_factory=set)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    attachments: list[str] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    losses: list[Loss] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    data_end: int | None = None
    data_crc: int = 0
    side_records: set[tuple[int, int, str]] = field(default_factory=set)
    extras: Extras = field(default_factory=Extras)

    def count_chunks(self) -> int:
        """Number of chunks; 0 of a file that has none."""
        return sum(span.kind.value != "loose" for span in self.spans)

    def add_times(self, first: int, last: int) -> None:
        """Add the first and last log time [ns] of some messages."""
        self.start_ns = first if self.start_ns is None else min(first, self.start_ns)
        self.end_ns = last if self.end_ns is None else max(last, self.end_ns)

    def add_description(self, record: Schema | Channel, *, covered: bool) -> None:
        """Add a schema or channel: the first of a number counts, or the first that a checksum covers."""
        held: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        key = (type(record), record.id)
        known = held.get(record.id)
        if known is not None and (covered or key in self.bare) and not _is_alike(known, record):
            self.contradicted.add(key)
        if known is None or (covered and key in self.bare):
            held[record.id] = record
            (self.bare.discard if covered else self.bare.add)(key)

    def is_bare(self, number: int) -> bool:
        """Whether no checksum covers the channel record of a number, or none covers its schema."""
        return not self.bare.isdisjoint({(Channel, number), (Schema, self.channels[number].schema_id)})

    def find_contradictions(self) -> list[Loss]:
        """The loss for schemas and channels with differing copies, if any."""
        if not self.contradicted:
            return []
        names = sorted(f"{kind.__name__.lower()} {number}" for kind, number in self.contradicted)
        text = f"the file describes {name_first(names)} in two ways: messages of it may be wrong"
        return [Loss("contradiction", text)]


def _is_alike(one: Schema | Channel, other: Schema | Channel) -> bool:
    """Whether two records with the same number agree in all values that decoding uses."""
    if isinstance(one, Channel) and isinstance(other, Channel):
        # Recorders may add to a channel's metadata, which decoding does not use.
        return replace(one, metadata={}) == replace(other, metadata={})
    return one == other


OVER_BUDGET: Final = "max_inflated"
"""Kind of the loss of chunks beyond the limit of the inflated size."""

_LEAST: Final = 512 << 20
"""Inflated size [bytes] that is allowed for any file: some seconds of work for any content."""

_RATIO: Final = 200
"""Maximum ratio of the inflated size to the size of a file. The drives of 703 recordings reach 9, nearly
constant images 50; a file of only empty maps may reach more."""

_MOST: Final = 1 << 40
"""Maximum default limit of the inflated size [bytes]: the largest recordings are some hundred GB."""


def limit_inflated(size: int, most: int | None) -> int:
    """Limit of the inflated size of a file [bytes]: the user's limit ``most``, else a plausible one."""
    return min(_MOST, max(_LEAST, _RATIO * size)) if most is None else most


def keep_within(catalog: Catalog, size: int, most: int | None) -> None:
    """Remove the chunks beyond the limit of the inflated size from a catalog, and report them as a loss.

    Nothing is inflated here: a chunk that exceeds its stated size is refused when it is read.

    Args:
        catalog: catalog of the file.
        size: size of the file [bytes].
        most: limit of the inflated size [bytes]; None for one that is plausible for the file's size.
    """
    allowed = limit_inflated(size, most)
    total = sum(_work(span.inflated, span.length) for span in catalog.spans)
    if total <= allowed:
        return
    within: list[ByteSpan] = []
    omitted: list[ByteSpan] = []
    taken = 0
    for span in catalog.spans:
        work = _work(span.inflated, span.length)
        fits = span.kind is SpanKind.LOOSE or taken + work <= allowed
        taken += work if fits else 0
        (within if fits else omitted).append(span)
    catalog.spans = within
    text = (
        f"the chunks of the file decompress to {format_size(total)}, {total / size:.0f} times its size, and "
        f"at most {format_size(allowed)} are read: {len(omitted)} of {len(omitted) + len(within)} chunks "
        f"were left out; --max-inflated {-(-total // 10**6)}MB reads them"
    )
    catalog.losses.append(
        Loss(
            OVER_BUDGET,
            text,
            sum(span.length for span in omitted),
            len(omitted),
            *_range_of(omitted),
        )
    )


def _work(inflated: int, stored: int) -> int:
    """Inflated size of a chunk [bytes]; 0 if it is implausible, since such a chunk is refused."""
    return inflated if inflated <= largest_plausible(stored) else 0


def _range_of(spans: Sequence[ByteSpan]) -> tuple[int | None, int | None]:
    """First and last known log time of spans [ns]."""
    starts = (span.start_ns for span in spans if span.start_ns is not None)
    ends = (span.end_ns for span in spans if span.end_ns is not None)
    return min(starts, default=None), max(ends, default=None)


_NOTHING_COVERED: Final = "no checksum covers its messages: damage in them cannot be detected"


_CRC_BLOCK: Final = 1 << 20


def _checksum_holds(source: ByteSource, end: int, crc: int) -> bool:
    """Whether the checksum of the data section, the first ``end`` bytes of a file, is valid."""
    computed = 0
    for offset in range(0, end, _CRC_BLOCK):
        computed = zlib.crc32(source.read_at(offset, min(_CRC_BLOCK, end - offset)), computed)
    return computed == crc


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
        if not isinstance(source, RemoteSource):
            self._begin()

    def _begin(self) -> None:
        end, crc = self._catalog.data_end, self._catalog.data_crc
        if self._check is None and end is not None and crc:
            self._check = self._beside.submit(_checksum_holds, self._source, end, crc)

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
        return Loss(
            "checksum_mismatch",
            text,
            self._catalog.data_end or 0,
            0,
            *_range_of(self._catalog.spans),
        )


@dataclass(slots=True)
class Coverage:
    """Number of spans with messages that were read, and of those without a checksum.

    ``topics`` are those whose definitions have no checksum.
    """

    spans: int = 0
    unchecked: int = 0
    topics: list[str] = field(default_factory=list)

    def format_coverage(self) -> str:
        """Description of the unchecked data; empty if all data read is covered."""
        if self.unchecked and self.unchecked == self.spans:
            return _NOTHING_COVERED
        said = []
        if self.unchecked:
            said.append(
                f"{self.unchecked} of {self.spans} stretches of it carry no checksum: "
                "damage in them cannot be seen"
            )
        if self.topics:
            said.append(
                f"no checksum covers what the log says of {name_first(self.topics)}: "
                "names and types of their fields may be damaged"
            )
        return "; ".join(said)
