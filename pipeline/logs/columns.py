"""Columns of messages: numbers, ragged sequences, strings.

A field that is a number in every message is a plain array; a fixed array is ``(n, k)``. Sequences keep
their values end to end with offsets. Strings are codes into the tuple of the distinct ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core.arrays import Floats, Ints

Numbers: TypeAlias = NDArray[np.generic]
Offsets: TypeAlias = Ints

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class Ragged:
    """A sequence a message.

    Attributes:
        values: all values end to end, shape (m,) or (m, k).
        offsets: message i owns ``values[offsets[i]:offsets[i + 1]]``; int64, shape (n + 1,).
    """

    values: Numbers
    offsets: Offsets

    def __len__(self) -> int:
        return self.offsets.size - 1

    def row(self, index: int) -> Numbers:
        """Values of one message."""
        return self.values[self.offsets[index] : self.offsets[index + 1]]

    def fixed(self) -> Numbers | None:
        """The values as (n, k, ...) when every message holds equally many, else None."""
        return _fold_equal_rows(self.values, self.offsets)

    def at(self, position: int) -> Floats:
        """Value number ``position`` of every message, NaN where a message is shorter; shape (n,)."""
        found = np.full(len(self), np.nan)
        there = np.diff(self.offsets) > position
        found[there] = self.values[self.offsets[:-1][there] + position]
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Strings:
    """A string a message.

    Attributes:
        codes: index into ``values``, int32, shape (n,); -1 where the message has none.
        values: the distinct strings.
    """

    codes: NDArray[np.int32]
    values: tuple[str, ...]

    def __len__(self) -> int:
        return self.codes.size

    def to_list(self) -> list[str]:
        """The string of every message; empty where there is none."""
        return [self.values[code] if code >= 0 else "" for code in self.codes.tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class RaggedStrings:
    """A sequence of strings a message.

    Attributes:
        codes: index into ``values``, all messages end to end, int32, shape (m,).
        values: the distinct strings.
        offsets: message i owns ``codes[offsets[i]:offsets[i + 1]]``; int64, shape (n + 1,).
    """

    codes: NDArray[np.int32]
    values: tuple[str, ...]
    offsets: Offsets

    def __len__(self) -> int:
        return self.offsets.size - 1

    def row(self, index: int) -> list[str]:
        """Strings of one message."""
        return [self.values[code] for code in self.codes[self.offsets[index] : self.offsets[index + 1]]]

    def fixed(self) -> NDArray[np.int32] | None:
        """The codes as (n, k) when every message holds equally many, else None."""
        return _fold_equal_rows(self.codes, self.offsets)

    def at(self, position: int) -> Strings:
        """String number ``position`` of every message, code -1 where a message is shorter."""
        found = np.full(len(self), -1, dtype=np.int32)
        there = np.diff(self.offsets) > position
        found[there] = self.codes[self.offsets[:-1][there] + position]
        return Strings(found, self.values)


def _fold_equal_rows(values: NDArray[Scalar], offsets: Ints) -> NDArray[Scalar] | None:
    counts = np.diff(offsets)
    if counts.size == 0 or (counts != counts[0]).any():
        return None
    return values.reshape(counts.size, int(counts[0]), *values.shape[1:])


Column: TypeAlias = Numbers | Ragged | Strings | RaggedStrings
