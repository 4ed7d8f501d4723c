"""Sealing the truth of a ring: encrypted with one key, its hash published, opened when the key is.

    python seal_truth.py open RING/truth.sealed --key-file key.txt     writes RING/truth.json
    python seal_truth.py check RING                                    compares truth.json with the hash

The scheme is encrypt-then-MAC with HMAC-SHA256 from Python's standard library. Key K (32 bytes); a nonce N
(16 bytes) that is an HMAC of the text, so that the same truth gives the same bytes and two truths never share
a stream. Stream block i = HMAC(HMAC(K, "stream"), N + i as 8 bytes); ciphertext = zlib(text) xor stream;
tag = HMAC(HMAC(K, "tag"), magic + N + ciphertext). The file is magic, N, tag, ciphertext. The hash that is
published beside it, in sealed.toml, is the SHA-256 of the text of truth.json.
"""

from __future__ import annotations

import argparse
import hashlib
import hmac
import sys
import tomllib
import zlib
from pathlib import Path

_MAGIC = b"HESEAL1\n"
_NONCE = 16
_TAG = 32
_MOST_BYTES = 1 << 26  # a truth of 60 tasks has some 150 kB: more than 64 MB unpacked is no truth


class SealError(Exception):
    """A seal that cannot be opened: what is wrong, where, and what to do, in one line."""


def derive(secret: bytes, purpose: str) -> bytes:
    """32 bytes for one purpose, from which nothing of the secret or of another purpose follows."""
    return hmac.new(secret, purpose.encode(), hashlib.sha256).digest()


def seal(text: bytes, key: bytes) -> bytes:
    """The bytes of a sealed text."""
    nonce = hmac.new(derive(key, "nonce"), text, hashlib.sha256).digest()[:_NONCE]
    hidden = _cover(zlib.compress(text, 9), key, nonce)
    return _MAGIC + nonce + _tag(key, nonce, hidden) + hidden


def unseal(sealed: bytes, key: bytes, where: str = "truth.sealed") -> bytes:
    """The text of a seal.

    Raises:
        SealError: no seal, another key, or a byte that was changed.
    """
    body = sealed[len(_MAGIC) :]
    nonce, tag, hidden = body[:_NONCE], body[_NONCE : _NONCE + _TAG], body[_NONCE + _TAG :]
    if not sealed.startswith(_MAGIC) or len(tag) < _TAG:
        raise SealError(f"{where}: not a sealed truth; give the file truth.sealed of a ring")
    if not hmac.compare_digest(tag, _tag(key, nonce, hidden)):
        raise SealError(f"{where}: the key does not open it, or a byte was changed; give the published key")
    opened = zlib.decompressobj()
    text = opened.decompress(_cover(hidden, key, nonce), _MOST_BYTES)
    if not opened.eof:
        raise SealError(f"{where}: more than {_MOST_BYTES} bytes unpacked; this is not the truth of a ring")
    return text


def hash_text(text: bytes) -> str:
    """What is published of a text before it is opened."""
    return hashlib.sha256(text).hexdigest()


def read_key(path: Path) -> bytes:
    """32 bytes from a file of 64 hexadecimal digits."""
    try:
        key = bytes.fromhex(path.read_text("ascii").strip())
    except (OSError, ValueError) as problem:
        raise SealError(f"{path}: no key can be read; give a file of 64 hexadecimal digits") from problem
    if len(key) != _TAG:
        raise SealError(f"{path}: {len(key)} bytes; a key has 64 hexadecimal digits")
    return key


def open_ring(sealed: Path, key: bytes) -> Path:
    """Write truth.json beside a seal, if it is what the published hash says."""
    text = unseal(sealed.read_bytes(), key, str(sealed))
    check_hash(sealed.parent, text)
    target = sealed.with_name("truth.json")
    target.write_bytes(text)
    return target


def check_hash(ring: Path, text: bytes) -> None:
    """Compare a truth with the hash in sealed.toml.

    Raises:
        SealError: they differ.
    """
    published = tomllib.loads((ring / "sealed.toml").read_text("utf-8"))["truth_sha256"]
    if not hmac.compare_digest(published, hash_text(text)):
        raise SealError(f"{ring}: the truth is not the one whose hash was published in sealed.toml")


def _cover(data: bytes, key: bytes, nonce: bytes) -> bytes:
    stream_key = derive(key, "stream")
    counters = (nonce + number.to_bytes(8, "big") for number in range(-(-len(data) // _TAG)))
    stream = b"".join(hmac.new(stream_key, one, hashlib.sha256).digest() for one in counters)[: len(data)]
    return (int.from_bytes(data, "big") ^ int.from_bytes(stream, "big")).to_bytes(len(data), "big")


def _tag(key: bytes, nonce: bytes, hidden: bytes) -> bytes:
    return hmac.new(derive(key, "tag"), _MAGIC + nonce + hidden, hashlib.sha256).digest()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    commands = parser.add_subparsers(dest="command", required=True)
    opening = commands.add_parser("open", help="write truth.json beside a seal")
    opening.add_argument("sealed", type=Path)
    opening.add_argument("--key-file", type=Path, required=True)
    checking = commands.add_parser("check", help="compare truth.json with the published hash")
    checking.add_argument("ring", type=Path)
    given = parser.parse_args()
    try:
        if given.command == "open":
            print(open_ring(given.sealed, read_key(given.key_file)))
        else:
            check_hash(given.ring, (given.ring / "truth.json").read_bytes())
            print("the truth is the one whose hash was published")
    except (SealError, OSError) as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
