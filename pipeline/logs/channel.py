"""Turning the payloads of one channel into columns, whatever they are encoded in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from pipeline.core.arrays import Flags, Ints
from pipeline.logs.assemble import ColumnParts
from pipeline.logs.cdr import DIALECTS, OTHER_ENCAPSULATIONS, ROS1, Cursor, Dialect
from pipeline.logs.decode import Decoder, plan_fields, wanted_leaves
from pipeline.logs.payloads import Block, Group, Payloads, join_groups

if TYPE_CHECKING:
    from pipeline.logs.columns import Column
    from pipeline.logs.objects import ObjectDecoder
    from pipeline.logs.schema import Structure


_ENOUGH: Final = 4 << 20
"""Payload bytes that are collected before they are decoded together."""

_ENCAPSULATION: Final = 4


@dataclass(frozen=True, slots=True)
class Rejected:
    """Messages that could not be decoded.

    Attributes:
        kind: ``undecodable`` or ``unsupported_encoding``.
        reason: why.
        rows: their numbers in the channel, int64.
        bytes: bytes of their payloads.
    """

    kind: str
    reason: str
    rows: Ints
    bytes: int


class StructuredDecoder:
    """Decodes CDR and ROS 1 payloads through the type's tree.

    Args:
        structure: the type.
        paths: wanted leaf fields.
        encoding: ``"cdr"`` or ``"ros1"``.
        expected: how many messages the index promises.
        exact: whether messages that are longer than the type are refused, because the type is a guess.
    """

    def __init__(
        self, structure: Structure, paths: set[str], encoding: str, expected: int, *, exact: bool = False
    ) -> None:
        self._plan = plan_fields(structure, paths)
        self._ros1 = encoding == "ros1"
        self._decoder = Decoder(self._plan, exact)
        self._parts = {path: ColumnParts(leaf, expected) for path, leaf in wanted_leaves(self._plan)}
        self._ids: list[Ints] = []
        self.rejected: list[Rejected] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """What is worth knowing of what was decoded."""
        longer = self._decoder.longer
        return (f"{longer} messages hold more bytes than their type describes",) if longer else ()

    @property
    def shortened(self) -> dict[str, int]:
        """Fields with strings that were too long and were cut, and how many."""
        vocabularies = self._decoder.vocabularies
        return {path: words.shortened for path, words in vocabularies.items() if words.shortened}

    def decode(self, ids: Ints, block: Block) -> None:
        """Decode a block; ``ids`` are the numbers of its rows in the channel."""
        if self._ros1:
            self._decode_alike(ids, block, ROS1, np.arange(ids.size))
            return
        short = block.size < _ENCAPSULATION
        if short.any():
            self._reject("undecodable", "shorter than an encapsulation header", ids, block, short)
        kinds = np.full(ids.size, -1, dtype=np.int64)
        whole = np.flatnonzero(~short)
        kinds[whole] = (
            block.data[block.start[whole]].astype(np.int64) << 8 | block.data[block.start[whole] + 1]
        )
        for kind in np.unique(kinds[whole]).tolist():
            chosen = kinds == kind
            if kind in DIALECTS:
                self._decode_alike(ids, block, DIALECTS[kind], np.flatnonzero(chosen))
            elif kind in OTHER_ENCAPSULATIONS:
                reason = f"the encapsulation {OTHER_ENCAPSULATIONS[kind]} is not supported"
                self._reject("unsupported_encoding", reason, ids, block, chosen)
            else:
                self._reject("undecodable", f"0x{kind:04x} is no encapsulation", ids, block, chosen)

    def _decode_alike(self, ids: Ints, block: Block, dialect: Dialect, chosen: Ints) -> None:
        base, limit = block.start + dialect.header, block.size - dialect.header
        stride = block.stride
        if chosen.size < ids.size:
            base, limit, stride = base[chosen], limit[chosen], None
        pieces, kept = self._decoder.decode(Cursor(block.data, base, limit, chosen, stride, dialect))
        self._ids.append(ids[kept])
        for path, piece in pieces.items():
            self._parts[path].add(piece)
        if kept.size < chosen.size:
            missing = np.ones(ids.size, dtype=np.bool_)
            missing[kept] = False
            missing &= np.isin(np.arange(ids.size), chosen)
            self._reject("undecodable", "the payload does not fit its type", ids, block, missing)

    def _reject(self, kind: str, reason: str, ids: Ints, block: Block, wrong: Flags) -> None:
        self.rejected.append(Rejected(kind, reason, ids[wrong], int(block.size[wrong].sum())))

    def columns(self, rows: Ints) -> dict[str, Column]:
        """Columns of the given rows, in their order; to be asked once."""
        ids = np.concatenate([np.empty(0, dtype=np.int64), *self._ids])
        place = np.empty(int(ids.max(initial=-1)) + 1, dtype=np.int64)
        place[ids] = np.arange(ids.size)
        order = place[rows]
        vocabularies = self._decoder.vocabularies
        return {path: part.take_column(order, vocabularies.get(path)) for path, part in self._parts.items()}


@dataclass(slots=True)
class ChannelBuffer:
    """Collects the payloads of one channel and has them decoded a few megabytes at a time.

    Attributes:
        decoder: does the decoding.
        count: messages so far.
    """

    decoder: StructuredDecoder | ObjectDecoder
    _log: list[Ints] = field(default_factory=list)
    _publish: list[Ints] = field(default_factory=list)
    _pending: list[tuple[int, Group]] = field(default_factory=list)
    _pending_bytes: int = 0
    count: int = 0

    def add(self, payloads: Payloads) -> None:
        """Take the messages of the next span."""
        self._log.append(payloads.log_time)
        self._publish.append(payloads.publish_time)
        for group in payloads.groups:
            self._pending.append((self.count, group))
            self._pending_bytes += group.data.size
        self.count += payloads.log_time.size
        if self._pending_bytes > _ENOUGH:
            self._flush()

    def _flush(self) -> None:
        for ids, block in join_groups(self._pending):
            self.decoder.decode(ids, block)
        self._pending = []
        self._pending_bytes = 0

    def times(self) -> tuple[Ints, Ints]:
        """Log and publish times [ns] of all messages in the order of the file."""
        empty = np.empty(0, dtype=np.int64)
        return np.concatenate([empty, *self._log]), np.concatenate([empty, *self._publish])

    def finish(self, repeated: Ints) -> tuple[Ints, Ints, Ints]:
        """Decode what is left: log and publish times [ns] and numbers of the good rows, by log time.

        Args:
            repeated: numbers of the messages that are left out because they stand there before.
        """
        self._flush()
        log, publish = self.times()
        good = np.ones(log.size, dtype=np.bool_)
        good[repeated] = False
        for rejected in self.decoder.rejected:
            good[rejected.rows] = False
        rows = np.flatnonzero(good)
        order = rows[np.argsort(log[rows], kind="stable")]
        return log[order], publish[order], order

    def times_of(self, rows: Ints) -> tuple[int | None, int | None]:
        """First and last log time [ns] of some rows."""
        if not rows.size:
            return None, None
        log = np.concatenate(self._log)[rows]
        return int(log.min()), int(log.max())
