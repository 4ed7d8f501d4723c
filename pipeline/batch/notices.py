"""What somebody should know after a batch: logs and steps that failed.

Each is sent once, to a command of the user, and again only after a night without it.
"""

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.batch import BatchError
from pipeline.batch.batch_run import Outcome
from pipeline.core import SlipError, make_plain, shorten
from pipeline.store import Store

_NOTES = "batch/notified"
_NOTE = "sent"
_SHORT = {"failed", "quarantined", "left"}
_NOTIFY_S = 120.0
"""Time that the command of the user may take [s]: mail servers that do not answer give up after a minute."""
_MOST_NOTICES = 50
"""News that a message lists: a screen; with `_LONGEST` far below the 128 kB that a variable may hold."""
_LONGEST = 500
"""Characters of one of them: four long sentences."""


@dataclass(frozen=True)
class Notice:
    """One thing that somebody should know.

    Attributes:
        key: what it is; the same on another night.
        text: for people, one line.
    """

    key: str
    text: str


def list_failures(outcome: Outcome) -> list[Notice]:
    """Logs without results, and what went wrong with the tables over all runs."""
    short = [line for line in outcome.lines if line.state in _SHORT]
    logs = [Notice(f"{line.state} {line.path} {line.code}", f"{line.path}: {line.reason}") for line in short]
    return [*logs, *map(note_error, outcome.problems)]


def note_error(error: Exception) -> Notice:
    """An error as something that somebody should know."""
    if not isinstance(error, SlipError):
        return Notice(f"error {type(error)}", f"unexpected error: {error!r}")
    return Notice(f"error {error.code} {error.where}", str(error))


def send_news(
    root: Path, command: str, notices: Sequence[Notice], report: Sequence[str], *, code: int
) -> tuple[Notice, ...]:
    """Send the user's command what is new since the last message; without news, nothing.

    Args:
        root: the results, which keep what was sent.
        command: a line for the shell; it gets the message, as `compose` makes it.
        notices: all that somebody should know tonight.
        report: what came out, line by line, for the end of the message.
        code: exit code of the batch.

    Returns:
        What was new.

    Raises:
        BatchError: ``notify_failed``; the next batch sends it again.
    """
    notes = Store(root).notes(_NOTES)
    before = (notes.read(_NOTE) or {}).get("keys")
    known = set(before) if isinstance(before, list) else set()
    news = tuple(notice for notice in notices if notice.key not in known)
    if news:
        as_before = len(notices) - len(news)
        subject, lines = compose(news, as_before, report, root)
        call_command(command, subject, lines, code=code, results=root)
    notes.write(_NOTE, {"keys": [notice.key for notice in notices]})
    return news


def compose(
    news: Sequence[Notice], as_before: int, report: Sequence[str], results: Path
) -> tuple[str, list[str]]:
    """Subject and lines of a message."""
    lines = [f"failed  {shorten(make_plain(notice.text), _LONGEST)}" for notice in news]
    lines = [
        *lines[:_MOST_NOTICES],
        *([f"and {len(lines) - _MOST_NOTICES} more"] * (len(lines) > _MOST_NOTICES)),
    ]
    lines += [f"as before: {as_before}, reported already"] * bool(as_before)
    subject = f"slip: {len(news)} failed ({make_plain(results.absolute().name)})"
    return subject, [*lines, "", *map(make_plain, report)]


def call_command(command: str, subject: str, lines: Sequence[str], *, code: int, results: Path) -> None:
    """Give a message to a command of the user.

    The message is its standard input; ``SLIP_SUBJECT``, ``SLIP_CODE`` (the exit code), ``SLIP_RESULTS`` and
    ``SLIP_JSON`` (``{"text": subject and message}``, as chats take it) are in its environment.

    Raises:
        BatchError: ``notify_failed``.
    """
    text = "\n".join([*lines, ""])
    variables = {
        "SLIP_SUBJECT": subject,
        "SLIP_CODE": str(code),
        "SLIP_RESULTS": str(results.absolute()),
        "SLIP_JSON": json.dumps({"text": f"{subject}\n{text}"}),
    }
    try:
        done = subprocess.run(  # noqa: S602 - the user's own command line, which a shell is to read
            command,
            shell=True,
            input=text,
            text=True,
            encoding="utf-8",
            errors="backslashreplace",
            env={**os.environ, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=_NOTIFY_S,
            check=False,
        )
        last = make_plain(next(iter(done.stdout.strip().splitlines()[-1:]), ""))
        said = f": {shorten(last, _LONGEST)}" if last else ""
        why = f"it ended with exit code {done.returncode}{said}" if done.returncode else ""
    except subprocess.TimeoutExpired:
        why = f"it took longer than {_NOTIFY_S:g} s"
    if why:
        hint = "The message is sent again after the next batch"
        raise BatchError("notify_failed", f"the command of --notify failed: {why}", where=command, hint=hint)
