"""What the user asked of a batch."""

from __future__ import annotations

import math
import os
import re
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from pipeline.batch.errors import BatchError
from pipeline.core.errors import shorten

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pipeline.analysis import Options

_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)i?b?\s*", re.IGNORECASE)
_SHARD = re.compile(r"(\d+)/(\d+)")


def count_cores() -> int:
    """Cores that this process may use: of the machine, or those that a job of a cluster was given."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One of several machines that share the logs between them: ``number`` of ``count``, from 1."""

    number: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Pruning:
    """What becomes of generations that are not current.

    Attributes:
        keep: how many of each run stay.
        quota_bytes: size of the results above which the oldest go as well; None for no limit.
    """

    keep: int = 1
    quota_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class Request:
    """Options of `slip batch`.

    Attributes:
        targets: logs, folders, globs and lists.
        options: what each log is analyzed with.
        address: of the results, if they are on an object store; ``options.out`` is then their mirror.
        executor: ``local``, ``inline``, ``dask``, or the address of a scheduler.
        jobs: logs worked on at once.
        shard: the part of the logs that is this machine's.
        timeout_s: longest time for one log [s].
        memory_bytes: most memory for one log.
        settle_s: a log without a proper end that changed within this time is left for the next batch [s].
        retries_quarantined: whether quarantined logs are tried again.
        pruning: what becomes of old generations; None leaves them.
    """

    targets: tuple[str, ...]
    options: Options
    address: str | None = None
    executor: str = "local"
    jobs: int = field(default_factory=count_cores)
    shard: Shard | None = None
    timeout_s: float = 3600.0
    memory_bytes: int = 4_000_000_000
    settle_s: float = 120.0
    retries_quarantined: bool = False
    pruning: Pruning | None = None


def parse_size(text: str) -> int:
    """Bytes from ``500MB``, ``2G``, ``1.5 TB`` (powers of ten).

    Raises:
        BatchError: ``bad_size``.
    """
    match = _SIZE.fullmatch(text)
    size = float(match[1]) * 1000 ** " kmgt".index(match[2].lower() or " ") if match else math.inf
    if math.isinf(size):
        raise BatchError("bad_size", f"{shorten(text)!r} is no size", hint="Write for example 500MB or 2GB")
    return int(size)


def parse_shard(text: str) -> Shard:
    """The shard ``i/n``, i from 1 to n.

    Raises:
        BatchError: ``bad_shard``.
    """
    match = _SHARD.fullmatch(text)
    number, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= count:
        raise BatchError(
            "bad_shard", f"{text!r} is no shard", hint="Write i/n with i from 1 to n, for example 2/4"
        )
    return Shard(number=number, count=count)


def measure_memory(own: Path = Path("/proc/self/cgroup"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes of memory that this process may use: of the machine, or of its control group where that is less.

    Args:
        own: tells the control group of this process.
        groups: the control groups (version 2).
    """
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(installed, *_list_limits(own, groups)) if own.exists() else installed


def _list_limits(own: Path, groups: Path) -> Iterator[int]:
    for line in own.read_text(encoding="utf-8").splitlines():
        if line.startswith("0::"):
            inside = PurePosixPath(line[3:].lstrip("/"))
            for place in (inside, *inside.parents):
                # "max" means no limit; the root has no such file.
                with suppress(OSError, ValueError):
                    yield int((groups / place / "memory.max").read_text(encoding="utf-8"))
    yield sys.maxsize
