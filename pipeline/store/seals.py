"""Small JSON files that carry a checksum of themselves, so that no byte of them changes unnoticed.

The checksum stands first and covers every other byte. Files of before there were checksums have none and are
read as they are.
"""

import json
from collections.abc import Mapping

from pipeline.store.manifest import hash_bytes

_START = b'{"checksum": "'
_DIGITS = 64
_END = b'",'


def seal(content: Mapping[str, object], *, indent: int | None = None) -> bytes:
    """JSON, sorted, with its checksum: the same bytes for the same content.

    Args:
        content: at least one key.
        indent: spaces that each level is set in; None for one line.

    Raises:
        ValueError: a number that JSON has no word for.
        TypeError: something else that it has none for.
    """
    # Names of files need not be text: what is none stands escaped.
    text = json.dumps(content, allow_nan=False, indent=indent, sort_keys=True)
    body = text.encode("ascii")
    return _START + hash_bytes(body).encode() + _END + body[1:]


def check_seal(data: bytes) -> bool:
    """Whether the content of a file carries a checksum.

    Returns:
        True when it does, and is what was written; False when it never had one.

    Raises:
        ValueError: it is not what was written.
    """
    start, rest = data[: len(_START)], data[len(_START) :]
    # One changed byte must not make a sealed file one of before there were seals.
    if 2 * sum(one == other for one, other in zip(start, _START, strict=False)) < len(_START):
        return False
    body = b"{" + rest[_DIGITS + len(_END) :]
    if start + rest[:_DIGITS] + rest[_DIGITS:][: len(_END)] != _START + hash_bytes(body).encode() + _END:
        raise ValueError("its checksum is not that of its content")
    return True


def unseal(data: bytes) -> dict[str, object]:
    """The content of a sealed file, or of one of before there were seals.

    Raises:
        ValueError: it is no JSON object, or not what was written.
    """
    check_seal(data)
    try:
        content = json.loads(data.decode())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")  # noqa: TRY004 - wrong content, not a wrong call
    content.pop("checksum", None)
    return content
