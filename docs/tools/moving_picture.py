"""Frames in a circle as one animated PNG (https://www.w3.org/TR/png-3), as small as a page needs it to be.

The frames share 255 colours, and each holds only what is new in it: four screens take as much as one does in
the browser's own PNG.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Pixels = NDArray[np.uint8]

MOST_COLOURS = 255
"""One less than a byte tells apart: the first stands for what the frame before shows."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEAD = ">IIBBBBB"
_RGB = (8, 2, 0, 0, 0)
"""Bits of a channel, red, green and blue, and the one way to compress, filter and order that is read."""
_PALETTE = (8, 3, 0, 0, 0)
_CHANNELS = 3


def join_frames(pictures: Sequence[bytes], frame_ms: int) -> bytes:
    """An animated PNG of PNGs of one size.

    Args:
        pictures: the frames, shown in a circle.
        frame_ms: how long each is shown [ms].

    Raises:
        ValueError: the frames are of different sizes, or not of 8 bits each of red, green and blue.
    """
    frames = [read_pixels(picture) for picture in pictures]
    if len({frame.shape for frame in frames}) > 1:
        raise ValueError("the frames are of different sizes")
    colours, shown = share_colours(np.stack(frames))
    height, width = shown.shape[1:]
    joined = [
        _SIGNATURE,
        _make_chunk(b"IHDR", struct.pack(_HEAD, width, height, *_PALETTE)),
        _make_chunk(b"acTL", struct.pack(">II", len(frames), 0)),
        _make_chunk(b"PLTE", bytes(_CHANNELS) + colours.tobytes()),
        _make_chunk(b"tRNS", b"\0"),
    ]
    numbers = itertools.count()
    for place, frame in enumerate(shown):
        # The frame before stays, and what is not new lets it through.
        new = np.where(frame == shown[place - 1], 0, frame) if place else frame
        rows = np.pad(new, ((0, 0), (1, 0))).astype(np.uint8)
        data = zlib.compress(rows.tobytes(), 9)
        how = (width, height, 0, 0, frame_ms, 1000, 0, int(place > 0))
        joined.append(_make_chunk(b"fcTL", struct.pack(">IIIIIHHBB", next(numbers), *how)))
        if place:
            joined.append(_make_chunk(b"fdAT", struct.pack(">I", next(numbers)) + data))
        else:
            joined.append(_make_chunk(b"IDAT", data))
    return b"".join([*joined, _make_chunk(b"IEND", b"")])


def share_colours(frames: Pixels) -> tuple[Pixels, Pixels]:
    """The colours that frames share, and which of them each pixel has.

    One colour after the other is taken that is missed most: by how far it is off, and by the fourth root of
    how many pixels have it, for the edges of letters are few, and are read.

    Args:
        frames: red, green and blue, shape (frames, height, width, 3).

    Returns:
        The colours, shape (k, 3) with k at most ``MOST_COLOURS``, and their numbers from one on, shape
        (frames, height, width).
    """
    codes = frames.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    found, inverse, count = np.unique(codes, return_inverse=True, return_counts=True)
    colours = np.stack([found >> 16, found >> 8 & 255, found & 255], axis=1)
    taken = [int(count.argmax())]
    nearest = np.zeros(found.size, dtype=np.uint8)
    off = ((colours - colours[taken[0]]) ** 2).sum(axis=1)
    while len(taken) < MOST_COLOURS and off.any():
        taken.append(int((np.sqrt(count) * off).argmax()))
        off_it = ((colours - colours[taken[-1]]) ** 2).sum(axis=1)
        nearest[off_it < off] = len(taken) - 1
        off = np.minimum(off, off_it)
    return colours[taken].astype(np.uint8), (nearest + 1)[inverse.reshape(codes.shape)]


def read_pixels(picture: bytes) -> Pixels:
    """Red, green and blue of a PNG, shape (height, width, 3).

    Raises:
        ValueError: it is a PNG of another kind.
    """
    chunks, at = [], len(_SIGNATURE)
    while at < len(picture):
        (size,) = struct.unpack_from(">I", picture, at)
        chunks.append((picture[at + 4 : at + 8], picture[at + 8 : at + 8 + size]))
        at += size + 12
    width, height, *kind = struct.unpack(_HEAD, next(data for name, data in chunks if name == b"IHDR"))
    if tuple(kind) != _RGB:
        raise ValueError("a frame is not of 8 bits each of red, green and blue")
    content = zlib.decompress(b"".join(data for name, data in chunks if name == b"IDAT"))
    size = width * _CHANNELS
    rows, row = [], bytes(size)
    for start in range(0, height * (size + 1), size + 1):
        row = _restore(_PREDICTIONS[content[start]], content[start + 1 : start + 1 + size], row)
        rows.append(row)
    return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(height, width, _CHANNELS)


def _restore(predict: Callable[[int, int, int], int], row: bytes, above: bytes) -> bytes:
    """A row of which only what a prediction of each byte leaves is known."""
    done, over = bytearray(_CHANNELS), bytes(_CHANNELS) + above
    for place, rest in enumerate(row):
        left, corner, up = done[place], over[place], over[place + _CHANNELS]
        done.append(rest + predict(left, up, corner) & 255)
    return bytes(done[_CHANNELS:])


def _predict_plane(left: int, up: int, corner: int) -> int:
    """Of the three, the one that is nearest to the plane through them."""
    plane = left + up - corner
    return min((left, up, corner), key=lambda one: abs(plane - one))


_PREDICTIONS: tuple[Callable[[int, int, int], int], ...] = (
    lambda _left, _up, _corner: 0,
    lambda left, _up, _corner: left,
    lambda _left, up, _corner: up,
    lambda left, up, _corner: (left + up) // 2,
    _predict_plane,
)
"""What a byte is expected to be from that of the pixel on the left, above, and above that on the left: the
filters of PNG in their order."""


def _make_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
