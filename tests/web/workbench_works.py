"""What the tests let the worker process do; importable there."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from poison import do_harm

from pipeline.web.jobs import PLAN, Errand, work_on_errand

if TYPE_CHECKING:
    from pipeline.batch.batch_work import Report, Task


def work_poisoned(task: Task) -> Report:
    """As usual, but logs whose names say so are poison."""
    do_harm((task.options.run or "").rpartition("/")[2], str(task.path))
    return work_on_errand(task)


def work_slowly(task: Task) -> Report:
    """As usual, but a plan says what it does and comes to no end."""
    if isinstance(task, Errand) and task.basis == PLAN:
        assert task.notes is not None
        task.notes.write_text("rehearsing manoeuvres", encoding="utf-8")
        time.sleep(3600.0)
    return work_on_errand(task)
