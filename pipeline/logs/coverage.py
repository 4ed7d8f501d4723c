"""What the checksums of a recording cover, and what is said where they do not hold or there are none."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from pipeline.logs.catalog import Catalog
from pipeline.logs.errors import Loss
from pipeline.logs.loading import checksum_holds
from pipeline.logs.source import ByteSource, is_fetched

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from concurrent.futures import Executor, Future

    from pipeline.logs.index import ChannelInfo

_NOTHING_COVERED: Final = "no checksum covers its messages: damage in them cannot be seen"

_LISTED: Final = 12
"""So many topics are named."""


class DataSection:
    """The checksum over the data section of one file, computed once, beside the reading.

    Args:
        source: the file.
        catalog: what it holds.
        beside: computes it.
    """

    def __init__(self, source: ByteSource, catalog: Catalog, beside: Executor) -> None:
        self._source = source
        self._catalog = catalog
        self._beside = beside
        self._check: Future[bool] | None = None
        # All of an object is fetched for this only where nothing else covers its messages.
        if not is_fetched(source):
            self._begin()

    def _begin(self) -> None:
        end, crc = self._catalog.data_end, self._catalog.data_crc
        if self._check is None and end is not None and crc:
            self._check = self._beside.submit(checksum_holds, self._source, end, crc)

    def holds(self) -> bool:
        """Whether there is such a checksum and it holds."""
        self._begin()
        return self._check is not None and self._check.result()

    def judge(self, unchecked: int, *, told: bool) -> Loss | None:
        """What is lost because it does not hold.

        Args:
            unchecked: stretches with messages that were read and have no checksum of their own.
            told: whether damage in this file has been told already, which is reason enough.
        """
        if unchecked:
            self._begin()
        if self._check is None or (told and not unchecked) or self._check.result():
            return None
        wrong = "the checksum of the data section does not match its bytes"
        if unchecked:
            text = (
                f"{wrong}, and its messages have none of their own: some are damaged, and nobody can tell "
                "which. They were read all the same; any value may be wrong"
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
    """How many stretches with messages were read, and how many of them no checksum covers.

    ``topics`` are those whose definitions nothing covers.
    """

    spans: int = 0
    unchecked: int = 0
    topics: list[str] = field(default_factory=list)

    def describe(self) -> str:
        """What is unchecked, in words; empty when all that was read is covered."""
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
    """Messages that the summary counts and nobody found, where no other loss explains them.

    Args:
        counted: channels with the number of their messages that were found.
        losses: what is known to be lost.
    """
    if losses:
        return []
    return [
        Loss(
            "missing_messages",
            f"the summary counts {info.message_count} messages of {info.topic}, {found} were found",
        )
        for info, found in counted
        if found < info.message_count
    ]
