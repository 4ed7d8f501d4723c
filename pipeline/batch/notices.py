"""What somebody should know after a batch, given once to a command of the user."""

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path

from pipeline.batch import BatchError
from pipeline.batch.batch_run import Outcome
from pipeline.core import make_plain, shorten
from pipeline.store import Store

_NOTIFY_S = 120.0
"""Time that the command of the user may take [s]: mail servers that do not answer give up after a minute."""
_NEWS = {"lossy", "refused", "failed", "quarantined", "left_out", "gone"}


def find_news(root: Path, outcome: Outcome) -> dict[str, str]:
    """Texts of what was not reported yet, by what they are about.

    These are logs without results or with losses, logs that cannot show slip or are gone, and problems of
    the batch.

    Args:
        root: the results, which keep what was reported.
        outcome: what came out.
    """
    raised = {
        f"{line.path} {line.code or line.reason}": f"{line.path}: {line.reason}"
        for line in outcome.lines
        if line.state in _NEWS
    }
    unfinished = outcome.list_unfinished()
    # Of a state with one cause, whose number of logs differs from night to night.
    raised |= {f"{one.code} {one.what.partition(': ')[2]}": one.what for one in unfinished}
    raised |= {f"{one.where} {one.code}": str(one) for one in outcome.problems}
    notes = Store(root).notes("batch/notified")
    sent = notes.read("sent") or {}
    # A batch that did not come to its logs knows nothing of them.
    if outcome.lines and not unfinished:
        notes.write("sent", {about: text for about, text in raised.items() if about in sent})
    return {about: text for about, text in raised.items() if about not in sent}


def send(root: Path, command: str, content: Mapping[str, object], news: Mapping[str, str]) -> None:
    """Give a command the JSON of a batch on its standard input, and remember what was reported.

    Args:
        root: the results.
        command: a line for the shell.
        content: the JSON.
        news: what is new in it.

    Raises:
        BatchError: ``notify_failed``; the next batch reports it again.
    """
    try:
        done = subprocess.run(  # noqa: S602 - the user's own command line, which a shell is to read
            command,
            shell=True,
            input=json.dumps(content).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=_NOTIFY_S,
            check=False,
        )
        last = make_plain(done.stdout.decode("utf-8", "backslashreplace").strip().rpartition("\n")[2])
        said = f": {shorten(last)}" if last else ""
        why = f"it ended with exit code {done.returncode}{said}" if done.returncode else ""
    except subprocess.TimeoutExpired:
        why = f"it took longer than {_NOTIFY_S:g} s"
    if why:
        hint = "The same is reported again after the next batch"
        raise BatchError("notify_failed", f"the command of --notify failed: {why}", where=command, hint=hint)
    notes = Store(root).notes("batch/notified")
    notes.write("sent", {**(notes.read("sent") or {}), **news})
