"""A watchdog over the memory of workers or of this process: better one log lost than the machine."""

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PERIOD_S = 0.05
_PROC = Path("/proc/self/task")
_SLOW_PERIOD_S = 1.0
"""Where processes have to be asked for by another program."""


class MemoryWatchdog:
    """Kills children of this process that hold more memory than they may.

    Args:
        limit_bytes: most memory for each.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._killed: dict[int, int] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="memory", daemon=True)

    def start(self) -> None:
        """Begin to watch, on a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """Watch no more."""
        self._stop.set()
        self._thread.join()

    def held_by(self, pid: int | None) -> int | None:
        """Bytes that a process held when it was killed for it; None when it was not."""
        return None if pid is None else self._killed.get(pid)

    def _watch(self) -> None:
        while not self._stop.wait(_PERIOD_S if _PROC.exists() else _SLOW_PERIOD_S):
            for pid in list_children():
                held = read_memory(pid)
                if held > self._limit and pid not in self._killed:
                    self._killed[pid] = held
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)


@contextmanager
def limit_memory(limit_bytes: int, give_up: Callable[[int], None]) -> Iterator[None]:
    """Watch over the memory of this process itself.

    Args:
        limit_bytes: most that it may hold.
        give_up: told what it holds when that is more, on a thread of its own; it ends the process.
    """
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_PERIOD_S if _PROC.exists() else _SLOW_PERIOD_S):
            held = read_memory(os.getpid())
            if held > limit_bytes:
                give_up(held)

    watcher = threading.Thread(target=watch, name="own memory", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def list_children() -> list[int]:
    """Processes that this one has started and that have not gone."""
    if not _PROC.exists():
        asked = _ask(["/usr/bin/pgrep", "-P", str(os.getpid())])
        return [int(word) for word in asked.split()]
    found: list[int] = []
    for path in _PROC.glob("*/children"):
        # A thread may end between the look at the folder and the look at the file.
        with suppress(OSError):
            found += [int(word) for word in path.read_bytes().split()]
    return found


def read_memory(pid: int) -> int:
    """Memory that a process holds [bytes], 0 when it has gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_bytes().split()[1])
    except FileNotFoundError:
        return 0 if Path("/proc/self").exists() else _kilobytes(pid) * 1024
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _ask(command: list[str]) -> str:
    asked = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own words
    return asked.stdout


def _kilobytes(pid: int) -> int:
    return int(_ask(["/bin/ps", "-o", "rss=", "-p", str(pid)]).strip() or 0)
