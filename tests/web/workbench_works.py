"""What the tests let the worker process do; importable there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from poison import do_harm

from pipeline.web.jobs import work_on_errand

if TYPE_CHECKING:
    from pipeline.batch.batch_work import Report, Task


def work_poisoned(task: Task) -> Report:
    """As usual, but logs whose names say so are poison."""
    do_harm((task.options.run or "").rpartition("/")[2], str(task.path))
    return work_on_errand(task)
