"""Starting Python again, for work in a process of its own, without looking into the current folder.

``python -c`` and ``python -m`` put the current folder before the standard library: a `tempfile.py` that came
with somebody's logs would run. ``-P`` leaves that folder out. ``-I`` would also drop PYTHONPATH and the site
packages of the user, which are the user's word, not a stranger's, and by which slip itself may be installed.
"""

import os
import sys
import threading
import time

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
"""What tells numeric libraries how many threads to take."""

_ORPHAN_PERIOD_S = 0.5


def python_command(*words: str) -> list[str]:
    """The command line of this interpreter, by its absolute path, that leaves the current folder out.

    Args:
        words: what follows, such as ``-m pipeline batch``.
    """
    return [os.path.abspath(sys.executable), "-P", *words]  # noqa: PTH100 - a link into an environment stays


def slip_command(*words: str) -> list[str]:
    """The command line of a verb in a process of its own.

    Args:
        words: the verb and its words.
    """
    return python_command("-m", "pipeline", *words)


def keep_current_folder_out() -> None:
    """Make every Python that libraries start from here leave the current folder out: workers, trackers."""
    os.environ["PYTHONSAFEPATH"] = "1"


def end_with(parent: int) -> None:
    """End this process when the one that started it is killed.

    Args:
        parent: number of that process.
    """
    threading.Thread(target=_die_with, args=(parent,), name="parent", daemon=True).start()


def _die_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_ORPHAN_PERIOD_S)
    os._exit(1)
