"""What a file is that is no recording, by its first bytes, and the one thing to do about it."""

import re
from collections.abc import Iterable
from typing import Final

LONGEST_START: Final = 1 << 12
"""Number of bytes at the start of a file by which it is named."""

_UNPACK: Final = "Unpack it, and give the recording that is in it"

_ULOG: Final = (
    "Convert it to a ROS bag with pyulog (`ulog2rosbag run.ulg run.bag px4_msgs`), or record the topics of "
    "PX4 with `ros2 bag record`"
)
_BY_TABLE: Final = (
    "Write its columns into an .mcap with the times of their rows, as examples/tables_to_mcap.py does"
)

_PACKED: Final = (
    (rb"PK(?:\x03\x04|\x05\x06)", "it is a zip archive", f"{_UNPACK}: unzip FILE"),
    (rb"\x1f\x8b", "it is compressed with gzip", f"{_UNPACK}: gunzip FILE, or tar -xzf FILE"),
    (rb"BZh[1-9]", "it is compressed with bzip2", f"{_UNPACK}: bunzip2 FILE, or tar -xjf FILE"),
    (rb"\xfd7zXZ\0", "it is compressed with xz", f"{_UNPACK}: unxz FILE, or tar -xJf FILE"),
    (rb"7z\xbc\xaf\x27\x1c", "it is a 7-Zip archive", f"{_UNPACK}: 7z x FILE"),
    (rb"Rar!\x1a\x07", "it is a RAR archive", f"{_UNPACK}: unrar x FILE"),
    (rb"\x04\x22\x4d\x18", "it is compressed with LZ4 as a whole", f"{_UNPACK}: lz4 -d FILE"),
    (
        rb"\x28\xb5\x2f\xfd",
        "it is compressed with Zstandard as a whole, which its name does not say",
        "Add .zstd to its name (run.mcap.zstd), or unpack it: zstd -d FILE",
    ),
    (rb".{257}ustar", "it is a tar archive", f"{_UNPACK}: tar -xf FILE"),
)
"""As `_KINDS`, of what may hold a recording."""

_KINDS: Final = (
    (
        rb"version https?://(?:git-lfs|hawser)\.",
        "it is a pointer of Git LFS, not the recording, which was not fetched",
        "Fetch it: git lfs pull",
    ),
    (
        rb"\s*(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<(?:!doctype\s+html|html|head|body)\b",
        "it is a web page, not the recording: the download gave a page of login, confirmation or error",
        "Download the file again, by its direct address or in a browser",
    ),
    (rb"\s*<\?xml|\s*<[A-Za-z][^>]*>", "it is an XML text, not a recording", "Give the recording itself"),
    (rb"ULog\x01\x12\x35", "it is a ULog of PX4's flight controller, which is not read", _ULOG),
    (
        rb"\xa3\x95\x80\x80",
        "it is a log of ArduPilot's flight controller (DataFlash), which is not read",
        _BY_TABLE,
    ),
    (
        rb"rosbag2_bagfile_information\s*:",
        "it is the list of files of a rosbag2 recording, not the recording",
        "Give the folder in which it is",
    ),
    (rb"PAR1", "it is a table in Parquet, not a recording of messages", _BY_TABLE),
    (rb"\x89HDF\r\n\x1a\n|MATLAB [57]", "it is a file of numbers in HDF5 or MATLAB's form", _BY_TABLE),
    (
        rb"RRF[0-9]",
        "it is a recording of Rerun, which is not read",
        "Give the recording that it was made from",
    ),
    (
        rb"\xed\xa1\xda\x01",
        "it is a log of LCM, whose messages have no definitions in the file",
        "Write them into an .mcap with the definitions of their types, or as JSON",
    ),
    (
        rb"\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x0a\x0d\x0d\x0a",
        "it is a capture of a network (pcap), not of messages",
        "Record the messages that a driver makes of it: ros2 bag record",
    ),
    (
        rb"....ftyp|\x1a\x45\xdf\xa3|RIFF|\x89PNG|\xff\xd8\xff|%PDF",
        "it is a video, an image or a document, not a recording of messages",
        "Give the recording itself",
    ),
    (
        rb"\0{64}",
        "its first bytes are all zero: it was not written out",
        "Copy the file from its origin again",
    ),
)
"""Patterns of the first bytes, what such a file is, and what to do."""

_SEPARATORS: Final = ",;\t"
_FEWEST_LINES: Final = 2


def name_foreign(start: bytes) -> tuple[str, str] | None:
    """What a file is, and what to do; None if its first bytes tell nothing.

    Args:
        start: its first `LONGEST_START` bytes.
    """
    return _match_kind(start, (*_KINDS, *_PACKED)) or _name_text(start)


def name_packed(start: bytes) -> tuple[str, str] | None:
    """What a file that may hold a recording is packed with, and how to unpack it; None of other files.

    Args:
        start: its first `LONGEST_START` bytes.
    """
    return _match_kind(start, _PACKED)


def _match_kind(start: bytes, kinds: Iterable[tuple[bytes, str, str]]) -> tuple[str, str] | None:
    for pattern, what, hint in kinds:
        if re.match(pattern, start, re.DOTALL | re.IGNORECASE):
            return what, hint
    return None


def _name_text(start: bytes) -> tuple[str, str] | None:
    """The same of a text; None of other bytes."""
    try:
        text = start.decode("utf-8-sig", "ignore" if len(start) >= LONGEST_START else "strict")
    except UnicodeDecodeError:
        return None
    if any(not sign.isprintable() and not sign.isspace() for sign in text):
        return None
    if text.lstrip().startswith(("{", "[")):
        return "it is a text in JSON, not a recording of messages", _BY_TABLE
    lines = [line for line in text.splitlines() if line.strip()][:_FEWEST_LINES]
    for separator in _SEPARATORS:
        counts = {line.count(separator) for line in lines}
        if len(lines) == _FEWEST_LINES and len(counts) == 1 and min(counts):
            return "it is a table of text (CSV), not a recording of messages", _BY_TABLE
    return "it is a text, not an MCAP file or a ROS bag", "Give an .mcap, .bag or .db3 file"
