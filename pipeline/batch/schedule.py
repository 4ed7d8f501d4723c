"""Units that run a batch every night: one at a time, caught up after downtime, heard in the journal."""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

from pipeline.batch.errors import BatchError

System = Literal["systemd", "cron"]

_CLOCK = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)")
_STOP_S = 120


@dataclass(frozen=True, kw_only=True)
class Nightly:
    """What is to run when.

    Attributes:
        program: the program and its first words, absolute.
        arguments: words of ``slip batch``.
        folder: working folder, to which relative paths among the words are relative.
        lock: lock file that keeps a second one from starting.
        hour: of the day, local time.
        minute: of the hour.
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
        raise BatchError("bad_time", f"{text!r} is no time of day", hint="Write HH:MM, for example 02:30")
    return int(match[1]), int(match[2])


def print_units(nightly: Nightly, system: System) -> str:
    """The units as text, with comments that say where they go.

    Args:
        nightly: what is to run when.
        system: ``systemd`` for a service and its timer, ``cron`` for lines of a crontab.

    Raises:
        BatchError: ``bad_word``, a path or an argument that neither can hold.
    """
    for word in (*_command(nightly), str(nightly.folder), str(nightly.lock)):
        _require_one_line(word)
    return _print_systemd(nightly) if system == "systemd" else _print_cron(nightly)


def _print_systemd(nightly: Nightly) -> str:
    # A service is never started twice, and the lock also keeps batches out that were started by hand.
    # The folder ends in a slash because a backslash or a space at the end of a line would not be its own.
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
    return [*nightly.program, "batch", *nightly.arguments]


def _require_one_line(word: str) -> None:
    """Neither a unit nor a crontab can hold a control character in one line, nor a name that is no UTF-8."""
    if any(unicodedata.category(character) in {"Cc", "Cs"} for character in word):
        raise BatchError(
            "bad_word",
            f"{word!r} holds a line break or another character that cannot stand in a unit or a crontab",
            hint="Rename the file or folder",
        )


def _quote_cron(word: str) -> str:
    r"""A word of a crontab's command, the same to every cron and to the shell behind it.

    A bare percent sign ends the command; some crons take the backslash before it away, some leave it: it
    stands outside of quotes, where the shell takes it away. Some crons make one backslash of two, so never do
    two stand side by side.
    """
    if re.fullmatch(r"[A-Za-z0-9_@+=:,./-]+", word):
        return word
    single = word.replace("'", "'\"'\"'").replace("\\", "\\''").replace("%", "'\\%'")
    return f"'{single}'"


def _escape_systemd(text: str) -> str:
    return text.replace("%", "%%")


def _quote_systemd(word: str) -> str:
    """A word of an ExecStart line: quoted where needed, its % and $ taken literally."""
    plain = _escape_systemd(word).replace("$", "$$")
    if re.fullmatch(r"[A-Za-z0-9_@%+=:,./$-]+", plain):
        return plain
    escaped = plain.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
