"""What the tests let the worker process do; importable there."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

from pipeline.web.workers import work_on_errand

if TYPE_CHECKING:
    from pipeline.batch.work import Report, Task


def work_poisoned(task: Task) -> Report:
    """As usual, but logs whose names say so are poison."""
    kind = (task.options.run or "").rpartition("/")[2]
    if kind == "hangs":
        time.sleep(3600.0)
    if kind == "eats":
        hoard = []
        while True:
            hoard.append(b"x" * (1 << 26))
    if kind == "dies":
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "leaves":
        os._exit(7)
    if kind == "raises":
        raise RuntimeError(f"poison in {task.path}")
    return work_on_errand(task)
