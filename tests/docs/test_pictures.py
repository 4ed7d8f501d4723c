"""The moving picture: frames of one size, in order, each with a checksum that holds."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import pytest
from pictures import STEPS, join_frames

FALLING = Path(__file__).parents[2] / "docs" / "pages" / "pictures" / "falling.png"
SIGNATURE = b"\x89PNG\r\n\x1a\n"
MOST_BYTES = 1_500_000


def pack(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def draw_grey(shade: int, width: int = 3) -> bytes:
    rows = bytes([0, *[shade] * width]) * 2
    head = struct.pack(">IIBBBBB", width, 2, 8, 0, 0, 0, 0)
    return SIGNATURE + pack(b"IHDR", head) + pack(b"IDAT", zlib.compress(rows)) + pack(b"IEND", b"")


def read(picture: bytes) -> list[tuple[bytes, bytes]]:
    assert picture.startswith(SIGNATURE)
    chunks, rest = [], picture[len(SIGNATURE) :]
    while rest:
        (size,) = struct.unpack_from(">I", rest)
        kind, data = rest[4:8], rest[8 : 8 + size]
        assert struct.unpack_from(">I", rest, 8 + size) == (zlib.crc32(kind + data),)
        chunks.append((kind, data))
        rest = rest[12 + size :]
    return chunks


def test_frames_follow_each_other_and_are_numbered_through() -> None:
    chunks = read(join_frames([draw_grey(shade) for shade in (10, 20, 30)], 500))
    kinds = [kind for kind, _ in chunks]
    assert kinds == [b"IHDR", b"acTL", b"fcTL", b"IDAT", b"fcTL", b"fdAT", b"fcTL", b"fdAT", b"IEND"]
    numbers = [struct.unpack_from(">I", data)[0] for kind, data in chunks if kind in {b"fcTL", b"fdAT"}]
    assert numbers == list(range(5))
    shades = [zlib.decompress(data[4:])[1] for kind, data in chunks if kind == b"fdAT"]
    assert shades == [20, 30]


def test_frames_of_several_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        join_frames([draw_grey(1), draw_grey(1, width=4)], 500)


def test_the_moving_picture_shows_each_effect_and_is_small() -> None:
    picture = FALLING.read_bytes()
    assert len(picture) < MOST_BYTES
    assert [kind for kind, _ in read(picture)].count(b"fcTL") == STEPS + 1
