"""Batch processing of many logs: incremental, resumable, and robust against bad logs.

A batch finds the logs, skips those that are done, processes the rest on this machine or a cluster, and
reports the outcome of each log with its reason. The same command continues an interrupted batch. Here are the
options of a batch.
"""

import math
import os
import re
from dataclasses import dataclass, field

from pipeline.analysis import Options
from pipeline.core import SlipError, shorten


class BatchError(SlipError):
    """Logs that cannot be found, or workers that cannot be started."""


class Stop(SystemExit):
    """The batch is stopped by a signal, whose number and 128 are the exit code."""


_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)i?b?\s*", re.IGNORECASE)
_SHARD = re.compile(r"(\d+)/(\d+)")
_WORKER_BYTES = 200_000_000
"""Memory of a worker that has imported the stages and opened a log."""


def count_cores() -> int:
    """Cores available to this process: of the machine, or of the cluster job."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


@dataclass(frozen=True, kw_only=True)
class Shard:
    """Share of one of several machines in the logs: ``number`` of ``count``, from 1."""

    number: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Pruning:
    """Removal of generations that are not current.

    Attributes:
        keep: number of generations of each run to keep.
        quota_bytes: size of the results above which the oldest are removed as well; None for no limit.
    """

    keep: int = 1
    quota_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class Request:
    """Options of `slip batch`.

    Attributes:
        targets: logs, folders, globs and lists.
        options: options of the analysis of each log.
        executor: ``local``, ``inline``, ``dask``, or the address of a scheduler.
        jobs: number of logs processed in parallel.
        shard: share of this machine in the logs.
        timeout_s: time limit of one log [s].
        memory_bytes: memory limit of one log.
        settle_s: a log without a proper end that changed within this time is left for the next batch [s].
        retries_quarantined: whether quarantined logs are tried again.
        pruning: how to remove old generations; None keeps them.
    """

    targets: tuple[str, ...]
    options: Options
    executor: str = "local"
    jobs: int = field(default_factory=count_cores)
    shard: Shard | None = None
    timeout_s: float = 3600.0
    memory_bytes: int = 4_000_000_000
    settle_s: float = 120.0
    retries_quarantined: bool = False
    pruning: Pruning | None = None

    def find_limit(self, code: str) -> float:
        """The limit that an error with this code says to be exceeded [s or bytes]; 0 for other errors."""
        return {"timed_out": self.timeout_s, "out_of_memory": float(self.memory_bytes)}.get(code, 0.0)


def parse_size(text: str) -> int:
    """Bytes from ``500MB``, ``2G``, ``1.5 TB`` (powers of ten).

    Raises:
        BatchError: ``bad_size``.
    """
    match = _SIZE.fullmatch(text)
    size = float(match[1]) * 1000 ** " kmgt".index(match[2].lower() or " ") if match else math.inf
    if math.isinf(size):
        raise BatchError(
            "bad_size", f"{shorten(text)!r} is not a size", hint="Write for example 500MB or 2GB"
        )
    return int(size)


def parse_memory_limit(text: str) -> int:
    """The memory limit of a process [bytes], at least what one needs before it reads anything.

    Raises:
        BatchError: ``bad_size``, ``memory_too_small``.
    """
    size = parse_size(text)
    if size < _WORKER_BYTES:
        raise BatchError(
            "memory_too_small",
            f"slip does not start within a memory limit of {shorten(text)!r}",
            hint=f"Give at least {_WORKER_BYTES // 1_000_000}MB, or with large logs 2GB",
        )
    return size


def parse_shard(text: str) -> Shard:
    """The shard ``i/n``, i from 1 to n.

    Raises:
        SlipError: ``bad_shard``.
    """
    match = _SHARD.fullmatch(text)
    number, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= count:
        raise SlipError(
            "bad_shard", f"{text!r} is not a shard", hint="Write i/n with i from 1 to n, for example 2/4"
        )
    return Shard(number=number, count=count)
