"""The moving picture: frames of one size, in order, as they were drawn, each with a checksum that holds."""

import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from moving_picture import join_frames
from pictures import STEPS

pytestmark = pytest.mark.lint

FALLING = Path(__file__).parents[2] / "docs" / "pages" / "pictures" / "falling.png"
SIGNATURE = b"\x89PNG\r\n\x1a\n"
MOST_BYTES = 300_000


def pack(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def draw(pixels: np.ndarray, filters: tuple[int, ...] = (0,), kind: int = 2) -> bytes:
    """A PNG of pixels; its rows have the filters in turn."""
    height, width, _ = pixels.shape
    known = np.zeros((height + 1, width + 1, 3), dtype=int)
    known[1:, 1:] = pixels
    left, up, corner = known[1:, :-1], known[:-1, 1:], known[:-1, :-1]
    plane = left + up - corner
    to_left, to_up, to_corner = (abs(plane - one) for one in (left, up, corner))
    nearest = np.where(to_up <= to_corner, up, corner)
    nearest = np.where((to_left <= to_up) & (to_left <= to_corner), left, nearest)
    expected = (np.zeros_like(left), left, up, (left + up) // 2, nearest)
    rows = b""
    for row in range(height):
        one = filters[row % len(filters)]
        rows += bytes([one]) + ((pixels[row] - expected[one][row]) % 256).astype(np.uint8).tobytes()
    head = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    return SIGNATURE + pack(b"IHDR", head) + pack(b"IDAT", zlib.compress(rows)) + pack(b"IEND", b"")


def draw_grey(shade: int, width: int = 3) -> bytes:
    return draw(np.full((2, width, 3), shade))


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


def show(picture: bytes) -> list[np.ndarray]:
    """What is seen while each frame is shown."""
    chunks = read(picture)
    told = dict(chunks)
    width, height = struct.unpack_from(">II", told[b"IHDR"])
    palette = np.frombuffer(told[b"PLTE"], dtype=np.uint8).reshape(-1, 3)
    seen = [np.zeros((height, width, 3), dtype=np.uint8)]
    for kind, data in chunks:
        if kind in {b"IDAT", b"fdAT"}:
            rows = zlib.decompress(data[4:] if kind == b"fdAT" else data)
            given = np.frombuffer(rows, dtype=np.uint8).reshape(height, width + 1)
            assert not given[:, 0].any()
            lets_through = (given[:, 1:] < len(told[b"tRNS"]))[..., None]
            seen.append(np.where(lets_through, seen[-1], palette[given[:, 1:]]))
    return seen[1:]


def test_frames_follow_each_other_and_are_numbered_through() -> None:
    joined = join_frames([draw_grey(shade) for shade in (10, 20, 30)], 500)
    chunks = read(joined)
    kinds = [kind for kind, _ in chunks]
    head, frames = kinds[:4], kinds[4:]
    assert head == [b"IHDR", b"acTL", b"PLTE", b"tRNS"]
    assert frames == [b"fcTL", b"IDAT", b"fcTL", b"fdAT", b"fcTL", b"fdAT", b"IEND"]
    numbers = [struct.unpack_from(">I", data)[0] for kind, data in chunks if kind in {b"fcTL", b"fdAT"}]
    assert numbers == list(range(5))
    assert [frame[0, 0, 0] for frame in show(joined)] == [10, 20, 30]
    # The first of a circle hides the last; each other one is laid over what is seen.
    assert [data[-1] for kind, data in chunks if kind == b"fcTL"] == [0, 1, 1]


def test_frames_of_several_sizes_or_of_another_kind_are_refused() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        join_frames([draw_grey(1), draw_grey(1, width=4)], 500)
    with pytest.raises(ValueError, match="red, green and blue"):
        join_frames([draw(np.zeros((2, 3, 3)), kind=6)], 500)


def test_the_moving_picture_shows_each_effect_and_is_small() -> None:
    picture = FALLING.read_bytes()
    assert len(picture) < MOST_BYTES
    frames = show(picture)
    assert len(frames) == STEPS + 1
    assert all((one != other).any() for one, other in pairwise(frames))
