"""Make the rings of HiddenEffect: folders of tasks, and their truth.

    make hidden-effect
    make hidden-effect ARGS="--rings sealed --secret-file secret.txt --opens 2027-06-01"
    make hidden-effect ARGS="--rings real --recordings FOLDER"

The open and the rigid ring come of `--seed`, whose default is that of the published version: the same seed
gives the same bytes. The sealed ring comes of a secret (64 hexadecimal digits, in a file or in
HIDDEN_EFFECT_SECRET) that stands nowhere in the repository. The real ring is made of your recordings.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import tomlkit
from seal_truth import SealError, derive, hash_text, read_key, seal
from task_draws import Lengths, Ring, draw_task
from task_files import TRUTH_FORMAT, VERSION, write_task

from pipeline.core import SlipError

SEED = 20261
RINGS = ("open", "sealed", "rigid", "real")
_COUNTS = {"open": 60, "sealed": 60, "rigid": 16}
_SECRET = "HIDDEN_EFFECT_SECRET"  # noqa: S105 - the name of a variable
_SEED_BYTES = 16  # 128 bits: nobody finds a seed by trying

Told = Callable[[str], None]


def make_ring(ring: Ring, out: Path, root: bytes, count: int, lengths: Lengths, tell: Told) -> dict[str, Any]:
    """Write the tasks of a ring that is simulated.

    Args:
        ring: its name.
        out: folder of all rings.
        root: from which the seeds of its tasks follow.
        count: tasks.
        lengths: of their logs.
        tell: called with a line after each.

    Returns:
        The truth of its tasks.
    """
    truth = {}
    for number in range(1, count + 1):
        begun = time.perf_counter()
        task = draw_task(ring, number, find_seed(root, ring, number), lengths)
        truth[task.id] = write_task(task, out / ring / task.id)
        tell(f"{task.id}  {time.perf_counter() - begun:.1f} s")
    return {"format": TRUTH_FORMAT, "version": VERSION, "ring": ring, "tasks": truth}


def find_seed(root: bytes, ring: str, number: int) -> int:
    """The seed of a task."""
    return int.from_bytes(derive(root, f"{ring} {number}")[:_SEED_BYTES], "big")


def write_truth(ring: Path, truth: dict[str, Any]) -> bytes:
    """Write truth.json."""
    text = format_truth(truth)
    (ring / "truth.json").write_bytes(text)
    return text


def write_sealed(ring: Path, truth: dict[str, Any], root: bytes, opens: str) -> None:
    """Write the sealed truth, and what is published of it before its key is."""
    text, key = format_truth(truth), derive(root, "key")
    sealed = seal(text, key)
    (ring / "truth.sealed").write_bytes(sealed)
    published = {
        "version": VERSION,
        "opens": opens,
        "tasks": len(truth["tasks"]),
        "truth_sha256": hash_text(text),
        "sealed_sha256": hash_text(sealed),
    }
    (ring / "sealed.toml").write_text(tomlkit.dumps(published), encoding="utf-8")


def format_truth(truth: dict[str, Any]) -> bytes:
    """The text of a truth, of which the hash is published."""
    return (json.dumps(truth, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def read_secret(path: Path | None) -> bytes | None:
    """The secret of the sealed ring, if there is one."""
    if path is not None:
        return read_key(path)
    given = os.environ.get(_SECRET)
    if not given:
        return None
    try:
        return bytes.fromhex(given.strip())
    except ValueError as problem:
        raise SealError(f"{_SECRET}: not hexadecimal; give 64 hexadecimal digits") from problem


def measure_size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def make_rings(given: argparse.Namespace, tell: Told) -> None:
    """Write the rings that were asked for, each in place of what stood there."""
    out: Path = given.out
    out.mkdir(parents=True, exist_ok=True)
    here = Path(__file__).parent
    for name in ("names.toml", "score_answers.py", "seal_truth.py"):
        shutil.copyfile(here / name, out / name)
    lengths = Lengths(given.seconds, 1.25 * given.seconds, given.held_out_seconds)
    root = hashlib.sha256(f"HiddenEffect {VERSION} seed {given.seed}".encode()).digest()
    for ring in given.rings:
        begun = time.perf_counter()
        secret = read_secret(given.secret_file) if ring == "sealed" else None
        if ring == "sealed" and secret is None:
            tell(f"sealed: left out; it needs a secret: --secret-file FILE or {_SECRET}")
            continue
        if ring == "real" and given.recordings is None:
            tell("real: left out; it needs recordings: --recordings FOLDER")
            continue
        shutil.rmtree(out / ring, ignore_errors=True)
        (out / ring).mkdir()
        if ring == "real":
            from real_tasks import make_real  # noqa: PLC0415 - it alone reads recordings

            write_truth(out / ring, make_real(out / ring, given.recordings, tell))
        elif secret is not None:
            count = given.tasks or _COUNTS[ring]
            write_sealed(out / ring, make_ring(ring, out, secret, count, lengths, tell), secret, given.opens)
        else:
            truth = make_ring(ring, out, root, given.tasks or _COUNTS[ring], lengths, tell)
            write_truth(out / ring, truth)
        megabytes = measure_size(out / ring) / 1e6
        tell(f"{ring}: {megabytes:.1f} MB, {time.perf_counter() - begun:.0f} s")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("rings"), help="folder of the rings")
    parser.add_argument("--rings", nargs="+", choices=RINGS, default=list(RINGS))
    parser.add_argument("--seed", type=int, default=SEED, help="of the open and the rigid ring")
    parser.add_argument("--tasks", type=int, help="a ring; 60, of the rigid one 16, when not given")
    parser.add_argument(
        "--seconds", type=float, default=120.0, help="shortest log; the longest has a quarter more"
    )
    parser.add_argument("--held-out-seconds", type=float, default=40.0)
    parser.add_argument("--secret-file", type=Path, help="of the sealed ring: 64 hexadecimal digits")
    parser.add_argument(
        "--opens", default="undated", help="date on which the key of the sealed ring is published"
    )
    parser.add_argument("--recordings", type=Path, help="folder of your own recordings, for the real ring")
    parser.add_argument(
        "--new-secret", type=Path, help="write a new secret to a file, its key beside it, and stop"
    )
    return parser.parse_args(arguments)


def write_secret(path: Path) -> None:
    """Write a new secret that only its owner may read, and beside it the key, published on that date."""
    root = secrets.token_bytes(32)
    for target, text in ((path, root), (path.with_suffix(".key"), derive(root, "key"))):
        with os.fdopen(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:
            stream.write(text.hex() + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Make what was asked for; 1 where that was not possible, with one line."""
    given = parse(arguments)
    try:
        if given.new_secret is not None:
            write_secret(given.new_secret)
        else:
            make_rings(given, lambda line: print(line, flush=True))
    except (SealError, SlipError, OSError) as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
