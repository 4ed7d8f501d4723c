"""Decoding of rows of serialized messages to columns, by the tree of their type."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Ints
from pipeline.logs.cdr import Cursor, Dialect, MisfitError, Vocabulary
from pipeline.logs.columns import Column, Ragged, RaggedStrings, Strings
from pipeline.logs.schema import NUMBER_TYPES, SEQUENCE, SIZES, Member, Structure

# Decoding of rows of serialized messages to pieces of columns.
#
# Only wanted fields are copied; the others are skipped, but their lengths are checked as well.

_PADDING: Final = 3
"""Maximum padding of a message [bytes]: serializers may pad it to a multiple of four bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Values of one field in some rows.

    Attributes:
        values: one entry per row, or concatenated entries if ``counts`` is given; int32 codes for strings.
        counts: number of entries of each row, int64, or None.
    """

    values: NDArray[np.generic]
    counts: Ints | None = None


Pieces = dict[str, Piece]


@dataclass(frozen=True, slots=True)
class FieldPlan:
    """A structure with its wanted fields marked.

    Attributes:
        structure: the type.
        wanted: for each member: True for a wanted leaf, the plan of a structure, None for a skipped member.
    """

    structure: Structure
    wanted: tuple[FieldPlan | bool | None, ...]


def plan_fields(structure: Structure, paths: set[str], prefix: str = "") -> FieldPlan:
    """Mark the leaf fields of ``structure`` whose full path is in ``paths``."""
    marks: list[FieldPlan | bool | None] = []
    for member in structure.members:
        path = f"{prefix}{member.name}"
        if isinstance(member.element, str):
            marks.append(True if path in paths else None)
            continue
        below = f"{path}{'[]' if member.count is not None else ''}."
        any_below = any(wanted.startswith(below) for wanted in paths)
        marks.append(plan_fields(member.element, paths, below) if any_below else None)
    return FieldPlan(structure, tuple(marks))


@dataclass(slots=True)
class Decoder:
    """Decodes rows of one type in one dialect.

    Attributes:
        plan: the type and its wanted fields.
        exact: whether rows longer than their type, apart from padding, are rejected; always so in XCDR2.
        vocabularies: vocabularies by field path, filled while decoding.
        longer: number of accepted rows that are longer than their type.
    """

    plan: FieldPlan
    exact: bool
    vocabularies: dict[str, Vocabulary] = field(default_factory=dict)
    longer: int = 0

    def decode(self, cursor: Cursor) -> tuple[Pieces, Ints]:
        """Decode all rows that fit.

        Args:
            cursor: cursor at the start of its rows, of which there is at least one.

        Returns:
            The pieces and the indices of their rows, in the cursor's order.
        """
        while cursor.base.size:
            pieces: Pieces = {}
            try:
                self._read(self.plan, cursor, "", pieces)
                longer = cursor.limit - cursor.position > _PADDING
                if self.exact or cursor.dialect.sized:
                    cursor.reject(longer)
            except MisfitError as misfit:
                whole = np.flatnonzero(~np.isin(cursor.rows, misfit.rows))
                cursor = cursor.select(whole)
                cursor.position = 0
            else:
                self.longer += int(longer.sum())
                return pieces, cursor.rows
        return {}, cursor.rows

    def _read(self, plan: FieldPlan, cursor: Cursor, prefix: str, out: Pieces) -> None:
        if not plan.structure.members:
            cursor.skip_numbers("uint8", 1)
        for member, wanted in zip(plan.structure.members, plan.wanted, strict=True):
            path = f"{prefix}{member.name}"
            if isinstance(member.element, Structure):
                below = wanted if isinstance(wanted, FieldPlan) else plan_fields(member.element, set())
                if member.count is None:
                    self._read(below, cursor, f"{path}.", out)
                else:
                    self._read_structures(member, below, cursor, f"{path}[].", out)
            elif member.element == "string":
                self._read_texts(member, cursor, path if wanted else None, out)
            else:
                _read_member(member, member.element, cursor, path if wanted else None, out)

    def _read_texts(self, member: Member, cursor: Cursor, path: str | None, out: Pieces) -> None:
        vocabulary = None if path is None else self.vocabularies.setdefault(path, Vocabulary(path))
        if member.count is None:
            codes = cursor.read_text(vocabulary)
            if codes is not None and path is not None:
                out[path] = Piece(codes)
            return
        codes_of: list[tuple[Ints, NDArray[np.int32]]] = []
        counts = _read_counts(member, cursor, 4)

        def read_one(at: Cursor, chosen: Ints) -> None:
            codes = at.read_text(vocabulary)
            if codes is not None:
                codes_of.append((chosen, codes))

        _visit_elements(cursor, counts, read_one)
        if path is not None:
            out[path] = join_elements(
                [(rows, Piece(codes)) for rows, codes in codes_of], cursor.base.size, np.empty(0, np.int32)
            )

    def _read_structures(
        self, member: Member, plan: FieldPlan, cursor: Cursor, prefix: str, out: Pieces
    ) -> None:
        counts = _read_counts(member, cursor, least_size(plan.structure))
        regular = regular_layout(plan.structure, cursor.dialect)
        if regular is not None:
            self._read_regular(plan, cursor, counts, regular, prefix, out)
            return
        collected: dict[str, list[tuple[Ints, Piece]]] = {}

        def read_one(at: Cursor, chosen: Ints) -> None:
            pieces: Pieces = {}
            self._read(plan, at, prefix, pieces)
            for path, piece in pieces.items():
                collected.setdefault(path, []).append((chosen, piece))

        _visit_elements(cursor, counts, read_one)
        for path, leaf in wanted_leaves(plan, prefix):
            out[path] = join_elements(collected.get(path, []), cursor.base.size, leaf.nothing)

    def _read_regular(
        self, plan: FieldPlan, cursor: Cursor, counts: int | Ints, layout: Regular, prefix: str, out: Pieces
    ) -> None:
        each = np.full(cursor.base.size, counts, dtype=np.int64) if isinstance(counts, int) else counts
        before = cursor.position
        cursor.align(layout.align)
        total = np.where(each > 0, (each - 1) * layout.stride + layout.size, before - cursor.position)
        cursor.require(total)
        if any(mark is not None for mark in plan.wanted):
            first = np.cumsum(each) - each
            number = np.arange(int(each.sum())) - np.repeat(first, each)
            base = np.repeat(cursor.base + cursor.position, each) + number * layout.stride
            rows = np.repeat(cursor.rows, each)
            below: Pieces = {}
            if base.size:
                limit = np.full(base.size, layout.size, dtype=np.int64)
                self._read(plan, Cursor(cursor.data, base, limit, rows, cursor.dialect), prefix, below)
            for path, leaf in wanted_leaves(plan, prefix):
                piece = below.get(path, Piece(leaf.nothing))
                inner = piece.counts
                out[path] = Piece(piece.values, each if inner is None else _sum_groups(inner, each))
        cursor.advance(total)


@dataclass(frozen=True, slots=True)
class Regular:
    """Constant layout of a sequence's elements: alignment of the first, size and distance [bytes]."""

    align: int
    size: int
    stride: int


def regular_layout(structure: Structure, dialect: Dialect) -> Regular | None:
    """Layout of a sequence's elements, None unless it is independent of the position in the message."""
    alignments: list[int] = []
    size = _measure(structure, dialect, 0, alignments)
    if size is None or not alignments or alignments[0] != max(alignments):
        return None
    align = alignments[0]
    return Regular(align, size, -(-size // align) * align)


def _measure(structure: Structure, dialect: Dialect, start: int, alignments: list[int]) -> int | None:
    end: int | None = start if structure.members else start + 1
    for member in structure.members:
        repeats = 1 if member.count is None else member.count
        if repeats == SEQUENCE or (member.count is not None and dialect.sized):
            return None
        if isinstance(member.element, Structure):
            for _ in range(repeats):
                end = None if end is None else _measure(member.element, dialect, end, alignments)
        elif member.element in SIZES:
            align = min(SIZES[member.element], dialect.max_align)
            alignments.append(align)
            end = None if end is None else -(-end // align) * align + repeats * SIZES[member.element]
        else:
            return None
    return end


def least_size(structure: Structure) -> int:
    """Minimum size of a structure without padding [bytes], at least 1."""
    total = 0
    for member in structure.members:
        if member.count == SEQUENCE or member.element in ("string", "wstring"):
            total += 4
            continue
        each = least_size(member.element) if isinstance(member.element, Structure) else SIZES[member.element]
        total += each * (1 if member.count is None else member.count)
    return max(total, 1)


def _read_counts(member: Member, cursor: Cursor, least: int) -> int | Ints:
    if cursor.dialect.sized:
        cursor.read_lengths()
    counts = member.count if member.count not in (None, SEQUENCE) else cursor.read_lengths()
    if counts is None:
        raise AssertionError(member.name)
    cursor.require(counts * least)
    return counts


def _read_member(member: Member, kind: str, cursor: Cursor, path: str | None, out: Pieces) -> None:
    count: int | Ints = 1 if member.count is None else member.count
    if member.count == SEQUENCE:
        count = cursor.read_lengths()
        cursor.require(count * SIZES[kind])
    if path is None:
        cursor.skip_numbers(kind, count)
    elif not isinstance(count, int):
        out[path] = Piece(cursor.read_ragged(kind, count), count)
    else:
        values = cursor.read_numbers(kind, count)
        if member.count is None:
            out[path] = Piece(values[:, 0])
        elif member.count == SEQUENCE:
            out[path] = Piece(values.reshape(-1), np.full(values.shape[0], count, dtype=np.int64))
        else:
            out[path] = Piece(values)


def _visit_elements(cursor: Cursor, counts: int | Ints, read_one: Callable[[Cursor, Ints], None]) -> None:
    if isinstance(counts, int):
        everyone = np.arange(cursor.base.size)
        for _ in range(counts):
            read_one(cursor, everyone)
        return
    for number in range(int(counts.max())):
        chosen = np.flatnonzero(counts > number)
        at = cursor.select(chosen)
        read_one(at, chosen)
        position = np.full(cursor.base.size, cursor.position, dtype=np.int64)
        position[chosen] = at.position
        cursor.position = position
    cursor.advance(0)


def join_elements(pieces: list[tuple[Ints, Piece]], rows: int, nothing: NDArray[np.generic]) -> Piece:
    """Sort elements by row that were read by element index.

    Args:
        pieces: for each element index, the rows that have this element, and its values.
        rows: number of rows.
        nothing: an empty array of the values' type and width.
    """
    if not pieces:
        return Piece(nothing, np.zeros(rows, dtype=np.int64))
    owner = np.concatenate([chosen for chosen, _ in pieces])
    values = np.concatenate([piece.values for _, piece in pieces])
    order = np.argsort(owner, kind="stable")
    if pieces[0][1].counts is None:
        return Piece(values[order], np.bincount(owner, minlength=rows))
    inner = np.concatenate([piece.counts for _, piece in pieces if piece.counts is not None])
    total = np.bincount(owner, weights=inner, minlength=rows).astype(np.int64)
    return Piece(take_ragged(values, inner, order), total)


def take_ragged(values: NDArray[np.generic], counts: Ints, order: Ints) -> NDArray[np.generic]:
    """Values of ragged rows, reordered by row."""
    start = np.cumsum(counts) - counts
    taken = counts[order]
    first = np.cumsum(taken) - taken
    return values[np.repeat(start[order] - first, taken) + np.arange(int(taken.sum()))]


@dataclass(frozen=True, slots=True, eq=False)
class Leaf:
    """A wanted leaf field.

    Attributes:
        nothing: an empty array of its type and width.
        ragged: whether the number of values varies between rows.
        text: whether its values are strings.
    """

    nothing: NDArray[np.generic]
    ragged: bool
    text: bool


def wanted_leaves(plan: FieldPlan, prefix: str = "", *, inside: bool = False) -> Iterator[tuple[str, Leaf]]:
    """All wanted leaves with their paths.

    Args:
        plan: the type and its wanted fields.
        prefix: prefix of all paths.
        inside: whether the plan is that of a sequence's elements.
    """
    for member, mark in zip(plan.structure.members, plan.wanted, strict=True):
        path = f"{prefix}{member.name}"
        several = member.count is not None
        if isinstance(mark, FieldPlan):
            below = f"{path}{'[]' if several else ''}."
            yield from wanted_leaves(mark, below, inside=inside or several)
        elif mark and isinstance(member.element, str):
            text = member.element == "string"
            fixed = member.count if member.count != SEQUENCE and not text else None
            shape = (0,) if fixed is None else (0, fixed)
            kind = np.dtype(np.int32) if text else NUMBER_TYPES[member.element]
            ragged = inside or member.count == SEQUENCE or (text and several)
            yield path, Leaf(np.empty(shape, dtype=kind), ragged, text)


def _sum_groups(values: Ints, sizes: Ints) -> Ints:
    ends = np.r_[0, np.cumsum(values)]
    last = np.cumsum(sizes)
    total: Ints = ends[last] - ends[last - sizes]
    return total


def join_pieces(leaf: Leaf, pieces: Sequence[Piece], order: Ints, vocabulary: Vocabulary | None) -> Column:
    """Column of some rows.

    Args:
        leaf: the field.
        pieces: its values, in the order in which they were decoded.
        order: indices of the rows among those of the pieces.
        vocabulary: vocabulary of a string field, else None.
    """
    values: NDArray[Any] = np.concatenate([leaf.nothing, *(piece.values for piece in pieces)])
    texts = () if vocabulary is None else vocabulary.texts()
    if not leaf.ragged:
        values = values if _is_plain(order, values.shape[0]) else values[order]
        return Strings(values, texts) if leaf.text else values
    counts = [piece.counts for piece in pieces if piece.counts is not None]
    values, offsets = take_rows(values, np.concatenate([np.empty(0, dtype=np.int64), *counts]), order)
    return RaggedStrings(values, texts, offsets) if leaf.text else Ragged(values, offsets)


def take_rows(values: NDArray[Any], counts: Ints, order: Ints) -> tuple[NDArray[Any], Ints]:
    """Values of ragged rows, reordered by row, and their offsets."""
    if not _is_plain(order, counts.size):
        values = take_ragged(values, counts, order)
    return values, np.append(0, np.cumsum(counts[order]))


def _is_plain(order: Ints, size: int) -> bool:
    return order.size == size and bool((order == np.arange(size)).all())
