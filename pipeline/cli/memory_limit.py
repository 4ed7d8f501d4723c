"""What verbs do when a file takes more memory than it may."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pipeline.cli.output import FAILED, print_error
from pipeline.core.errors import SlipError

_SHARE = 0.8
"""Of the machine's memory: the rest of the machine needs some, too."""


@contextmanager
def limited_memory(
    size: str | None,
    name_log: Callable[[], str],
    conclude: Callable[[SlipError], None],
    hint: str = "Give it more with --memory, or leave the log out",
) -> Iterator[None]:
    """End the program with one line when it holds too much memory.

    Args:
        size: most memory, for example ``2GB``; None for a share of the machine's.
        name_log: which file is being worked on.
        conclude: prints what was found before, where JSON was asked for.
        hint: what to do then.

    Raises:
        BatchError: ``bad_size``.
    """
    from pipeline.batch.memory import limit_memory  # noqa: PLC0415 - heavy

    limit = choose_limit(size)

    def give_up(held: int) -> None:
        error = out_of_memory(held, limit, name_log(), hint)
        print_error(error)
        conclude(error)
        sys.stdout.flush()
        # Nothing else ends a library's computation. Results are as after a kill: those before, whole.
        os._exit(FAILED)

    with limit_memory(limit, give_up):
        yield


def choose_limit(size: str | None) -> int:
    """Bytes of memory that a verb may hold: what ``--memory`` says, else a share of the machine's.

    Raises:
        BatchError: ``bad_size``.
    """
    from pipeline.batch import measure_memory, parse_size  # noqa: PLC0415 - heavy

    return int(_SHARE * measure_memory()) if size is None else parse_size(size)


def out_of_memory(held: int, limit: int, where: str, hint: str) -> SlipError:
    """The error of work that held more memory [bytes] than it may."""
    what = f"it held {held / 1e9:.2g} GB of memory, more than {limit / 1e9:.2g} GB"
    return SlipError("out_of_memory", what, where=where, hint=hint)
