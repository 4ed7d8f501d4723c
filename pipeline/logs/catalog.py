"""What is known of a file, and how far its chunks may inflate in all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final

from mcap.records import Channel, Schema

from pipeline.logs.chunks import largest_plausible
from pipeline.logs.records import Loss
from pipeline.logs.spans import Span, SpanKind


class Cover(IntEnum):
    """What speaks for a record that describes a channel, from little to much.

    Damage does not change two copies alike, so that agreement is as good as a checksum.
    """

    SUMMARY = 0
    """It stands in a summary without checksum, or with one that does not match."""
    DATA = 1
    """It stands in the data section, and no checksum of a chunk covers it."""
    AGREED = 2
    """It stands in the file twice, and both copies agree."""
    CHECKSUM = 3
    """The checksum of a chunk or of the summary covers it."""


_MAX_EXTRAS: Final = 100_000
"""Entries of metadata and attachments of a file; recorders write tens, and each takes 3 us to read."""

_MAX_ENTRIES: Final = 10_000
"""Entries of one metadata record, so that one alone does not use up what the others need."""

_MAX_EXTRA_BYTES: Final = 64 << 20
"""Bytes of metadata of a file; the largest that is recorded is a robot description of some megabytes."""


@dataclass(slots=True)
class Extras:
    """How much more of metadata and attachments is read: they stand beside the messages, in any number.

    Attributes:
        entries: how many more.
        size: of how many more bytes.
        omitted: records that were more.
    """

    entries: int = _MAX_EXTRAS
    size: int = _MAX_EXTRA_BYTES
    omitted: int = 0

    @property
    def most(self) -> int:
        """Entries of the next record."""
        return min(self.entries, _MAX_ENTRIES)

    def take(self, entries: int | None, size: int) -> bool:
        """Whether a record may be kept; ``entries`` is None where it has more than the most."""
        fits = entries is not None and self.entries > 0 and size <= self.size
        self.entries -= min(self.entries, 1 + (self.most if entries is None else entries))
        self.size -= size if fits else 0
        self.omitted += not fits
        return fits

    def find_losses(self) -> list[Loss]:
        """What was left out."""
        if not self.omitted:
            return []
        text = (
            f"{self.omitted} metadata records and attachments were left out: no more than "
            f"{_MAX_EXTRAS} entries and {_MAX_EXTRA_BYTES >> 20} MiB of them are read, "
            f"{_MAX_ENTRIES} entries of one record"
        )
        return [Loss("too_large", text)]


@dataclass(slots=True)
class Catalog:
    """What is known of a file.

    ``container`` is what kind of file it is, empty for MCAP, and ``most_inflated`` are the bytes that a bag
    may inflate to by the user's word, counted as it is read. ``metadata`` and ``attachments`` keep the order
    of the file, ``side_records`` are their places, lengths and names; ``counts`` are messages by channel
    number; ``covers`` say of each schema and channel of an MCAP file what speaks for it,
    ``contradicted`` are those that it holds in two ways, and ``rivals`` the copies of a summary that others
    of the data section were preferred to.
    """

    container: str = ""
    most_inflated: int | None = None
    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    covers: dict[tuple[type, int], Cover] = field(default_factory=dict)
    contradicted: set[tuple[type, int]] = field(default_factory=set)
    rivals: dict[tuple[type, int], Schema | Channel] = field(default_factory=dict)
    spans: list[Span] = field(default_factory=list)
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

    def add_description(self, record: Schema | Channel, cover: Cover) -> None:
        """Take a schema or channel; of copies that differ the one wins that more speaks for, or the first."""
        key = (type(record), record.id)
        known = self._find(record)
        before = self.covers.get(key)
        if known is None or before is None:
            self._set(record)
            self.covers[key] = cover
            return
        if is_alike(known, record):
            self.covers[key] = max(before, cover, Cover.AGREED)
            return
        if cover > before:
            self._set(record)
            self.covers[key] = cover
        if max(cover, before) is Cover.DATA and min(cover, before) is Cover.SUMMARY:
            self.rivals[key] = known if cover > before else record
        if key not in self.contradicted:
            self.contradicted.add(key)
            self.losses.append(_note_contradiction(record, before, cover))

    def distrust_data(self) -> None:
        """Believe the summary where the data section contradicts it and has no checksum that holds."""
        for key, record in self.rivals.items():
            if self.covers[key] is Cover.DATA:
                self._set(record)

    def find_contradictions(self, records: Iterable[Schema | Channel], cover: Cover) -> list[Loss]:
        """What a chunk describes otherwise than the rest of the file does.

        Args:
            records: of the chunk.
            cover: what speaks for them.
        """
        losses = []
        for record in records:
            known, key = self._find(record), (type(record), record.id)
            if known is not None and key not in self.contradicted and not is_alike(known, record):
                losses.append(_note_contradiction(record, self.covers.get(key, Cover.DATA), cover))
        return losses

    def is_covered(self, number: int, *, data_holds: bool) -> bool:
        """Whether something speaks for what a channel is read by.

        Args:
            number: of the channel.
            data_holds: whether the checksum of the data section holds.
        """
        channel = self.channels[number]
        least = Cover.DATA if data_holds else Cover.AGREED
        keys = [(Channel, number), *([(Schema, channel.schema_id)] if channel.schema_id else [])]
        return all(self.covers.get(key, Cover.CHECKSUM) >= least for key in keys)

    def _find(self, record: Schema | Channel) -> Schema | Channel | None:
        if isinstance(record, Schema):
            return self.schemas.get(record.id)
        return self.channels.get(record.id)

    def _set(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        else:
            self.channels[record.id] = record


def is_alike(one: Schema | Channel, other: Schema | Channel) -> bool:
    """Whether two records of one number say the same of all that messages are decoded by."""
    if one == other:
        return True
    if not isinstance(one, Channel) or not isinstance(other, Channel):
        return False
    # Recorders may add to a channel's own notes, which nothing is decoded by.
    return replace(one, metadata={}) == replace(other, metadata={})


def _note_contradiction(record: Schema | Channel, *covers: Cover) -> Loss:
    """A schema or channel that the file holds in two ways, of which such covers speak for each."""
    name = f"channel {record.id}" if isinstance(record, Channel) else f"schema {record.id}"
    end = "one of the two is damaged, and its messages may be wrong"
    if min(covers) < Cover.AGREED < max(covers):
        end = "the one that a checksum covers was used"
    return Loss("contradiction", f"the file describes {name} in two ways: {end}")


OVER_BUDGET: Final = "max_inflated"
"""Kind of the loss of chunks that are beyond the limit."""

_LEAST: Final = 512 << 20
"""Bytes that any file may inflate to: some seconds of work, whatever they hold."""

_RATIO: Final = 200
"""Times its size that a file may inflate to. The drives of 703 recordings reach 9, images that hardly change
50; a file of nothing but empty maps may reach more."""

_MOST: Final = 1 << 40
"""Bytes that no file may inflate to: the largest recordings are some hundred gigabytes."""


def limit_inflated(size: int, most: int | None) -> int:
    """Bytes that a file of a size may inflate to: what the user allows, else what is plausible."""
    return min(_MOST, max(_LEAST, _RATIO * size)) if most is None else most


def keep_within(catalog: Catalog, size: int, most: int | None) -> None:
    """Leave out of a catalog the chunks that inflate to more than its file may, and say so.

    Nothing is inflated for it: a chunk that holds more than it says is refused when it is read.

    Args:
        catalog: of the file.
        size: bytes of the file.
        most: bytes that it may inflate to; None for what is plausible for its size.
    """
    allowed = limit_inflated(size, most)
    total = sum(_work(span.inflated, span.length) for span in catalog.spans)
    if total <= allowed:
        return
    within: list[Span] = []
    omitted: list[Span] = []
    taken = 0
    for span in catalog.spans:
        work = _work(span.inflated, span.length)
        fits = span.kind is SpanKind.LOOSE or taken + work <= allowed
        taken += work if fits else 0
        (within if fits else omitted).append(span)
    catalog.spans = within
    text = (
        f"the chunks of the file inflate to {_spell(total)}, {total / size:.0f} times its size, and no more "
        f"than {_spell(allowed)} are read: {len(omitted)} of {len(omitted) + len(within)} chunks were left "
        f"out; --max-inflated {-(-total // 10**6)}MB reads them"
    )
    catalog.losses.append(
        Loss(
            OVER_BUDGET,
            text,
            bytes=sum(span.length for span in omitted),
            chunks=len(omitted),
            start_ns=min(_list_known(span.start_ns for span in omitted), default=None),
            end_ns=max(_list_known(span.end_ns for span in omitted), default=None),
        )
    )


def _work(inflated: int, stored: int) -> int:
    """Bytes that inflating a chunk gives; none where its size is refused."""
    return inflated if inflated <= largest_plausible(stored) else 0


def _list_known(times: Iterable[int | None]) -> list[int]:
    return [time for time in times if time is not None]


def _spell(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
