"""A recording that is still being written: only data added since the last update is scanned."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from pipeline.logs import records as rec
from pipeline.logs.catalog import Catalog
from pipeline.logs.index import LISTING, LogIndex, Part, find_parts, merge_parts
from pipeline.logs.part import examine_spans, is_finished
from pipeline.logs.records import LogError
from pipeline.logs.scan import Scanner
from pipeline.logs.source import open_source, usable_threads


@dataclass
class _GrowingFile:
    """One file of a growing recording.

    Attributes:
        path: the file.
        catalog: contents of its complete records.
        offset: first byte of the first incomplete record.
        size: bytes at the last update.
        finished: whether the recorder has finished it.
    """

    path: Path
    catalog: Catalog = field(default_factory=Catalog)
    offset: int = len(rec.MAGIC)
    size: int = 0
    finished: bool = False

    def follow(self) -> bool:
        """Scan the data that was added; returns whether there is any."""
        try:
            size = self.path.stat().st_size
        except FileNotFoundError as error:
            what = "the file was removed while it was watched"
            hint = "Leave the files of a recording where they are until it ends"
            raise LogError("log_changed", what, where=str(self.path), hint=hint) from error
        if size < self.size:
            what = "the file became shorter while it was watched: it was replaced, or is not being recorded"
            raise LogError("log_changed", what, where=str(self.path), hint="Start the watch again")
        if size == self.size or size < len(rec.MAGIC):
            return False
        self.finished, self.size = is_finished(self.path), size
        with open_source(self.path) as source:
            if source.read_at(0, len(rec.MAGIC)) != rec.MAGIC:
                what = "only MCAP files can be watched while they are written, and this is not one"
                hint = "Record with `ros2 bag record -s mcap`, or analyze the log when it is complete"
                raise LogError("not_mcap", what, where=str(self.path), hint=hint)
            known = self.catalog
            # Schemas and channels are shared: the first ones also decode later messages.
            fresh = Catalog(
                profile=known.profile,
                library=known.library,
                schemas=known.schemas,
                channels=known.channels,
                covers=known.covers,
                contradicted=known.contradicted,
                extras=known.extras,
            )
            self.offset = Scanner(source, fresh).follow(self.offset, self.size)
            examine_spans(source, fresh, usable_threads())
        self.catalog = _join(known, fresh)
        return True


def _join(known: Catalog, fresh: Catalog) -> Catalog:
    """Catalog of a file, extended by the data that was added."""
    starts = [one for one in (known.start_ns, fresh.start_ns) if one is not None]
    ends = [one for one in (known.end_ns, fresh.end_ns) if one is not None]
    numbers = known.counts.keys() | fresh.counts.keys()
    return replace(
        fresh,
        spans=known.spans + fresh.spans,
        compressions=known.compressions | fresh.compressions,
        metadata=known.metadata + fresh.metadata,
        attachments=known.attachments + fresh.attachments,
        counts={number: known.counts.get(number, 0) + fresh.counts.get(number, 0) for number in numbers},
        start_ns=min(starts, default=None),
        end_ns=max(ends, default=None),
        losses=known.losses + fresh.losses,
    )


class GrowingLog:
    """A recording that is followed while it is written: a file, or the folder of a split recording.

    It stores the positions of chunks, never their messages: memory grows by some hundred bytes per chunk.
    An incomplete record at the end is not damage: it is read once it is complete.

    Args:
        path: an MCAP file, or a folder of the files of one recording.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._files: dict[Path, _GrowingFile] = {}

    @property
    def note(self) -> str:
        """Status of the recording's source; empty for a file."""
        return ""

    @property
    def cpu_s(self) -> float:
        """CPU time of the process that writes it for the watch [s]; 0 for a file written by others."""
        return 0.0

    def update(self) -> bool:
        """Scan the data added since the last call; returns whether there is any.

        Raises:
            LogError: ``log_not_found``, ``not_a_recording``, ``not_mcap``, ``log_changed``,
                ``log_unreadable``.
        """
        if not self.path.exists():
            raise LogError(
                "log_not_found", "there is no such file", where=str(self.path), hint="Check the path"
            )
        for path in find_parts(self.path)[0]:
            self._files.setdefault(path, _GrowingFile(path))
        grown = [file.follow() for file in self._files.values()]
        return any(grown)

    @property
    def is_closed(self) -> bool:
        """Whether the recorder has finished it; a split recording ends with its `LISTING`."""
        files = self._files.values()
        listed = not self.path.is_dir() or (self.path / LISTING).exists()
        return bool(files) and listed and all(file.finished for file in files)

    @property
    def size(self) -> int:
        """Total size of its files [bytes]."""
        return sum(file.size for file in self._files.values())

    @property
    def start_ns(self) -> int:
        """First log time [ns]; 0 before the first message."""
        starts = (file.catalog.start_ns for file in self._files.values())
        return min((one for one in starts if one is not None), default=0)

    @property
    def end_s(self) -> float:
        """Last log time, relative to the first [s]."""
        return (self._end_ns - self.start_ns) * 1e-9

    @property
    def _end_ns(self) -> int:
        ends = (file.catalog.end_ns for file in self._files.values())
        return max((one for one in ends if one is not None), default=0)

    def make_index(self, seconds: float | None = None) -> LogIndex:
        """Index of the recording so far.

        Args:
            seconds: approximate length of the part at the end to index [s]; None for all.
        """
        since = None if seconds is None else self._end_ns - round(seconds * 1e9)
        parts = [
            Part(file.path, file.size, _cut(file.catalog, since), None)
            for file in self._files.values()
            if file.catalog.spans or len(self._files) == 1
        ]
        return merge_parts(self.path, parts, (), 0)


def _cut(catalog: Catalog, since_ns: int | None) -> Catalog:
    """Catalog without the chunks that end before a time; it shares its dictionaries with the original."""
    spans = [one for one in catalog.spans if since_ns is None or one.end_ns is None or one.end_ns >= since_ns]
    return replace(catalog, spans=spans)
