"""`slip schedule`: units for the nightly run."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.batch.schedule import Nightly, System, parse_clock, print_units
from pipeline.cli.output import CLEAN
from pipeline.core.interpreter import slip_command


def schedule(  # noqa: D417 - arguments document themselves
    *arguments: Annotated[
        str, Parameter(help="what follows `slip batch`: logs and options", allow_leading_hyphen=True)
    ],
    print: Annotated[System, Parameter(name="--print")] = "systemd",  # noqa: A002 - the promised name
    at: Annotated[str, Parameter(name="--at")] = "02:00",
    lock: Annotated[Path | None, Parameter(name="--lock")] = None,
) -> int:
    """Print units that run `slip batch` every night: one at a time, caught up after downtime, in the journal.

    Args:
        print: for systemd (a service and its timer) or cron.
        at: time of day, local.
        lock: lock file (default: .slip-batch.lock in this folder).
    """
    hour, minute = parse_clock(at)
    folder = Path.cwd()
    nightly = Nightly(
        program=slip_command(),
        arguments=arguments,
        folder=folder,
        lock=(folder / (lock or ".slip-batch.lock")),
        hour=hour,
        minute=minute,
    )
    sys.stdout.write(print_units(nightly, print))
    return CLEAN
