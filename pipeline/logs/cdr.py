"""Reading CDR of many messages at once, with one cursor for all rows.

All rows are messages of one type. While their layouts agree, the cursor's position is one number and a field
of all rows is one strided copy; once a length differs between rows, the position is an array and a field is
one gather. Every read is first checked against the end of its row: rows that do not fit are reported, and no
row is read beyond its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.core import Flags, Ints
from pipeline.logs.records import Buffer, LogError
from pipeline.logs.schema import NUMBER_TYPES, SIZES


@dataclass(frozen=True, slots=True)
class Dialect:
    """Layout of numbers and sequences.

    Attributes:
        order: ``"<"`` or ``">"``, the byte order.
        max_align: maximum alignment; numbers align to their size. 8 in XCDR1, 4 in XCDR2, 1 in ROS 1.
        header: bytes before the first field, which do not count for the alignment.
        terminated: whether strings end in a null byte, which their length includes.
        sized: whether sequences other than of numbers start with their size in bytes (XCDR2).
    """

    order: Literal["<", ">"]
    max_align: int
    header: int
    terminated: bool
    sized: bool


DIALECTS: Final[dict[int, Dialect]] = {
    0x0000: Dialect(">", 8, 4, terminated=True, sized=False),
    0x0001: Dialect("<", 8, 4, terminated=True, sized=False),
    0x0006: Dialect(">", 4, 4, terminated=True, sized=True),
    0x0007: Dialect("<", 4, 4, terminated=True, sized=True),
    0x0010: Dialect(">", 4, 4, terminated=True, sized=True),
    0x0011: Dialect("<", 4, 4, terminated=True, sized=True),
}
"""Decoded plain CDR encapsulations, by identifier (RTPS 2.5, section 10.2.1.2; XTypes 1.2)."""

OTHER_ENCAPSULATIONS: Final[dict[int, str]] = {
    0x0002: "PL_CDR_BE",
    0x0003: "PL_CDR_LE",
    0x0004: "XML",
    0x0008: "D_CDR2_BE",
    0x0009: "D_CDR2_LE",
    0x000A: "PL_CDR2_BE",
    0x000B: "PL_CDR2_LE",
    0x0012: "PL_CDR2_BE",
    0x0013: "PL_CDR2_LE",
    0x0014: "D_CDR2_BE",
    0x0015: "D_CDR2_LE",
}
"""Encapsulations that are reported by name but not decoded."""

ROS1: Final = Dialect("<", 1, 0, terminated=False, sized=False)


class MisfitError(Exception):
    """Some rows do not match their type.

    Attributes:
        rows: indices of these rows.
    """

    def __init__(self, rows: Ints) -> None:
        super().__init__(f"{rows.size} rows do not fit their type")
        self.rows = rows


MAX_TEXT: Final = 1 << 16
"""Maximum length of a string [bytes], longer ones are cut; frame ids, joint names and states have tens."""

MAX_TEXTS: Final = 256 << 20
"""Maximum total size of the distinct strings of one field [bytes]."""

_LONG_TEXT: Final = 1 << 10
"""Minimum length of strings [bytes] that are compared one by one instead of as an array."""


class Vocabulary:
    """The distinct strings of a field, in order of first appearance.

    Args:
        path: the field, for messages.

    Attributes:
        shortened: number of strings longer than ``MAX_TEXT``, which were cut there.
    """

    def __init__(self, path: str = "") -> None:
        self._path = path
        self._codes: dict[bytes, int] = {}
        self._size = 0
        self.shortened = 0

    def code(self, text: Buffer) -> int:
        """Code of a string; a string that is not yet in the vocabulary gets a new one.

        Raises:
            LogError: ``too_many_strings``.
        """
        key = bytes(text[:MAX_TEXT])
        if len(text) > MAX_TEXT:
            self.shortened += 1
            key += b" (cut, of %d bytes)" % len(text)
        number = self._codes.get(key)
        if number is None:
            number = self._codes[key] = len(self._codes)
            self._size += len(key)
            if self._size > MAX_TEXTS:
                raise LogError(
                    "too_many_strings",
                    f"the distinct strings of {self._path} take more than {MAX_TEXTS >> 20} MiB",
                    hint="Leave the topic out",
                )
        return number

    def texts(self) -> tuple[str, ...]:
        """The strings by code; bytes that are not UTF-8 become replacement characters."""
        return tuple(text.decode("utf-8", "replace") for text in self._codes)


@dataclass(slots=True)
class Cursor:
    """A position in each of n rows.

    Attributes:
        data: buffer of all rows, uint8, shape (m,).
        base: where each row's alignment starts, int64, shape (n,).
        limit: length of each row from its base [bytes], int64, shape (n,).
        rows: index of each row, reported if it does not fit, int64, shape (n,).
        dialect: layout of the rows.
        position: offset from the base [bytes]; one number, or int64 of shape (n,).
    """

    data: NDArray[np.uint8]
    base: Ints
    limit: Ints
    rows: Ints
    dialect: Dialect
    position: int | Ints = 0

    def select(self, chosen: Ints) -> Cursor:
        """Cursor for some of the rows."""
        position = self.position if isinstance(self.position, int) else self.position[chosen]
        return Cursor(
            self.data, self.base[chosen], self.limit[chosen], self.rows[chosen], self.dialect, position
        )

    def align(self, size: int) -> None:
        """Step to the next multiple of ``size`` or of the dialect's maximum alignment, if that is less."""
        step = min(size, self.dialect.max_align)
        self.position = (self.position + step - 1) // step * step if step > 1 else self.position

    def require(self, size: int | Ints) -> None:
        """Check that every row has ``size`` more bytes.

        Raises:
            MisfitError: with the rows that do not.
        """
        self.reject(self.position + size > self.limit)

    def reject(self, wrong: Flags) -> None:
        """Report the rows where ``wrong`` is true.

        Raises:
            MisfitError: if there are any.
        """
        if wrong.any():
            raise MisfitError(np.unique(self.rows[wrong]))

    def advance(self, size: int | Ints) -> None:
        """Step over ``size`` bytes that were checked with ``require``."""
        position = self.position + size
        if not isinstance(position, int) and (position == position[0]).all():
            position = int(position[0])
        self.position = position

    def read_numbers(self, kind: str, count: int) -> NDArray[np.generic]:
        """The next ``count`` numbers of every row, shape (n, count)."""
        size = SIZES[kind]
        if count == 0:
            return np.empty((self.base.size, 0), dtype=NUMBER_TYPES[kind])
        self.align(size)
        self.require(size * count)
        values = self._gather(self._stored_type(kind), count, self.base + self.position)
        self.advance(size * count)
        return values.astype(np.bool_) if kind == "bool" else values

    def read_lengths(self) -> int | Ints:
        """The next length prefix (u32) of every row; one number if all rows have the same."""
        lengths = self.read_numbers("uint32", 1)[:, 0].astype(np.int64)
        first = int(lengths[0])
        return first if (lengths == first).all() else lengths

    def read_ragged(self, kind: str, counts: Ints) -> NDArray[np.generic]:
        """The next ``counts[i]`` numbers of row i, concatenated over the rows."""
        size = SIZES[kind]
        before = self.position
        self.align(size)
        self.require(np.where(counts > 0, counts * size, before - self.position))
        start = np.repeat(self.base + self.position, counts)
        first = np.cumsum(counts) - counts
        position = start + (np.arange(start.size) - np.repeat(first, counts)) * size
        values = self._gather(self._stored_type(kind), 1, position)[:, 0]
        self.position = np.where(counts > 0, self.position + counts * size, before)
        self.advance(0)
        return values.astype(np.bool_) if kind == "bool" else values

    def skip_numbers(self, kind: str, count: int | Ints) -> None:
        """Step over numbers."""
        size = SIZES[kind]
        before = self.position
        self.align(size)
        if isinstance(count, int):
            if count == 0:
                self.position = before
                return
            self.require(count * size)
            self.advance(count * size)
            return
        taken = np.where(count > 0, self.position + count * size, before)
        self.reject(taken > self.limit)
        self.position = taken
        self.advance(0)

    def read_text(self, vocabulary: Vocabulary | None) -> NDArray[np.int32] | None:
        """Codes of the next string of every row, shape (n,); without a vocabulary it is only skipped."""
        lengths = self.read_lengths()
        self.require(lengths)
        tail = 1 if self.dialect.terminated else 0
        if tail:
            self._check_terminators(lengths)
        codes = None
        if vocabulary is not None:
            if isinstance(lengths, int):
                codes = self._code_equal(max(lengths - tail, 0), vocabulary)
            else:
                codes = self._code_unequal(np.maximum(lengths - tail, 0), vocabulary)
        self.advance(lengths)
        return codes

    def _check_terminators(self, lengths: int | Ints) -> None:
        last = self.base + self.position + lengths - 1
        self.reject((lengths > np.zeros_like(last)) & (self.data[last] != 0))

    def _code_equal(self, length: int, vocabulary: Vocabulary) -> NDArray[np.int32]:
        if length == 0:
            return np.full(self.base.size, vocabulary.code(b""), dtype=np.int32)
        if length >= _LONG_TEXT:
            return self._code_unequal(np.full(self.base.size, length, dtype=np.int64), vocabulary)
        texts = self._gather(np.dtype("u1"), length, self.base + self.position)
        starts = np.flatnonzero(np.r_[True, (texts[1:] != texts[:-1]).any(axis=1)])
        codes = [vocabulary.code(texts[start].tobytes()) for start in starts.tolist()]
        runs = np.diff(np.r_[starts, texts.shape[0]])
        return np.repeat(np.array(codes, dtype=np.int32), runs)

    def _code_unequal(self, lengths: Ints, vocabulary: Vocabulary) -> NDArray[np.int32]:
        starts = (self.base + self.position).tolist()
        view = self.data.data
        codes = [
            vocabulary.code(view[start : start + length])
            for start, length in zip(starts, lengths.tolist(), strict=True)
        ]
        return np.array(codes, dtype=np.int32)

    def _stored_type(self, kind: str) -> np.dtype[np.generic]:
        return NUMBER_TYPES["uint8" if kind == "bool" else kind].newbyteorder(self.dialect.order)

    def _gather(self, dtype: np.dtype[np.generic], count: int, position: Ints) -> NDArray[np.generic]:
        size = dtype.itemsize * count
        if position.size == 0:
            return np.empty((0, count), dtype=dtype.newbyteorder("="))
        window: NDArray[np.void] = np.ndarray(
            (self.data.size - size + 1,), dtype=f"V{size}", buffer=self.data.data, strides=(1,)
        )
        gathered = window[position].view(dtype).reshape(position.size, count)
        return gathered.astype(dtype.newbyteorder("="), copy=False)
