"""Batch processing of many logs: incremental, resumable, and robust against bad logs.

A batch finds the logs, skips those that are done, processes the rest on this machine or a cluster, and
reports the outcome of each log with its reason. The same command continues an interrupted batch. Here are the
options of a batch, and systemd or cron units that run it every night.
"""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pipeline.core import SlipError, shorten

if TYPE_CHECKING:
    from pipeline.analysis import Options


class BatchError(SlipError):
    """Logs that cannot be found, or workers that cannot be started."""


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
        address: address of the results, if they are on an object store; ``options.out`` is then their mirror.
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
        raise BatchError(
            "bad_size", f"{shorten(text)!r} is not a size", hint="Write for example 500MB or 2GB"
        )
    return int(size)


def parse_memory_limit(text: str) -> int:
    """The memory limit of a worker [bytes], at least what a worker needs before it reads anything.

    Raises:
        BatchError: ``bad_size``, ``memory_too_small``.
    """
    size = parse_size(text)
    if size < _WORKER_BYTES:
        raise BatchError(
            "memory_too_small",
            f"a worker does not start within a memory limit of {shorten(text)!r}",
            hint=f"Give at least {_WORKER_BYTES // 1_000_000}MB, or with large logs 2GB",
        )
    return size


def parse_shard(text: str) -> Shard:
    """The shard ``i/n``, i from 1 to n.

    Raises:
        BatchError: ``bad_shard``.
    """
    match = _SHARD.fullmatch(text)
    number, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= count:
        raise BatchError(
            "bad_shard", f"{text!r} is not a shard", hint="Write i/n with i from 1 to n, for example 2/4"
        )
    return Shard(number=number, count=count)


System = Literal["systemd", "cron"]

_CLOCK = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)")
_STOP_S = 120


@dataclass(frozen=True, kw_only=True)
class Nightly:
    """Program to run nightly.

    Attributes:
        program: the program and its first arguments, absolute.
        arguments: arguments of ``slip batch``.
        folder: working folder, to which relative paths in the arguments refer.
        lock: lock file that prevents a second instance.
        hour: hour of the day, local time.
        minute: minute of the hour.
    """

    program: Sequence[str]
    arguments: Sequence[str]
    folder: Path
    lock: Path
    hour: int
    minute: int


def parse_clock(text: str) -> tuple[int, int]:
    """Hour and minute of ``02:30``.

    Raises:
        BatchError: ``bad_time``.
    """
    match = _CLOCK.fullmatch(text)
    if match is None:
        raise BatchError("bad_time", f"{text!r} is not a time of day", hint="Write HH:MM, for example 02:30")
    return int(match[1]), int(match[2])


def print_units(nightly: Nightly, system: System) -> str:
    """Return the units as text, with comments on where to install them.

    Args:
        nightly: program and time.
        system: ``systemd`` for a service and its timer, ``cron`` for lines of a crontab.

    Raises:
        BatchError: ``bad_word``, a path or an argument that the format cannot represent.
    """
    for word in (*_command(nightly), str(nightly.folder), str(nightly.lock)):
        _require_one_line(word)
    return _print_systemd(nightly) if system == "systemd" else _print_cron(nightly)


def _print_systemd(nightly: Nightly) -> str:
    # A service is never started twice; the lock also excludes batches started by hand. The folder ends in a
    # slash because a backslash or a space at the end of a line would be misread.
    words = ["/usr/bin/flock", "--nonblock", "--conflict-exit-code", "0", str(nightly.lock)]
    command = " ".join(_quote_systemd(word) for word in [*words, *_command(nightly)])
    units = resources.files("pipeline.batch").joinpath("slip-batch.systemd").read_text("utf-8")
    folder = _escape_systemd(str(nightly.folder))
    return units.format(
        folder=folder, command=command, hour=nightly.hour, minute=nightly.minute, stop_s=_STOP_S
    )


def _print_cron(nightly: Nightly) -> str:
    inner = " ".join(_quote_cron(word) for word in _command(nightly))
    flock = f"flock --nonblock --conflict-exit-code 0 {_quote_cron(str(nightly.lock))}"
    line = f"cd {_quote_cron(str(nightly.folder))} && {flock} {inner} 2>&1 | logger --tag slip-batch"
    return f"""\
# crontab -e
SHELL=/bin/sh
PATH=/usr/local/bin:/usr/bin:/bin
{nightly.minute} {nightly.hour} * * * {line}
# A night that the machine slept through is caught up after it starts.
@reboot sleep 300; {line}
# journalctl --identifier slip-batch
"""


def _command(nightly: Nightly) -> list[str]:
    return [*nightly.program, "batch", "run", *nightly.arguments]


def _require_one_line(word: str) -> None:
    """Reject control characters and names that are not UTF-8, which units and crontabs cannot represent."""
    if any(unicodedata.category(character) in {"Cc", "Cs"} for character in word):
        raise BatchError(
            "bad_word",
            f"{word!r} holds a line break or another character that cannot stand in a unit or a crontab",
            hint="Rename the file or folder",
        )


def _quote_cron(word: str) -> str:
    r"""Quote a word of a crontab command so that every cron and the shell behind it read it alike.

    A bare percent sign ends the command. Some crons remove the backslash before it, some keep it: it is
    placed outside of quotes, where the shell removes it. Some crons turn two backslashes into one, so two
    never follow each other.
    """
    if re.fullmatch(r"[A-Za-z0-9_@+=:,./-]+", word):
        return word
    single = word.replace("'", "'\"'\"'").replace("\\", "\\''").replace("%", "'\\%'")
    return f"'{single}'"


def _escape_systemd(text: str) -> str:
    return text.replace("%", "%%")


def _quote_systemd(word: str) -> str:
    """Quote a word of an ExecStart line if needed; its % and $ are literal."""
    plain = _escape_systemd(word).replace("$", "$$")
    if re.fullmatch(r"[A-Za-z0-9_@%+=:,./$-]+", plain):
        return plain
    escaped = plain.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
