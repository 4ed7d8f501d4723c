"""Memory of processes and of the machine, and its limits."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

_PERIOD_S = 0.05
"""Polling period of memory [s]: a process takes tens of megabytes in it, and reading takes microseconds."""


_PROC = Path("/proc/self/task")


_SLOW_PERIOD_S = 1.0
"""Polling period where another program must be called for the list of processes [s]."""


@contextmanager
def limit_memory(limit_bytes: int, give_up: Callable[[int], None]) -> Iterator[None]:
    """Limit the memory of this process itself.

    Args:
        limit_bytes: memory limit.
        give_up: called in a separate thread with the memory in use if it exceeds the limit; ends the process.
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


def read_memory(pid: int) -> int:
    """Memory of a process [bytes], 0 if it has ended."""
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


def measure_memory(own: Path = Path("/proc/self/cgroup"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Memory available to this process [bytes]: of the machine, or of its control group if that is less.

    Args:
        own: file with the control group of this process.
        groups: folder of the control groups (version 2).
    """
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(installed, *_list_limits(own, groups)) if own.exists() else installed


def _list_limits(own: Path, groups: Path) -> Iterator[int]:
    for line in own.read_text(encoding="utf-8").splitlines():
        if line.startswith("0::"):
            inside = PurePosixPath(line[3:].lstrip("/"))
            for group in (inside, *inside.parents):
                # "max" means no limit; the root has no such file.
                with suppress(OSError, ValueError):
                    yield int((groups / group / "memory.max").read_text(encoding="utf-8"))
    yield sys.maxsize
