"""A recording written while messages arrive: a folder of MCAP files, like a split rosbag2 recording."""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final

from mcap.writer import CompressionType, Writer

from pipeline.core.program import naming_os_errors
from pipeline.logs.index import LISTING, LogIndex, list_files, open_log
from pipeline.logs.live_protocol import LiveChannel
from pipeline.logs.records import LogError
from pipeline.logs.writer import LIBRARY

_CHUNK_S: Final = 1.0
"""Maximum time of a message in memory [s]: the loss of a killed program, and the delay of a watch."""
_CHUNK_BYTES: Final = 1 << 20


class _Writer(Writer):
    """An MCAP writer that can end a chunk before it is full."""

    def end_chunk(self) -> None:
        """Write the messages so far as a chunk.

        The called method is private to the base class. Its mangled name is the same here, because mangling
        drops the leading underscore of a class name.
        """
        self.__finalize_chunk()  # type: ignore[no-untyped-call]


@dataclass
class _Part:
    """One file that is being written.

    Attributes:
        stream: the file.
        writer: MCAP writer of the file.
        numbers: channel numbers in the file.
        start_s: start of the current chunk [s of `time.monotonic`].
        waiting: number of messages in that chunk.
    """

    stream: BinaryIO
    writer: _Writer
    numbers: dict[LiveChannel, int] = field(default_factory=dict)
    start_s: float = field(default_factory=time.monotonic)
    waiting: int = 0


def lock_folder(folder: Path) -> int | None:
    """Lock a folder for one writer; returns the file descriptor of the lock, None if it is already locked.

    Raises:
        OSError: the folder cannot be opened, or its file system has no locks.
    """
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(number)
        return None
    except OSError:
        os.close(number)
        raise
    return number


class LiveRecording:
    """Writes messages to a folder of MCAP files, one per connection to a server.

    A file grows at least every `_CHUNK_S`, so that a reader can follow it. Files of a killed program stay
    unchanged in the folder; the next file continues the recording.

    Args:
        folder: created if it does not exist.

    Raises:
        LogError: ``recording_unwritable``; ``recording_ended``, the folder has a finished recording;
            ``recording_in_use``, another program writes to it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.message_count = 0
        self._part: _Part | None = None
        if (folder / LISTING).exists():
            hint = "Name another folder with --record"
            raise LogError("recording_ended", "this recording has ended", where=str(folder), hint=hint)
        with self._naming_os_errors():
            folder.mkdir(parents=True, exist_ok=True)
            lock = lock_folder(folder)
        if lock is None:
            hint = "End the other watch, or name another folder with --record"
            raise LogError("recording_in_use", "another watch writes there", where=str(folder), hint=hint)
        # The lock is held until this process ends, even if it is killed.
        self._lock = lock

    def _naming_os_errors(self) -> AbstractContextManager[None]:
        what = "the recording cannot be written"
        hint = "Check the folder, its permissions and the space on the disk; what was written before is kept"
        return naming_os_errors(LogError, "recording_unwritable", what, where=self.folder, hint=hint)

    def write(self, channel: LiveChannel, log_time: int, data: bytes) -> None:
        """Add a message.

        Args:
            channel: channel of the message.
            log_time: [ns].
            data: payload as sent by the server.

        Raises:
            LogError: ``recording_unwritable``.
        """
        with self._naming_os_errors():
            part = self._part = self._part or self._begin_part()
            number = part.numbers.get(channel)
            if number is None:
                kind = part.writer.register_schema(channel.type_name, channel.schema_encoding, channel.schema)
                number = part.writer.register_channel(channel.topic, channel.encoding, kind)
                part.numbers[channel] = number
            part.writer.add_message(number, log_time, data, log_time)
        part.waiting += 1
        self.message_count += 1
        self.flush()

    def _begin_part(self) -> _Part:
        name = self.folder.resolve().name
        count = len(list_files(self.folder))
        stream = (self.folder / f"{name}_{count}.mcap").open("xb")
        writer = _Writer(
            stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        writer.start(profile="ros2", library=LIBRARY)
        return _Part(stream, writer)

    def flush(self) -> None:
        """Write the current chunk if it is at least `_CHUNK_S` old.

        Raises:
            LogError: ``recording_unwritable``.
        """
        part = self._part
        if part is None or not part.waiting or time.monotonic() - part.start_s < _CHUNK_S:
            return
        with self._naming_os_errors():
            part.writer.end_chunk()
            part.stream.flush()
        part.start_s, part.waiting = time.monotonic(), 0

    def end_part(self) -> None:
        """Finish the current file; the next message starts another.

        Raises:
            LogError: ``recording_unwritable``.
        """
        part, self._part = self._part, None
        if part is None:
            return
        with self._naming_os_errors(), part.stream:
            part.writer.finish()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Finish the recording; a folder without messages is removed.

        Raises:
            LogError: ``recording_unwritable``.
        """
        self.end_part()
        if not list_files(self.folder):
            self.abandon()
            return
        listing = _spell_listing(open_log(self.folder), list_files(self.folder))
        with self._naming_os_errors():
            (self.folder / LISTING).write_text(listing, encoding="utf-8")

    def abandon(self) -> None:
        """Remove the folder if it is empty."""
        with suppress(OSError):
            self.folder.rmdir()


def _spell_listing(index: LogIndex, files: list[Path]) -> str:
    """Text of the rosbag2 metadata file, version 4, as `ros2 bag play` requires it."""
    import yaml  # noqa: PLC0415 - once, at the end

    topics = [
        {
            "topic_metadata": {
                "name": channel.topic,
                "type": channel.type_name,
                "serialization_format": channel.message_encoding,
                "offered_qos_profiles": "",
            },
            "message_count": channel.message_count,
        }
        for channel in index.channels
    ]
    about = {
        "version": 4,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files],
        "duration": {"nanoseconds": index.end_ns - index.start_ns},
        "starting_time": {"nanoseconds_since_epoch": index.start_ns},
        "message_count": index.message_count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
    }
    text: str = yaml.safe_dump({"rosbag2_bagfile_information": about}, sort_keys=False, allow_unicode=True)
    return text
