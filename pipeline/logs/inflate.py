"""From the stored bytes of a chunk to its records, never asking for more memory than is plausible."""

import threading
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import IO, Final

import zstandard

from pipeline.logs.records import Buffer

MAX_CHUNK: Final = 1 << 30
"""Largest chunk that is inflated [bytes]; recorders write 1 to 100 MB."""

_PLAUSIBLE: Final = 256 << 20
_PLAUSIBLE_RATIO: Final = 1000
"""No recording grows by more in chunks larger than `_PLAUSIBLE` bytes: what does was made to fill memory."""

_MAX_RATIO: Final = {"": 1, "zstd": 40_000, "lz4": 260}
"""No block of these formats can grow by more: zstd stores 128 KiB in four bytes, LZ4 255 bytes in one."""

_LZ4_FLAGS: Final = 4
_LZ4_HAS_CHECKSUM: Final = 0x04
"""Bit of the flags behind the magic number of an LZ4 frame."""

_per_thread = threading.local()


class InflateError(ValueError):
    """Stored bytes that do not inflate to what their chunk says."""


@contextmanager
def _naming_damage() -> Iterator[None]:
    try:
        yield
    except InflateError:
        raise
    except (zstandard.ZstdError, OSError, ValueError) as error:
        raise InflateError(str(error)) from None


def inflate(stored: Buffer, compression: str, size: int) -> Buffer:
    """Inflate the records of a chunk.

    Args:
        stored: compressed bytes.
        compression: ``""``, ``"zstd"`` or ``"lz4"``.
        size: bytes that must come out.

    Raises:
        InflateError: another size comes out, or the bytes are damaged, or the size is absurd.
    """
    check_size(len(stored), compression, size)
    if compression == "":
        found: Buffer = stored
    elif size == 0:
        found = b""
    elif compression == "zstd":
        found = _inflate_zstd(stored, size)
    else:
        found = _inflate_lz4(stored, size)
    if len(found) != size:
        raise InflateError(f"{len(found)} bytes came out in place of {size}")
    return found


def check_size(stored: int, compression: str, size: int) -> None:
    """Refuse a size that cannot be true before memory is asked for.

    Raises:
        InflateError: with the reason.
    """
    if compression not in _MAX_RATIO:
        raise InflateError(f"the compression {compression[:20]!r} is not known")
    if size > MAX_CHUNK or size > stored * _MAX_RATIO[compression] + 1024:
        raise InflateError(f"{stored} bytes cannot hold {size}")
    if size > largest_plausible(stored):
        raise InflateError(f"{stored} bytes say they hold {size}, as no recording does")


def largest_plausible(stored: int) -> int:
    """Most bytes that so many stored ones inflate to in any recording."""
    return min(MAX_CHUNK, max(_PLAUSIBLE, stored * _PLAUSIBLE_RATIO))


def inflate_message(stored: bytes) -> Buffer:
    """The content of a message that was compressed alone, as rosbag2 can; of others the bytes themselves.

    Raises:
        InflateError: as ``inflate``.
    """
    if not stored.startswith(zstandard.FRAME_HEADER):
        return stored
    with _naming_damage():
        return inflate(stored, "zstd", max(zstandard.frame_content_size(stored), 0))


def inflate_into(stored: Buffer, compression: str, target: memoryview) -> None:
    """Inflate the records of a chunk to where they shall stand.

    Args:
        stored: compressed bytes.
        compression: ``""``, ``"zstd"`` or ``"lz4"``.
        target: as many bytes as must come out.

    Raises:
        InflateError: as ``inflate``.
    """
    size = len(target)
    check_size(len(stored), compression, size)
    if compression != "zstd" or size == 0:
        target[:] = inflate(stored, compression, size)
        return
    with _naming_damage():
        said = zstandard.frame_content_size(stored)
        if said != size:
            raise InflateError(f"the zstd frame says {said} bytes, its chunk {size}")
        with _zstd().stream_reader(stored) as reader:
            found = reader.readinto(target)
    if found != size:
        raise InflateError(f"{found} bytes came out in place of {size}")


def inflate_start(stored: Buffer, compression: str, size: int) -> Buffer:
    """As much of the first ``size`` bytes as undamaged stored bytes give; never raises for damage."""
    if compression == "":
        return stored[:size]
    found = bytearray()
    with suppress(zstandard.ZstdError, OSError, ValueError), _open_damaged(stored, compression) as reader:
        while len(found) < size and (part := reader.read(min(1 << 12, size - len(found)))):
            found += part
    return bytes(found)


def inflate_prefix(stored: Buffer, compression: str, size: int, needed: int) -> Buffer:
    """Inflate the first ``needed`` bytes of a chunk of ``size`` bytes and leave the rest.

    Raises:
        InflateError: as ``inflate``; damage behind the needed bytes is not seen.
    """
    check_size(len(stored), compression, size)
    if compression == "":
        return stored[:needed]
    if compression != "zstd":
        return inflate(stored, compression, size)[:needed]
    with zstandard.ZstdDecompressor().stream_reader(stored) as reader, _naming_damage():
        found = reader.read(needed)
    if len(found) != needed:
        raise InflateError(f"{len(found)} bytes came out in place of {needed}")
    return found


def checksum(records: Buffer) -> int:
    """CRC-32 as MCAP stores it."""
    return zlib.crc32(records)


def holds_own_checksum(stored: Buffer, compression: str) -> bool:
    """Whether inflating all of these bytes verifies a checksum of the content in the format itself."""
    if compression == "lz4":
        return len(stored) > _LZ4_FLAGS and bool(stored[_LZ4_FLAGS] & _LZ4_HAS_CHECKSUM)
    if compression == "zstd":
        try:
            return bool(zstandard.get_frame_parameters(bytes(stored[:32])).has_checksum)
        except zstandard.ZstdError:
            return False
    return False


def _zstd() -> zstandard.ZstdDecompressor:
    """This thread's decompressor."""
    decompressor: zstandard.ZstdDecompressor | None = getattr(_per_thread, "zstd", None)
    if decompressor is None:
        decompressor = _per_thread.zstd = zstandard.ZstdDecompressor()
    return decompressor


def _inflate_zstd(stored: Buffer, size: int) -> bytes:
    with _naming_damage():
        said = zstandard.frame_content_size(stored)
        if said not in (-1, size):
            raise InflateError(f"the zstd frame says {said} bytes, its chunk {size}")
        return _zstd().decompress(stored, max_output_size=size)


def _inflate_lz4(stored: Buffer, size: int) -> Buffer:
    import pyarrow as pa  # noqa: PLC0415 - heavy, and few logs use lz4

    with _naming_damage():
        return memoryview(pa.Codec("lz4").decompress(stored, decompressed_size=size))


def _open_damaged(stored: Buffer, compression: str) -> AbstractContextManager[IO[bytes]]:
    """A stream that gives what precedes damage before it raises."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(stored)
    import pyarrow as pa  # noqa: PLC0415 - heavy, and few logs use lz4

    stream: AbstractContextManager[IO[bytes]] = pa.input_stream(
        pa.py_buffer(stored), compression=compression, buffer_size=0
    )
    return stream
