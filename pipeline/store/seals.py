"""Checksums and keys that results are sealed with, so that no byte changes unnoticed."""

import hashlib
import hmac
import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pipeline.store.manifest import hash_bytes
from pipeline.store.names import StoreError

# Small JSON files that carry a checksum of themselves, so that no byte of them changes unnoticed.
#
# The checksum stands first and covers every other byte. Files of before there were checksums have none and
# are read as they are.

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
        ValueError: it is not a JSON object, or not what was written.
    """
    check_seal(data)
    try:
        content = json.loads(data.decode())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")  # noqa: TRY004 - wrong content, not a wrong call
    content.pop("checksum", None)
    return content


KEY_VARIABLE: Final = "SLIP_KEY_FILE"
"""Names the file of the key, for batches that nobody starts by hand and for their workers."""

LEAST_BYTES: Final = 32
"""As many as the hash gives: a shorter key would be what is guessed."""

_MOST_BYTES: Final = 1 << 16
_ID_DIGITS: Final = 16


@dataclass(frozen=True)
class Key:
    """A secret.

    Attributes:
        secret: its bytes.
    """

    secret: bytes = field(repr=False)

    @property
    def id(self) -> str:
        """What tells keys apart, and nothing of the secret."""
        return self.sign({"purpose": "name of a key"})[:_ID_DIGITS]

    def sign(self, content: Mapping[str, object]) -> str:
        """HMAC-SHA256 (hex) of a JSON object, whatever the order of its keys."""
        body = json.dumps(content, allow_nan=False, sort_keys=True).encode("ascii")
        return hmac.new(self.secret, body, hashlib.sha256).hexdigest()

    def holds(self, content: Mapping[str, object], signature: str) -> bool:
        """Whether a signature is this key's of that content."""
        return hmac.compare_digest(self.sign(content).encode(), signature.encode("utf-8", "replace"))


def read_key(path: Path) -> Key:
    """The key in a file.

    Raises:
        StoreError: ``bad_key_file``: it is not there, no file, too short or too long, or others may read it.
    """
    try:
        # Opening a pipe would wait for somebody to write into it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise _refuse(path, "the key is not a file", "Give the file that holds it")
            if status.st_mode & 0o077:
                what = f"others may read the key (mode {stat.S_IMODE(status.st_mode):04o})"
                raise _refuse(path, what, "chmod 600 it, and use another key if somebody may have read it")
            secret = file.read(_MOST_BYTES + 1)
    except OSError as error:
        what = f"the key cannot be read ({error.strerror})"
        raise _refuse(path, what, "Make one: openssl rand -out FILE 32 && chmod 600 FILE") from None
    if not LEAST_BYTES <= len(secret) <= _MOST_BYTES:
        what = f"the key holds {len(secret)} bytes and not {LEAST_BYTES} to {_MOST_BYTES}"
        if len(secret) > _MOST_BYTES:
            what = f"the key holds more than {_MOST_BYTES} bytes"
        raise _refuse(path, what, "Make one: openssl rand -out FILE 32 && chmod 600 FILE")
    return Key(secret)


def find_key() -> Key | None:
    """The key that the environment names; None without one.

    Raises:
        StoreError: as `read_key`.
    """
    path = os.environ.get(KEY_VARIABLE)
    return read_key(Path(path)) if path else None


def _refuse(path: Path, what: str, hint: str) -> StoreError:
    return StoreError("bad_key_file", what, where=str(path), hint=hint)
