"""Recipes that run a batch every night: for systemd, cron, Airflow and the Actions of GitHub."""

import json
import re
import shlex
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

from pipeline.batch import BatchError

System = Literal["systemd", "cron", "airflow", "github"]

_CLOCK = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)")
_STOP_S = 120
_DIED = "slip batch was ended before it could say anything"
_DIED_JSON = json.dumps({"text": _DIED})


@dataclass(frozen=True, kw_only=True)
class Nightly:
    """Program to run nightly.

    Attributes:
        program: the program and its first arguments, absolute.
        arguments: arguments of ``slip batch``.
        folder: working folder, to which relative paths in the arguments refer.
        lock: lock file that prevents a second instance.
        hour: hour of the day; local time for systemd and cron, UTC for the others.
        minute: minute of the hour.
        notify: shell command that gets failures; None for none.
    """

    program: Sequence[str]
    arguments: Sequence[str]
    folder: Path
    lock: Path
    hour: int
    minute: int
    notify: str | None = None

    @property
    def command(self) -> list[str]:
        """The words of the batch."""
        notified = [] if self.notify is None else ["--notify", self.notify]
        return [*self.program, "batch", "run", *notified, *self.arguments]

    @property
    def guarded(self) -> list[str]:
        """The words of the batch, behind the lock: a second one at the same time ends at once, with 0."""
        return ["flock", "--nonblock", "--conflict-exit-code", "0", str(self.lock), *self.command]


def parse_clock(text: str) -> tuple[int, int]:
    """Hour and minute of ``02:30``.

    Raises:
        BatchError: ``bad_time``.
    """
    match = _CLOCK.fullmatch(text)
    if match is None:
        raise BatchError("bad_time", f"{text!r} is not a time of day", hint="Write HH:MM, for example 02:30")
    return int(match[1]), int(match[2])


def print_units(nightly: Nightly, system: System) -> str:
    """Return the recipe as text, with comments on where to install it.

    Args:
        nightly: program and time.
        system: ``systemd`` for a service and its timer, ``cron`` for lines of a crontab, ``airflow`` for a
            DAG, ``github`` for a workflow of GitHub Actions.

    Raises:
        BatchError: ``bad_word``, a path or an argument that the format cannot represent.
    """
    for word in (*nightly.command, str(nightly.folder), str(nightly.lock)):
        _require_one_line(word)
    fill = {"systemd": _fill_systemd, "cron": _fill_cron, "airflow": _fill_airflow, "github": _fill_github}
    return _read(system).format(hour=nightly.hour, minute=nightly.minute, **fill[system](nightly))


def _read(name: str) -> str:
    return resources.files("pipeline.batch").joinpath("nightly", f"{name}.in").read_text("utf-8")


def _fill_systemd(nightly: Nightly) -> dict[str, object]:
    # A service is never started twice; the lock also excludes batches started by hand. The folder ends in a
    # slash because a backslash or a space at the end of a line would be misread.
    flock, *rest = nightly.guarded
    folder = _escape_systemd(str(nightly.folder))
    died = ""
    if nightly.notify is not None:
        variables = {"SLIP_SUBJECT": _DIED, "SLIP_JSON": _DIED_JSON}
        died = _read("died").format(
            folder=folder,
            environment="\n".join(
                f"Environment={_quote_systemd(f'{name}={value}', is_command=False)}"
                for name, value in variables.items()
            ),
            text=f"{_DIED}: journalctl --user -u slip-batch",
            notify=_quote_systemd(nightly.notify),
        )
    return {
        "folder": folder,
        "command": " ".join(_quote_systemd(word) for word in [f"/usr/bin/{flock}", *rest]),
        "stop_s": _STOP_S,
        "on_failure": "OnFailure=slip-batch-died.service\n" if died else "",
        "died": died,
    }


def _fill_cron(nightly: Nightly) -> dict[str, object]:
    command = " ".join(_quote_cron(word) for word in nightly.guarded)
    if nightly.notify is not None:
        # Failures (1) were sent by the batch itself.
        subject, notify = _quote_cron(_DIED), _quote_cron(nightly.notify)
        send = f"echo {subject} | SLIP_SUBJECT={subject} SLIP_JSON={_quote_cron(_DIED_JSON)} sh -c {notify}"
        command = f"{{ {command}; case $? in 0|1|3) ;; *) {send};; esac; }}"
    return {"line": f"cd {_quote_cron(str(nightly.folder))} && {command} 2>&1 | logger --tag slip-batch"}


def _fill_airflow(nightly: Nightly) -> dict[str, object]:
    return {"command": nightly.guarded, "folder": str(nightly.folder)}


def _fill_github(nightly: Nightly) -> dict[str, object]:
    script = f"cd {shlex.quote(str(nightly.folder))} && {shlex.join(nightly.guarded)} || [ $? -eq 3 ]"
    # A string of JSON is one of YAML; what would be an expression of Actions is written as one that gives it.
    return {"run": json.dumps(script, ensure_ascii=False).replace("${{", "${{ '${{' }}")}


def _require_one_line(word: str) -> None:
    """Reject control characters and names that are not UTF-8, which recipes cannot represent."""
    if any(unicodedata.category(character) in {"Cc", "Cs", "Zl", "Zp"} for character in word):
        raise BatchError(
            "bad_word",
            f"{word!r} holds a line break or another character that cannot stand in a unit or a crontab",
            hint="Rename the file or folder",
        )


def _quote_cron(word: str) -> str:
    r"""Quote a word of a crontab command so that every cron and the shell behind it read it alike.

    A bare percent sign ends the command. Some crons remove the backslash before it, some keep it: it is
    placed outside of quotes, where the shell removes it. Some crons turn two backslashes into one, so two
    never follow each other.
    """
    if re.fullmatch(r"[A-Za-z0-9_@+=:,./-]+", word):
        return word
    single = word.replace("'", "'\"'\"'").replace("\\", "\\''").replace("%", "'\\%'")
    return f"'{single}'"


def _escape_systemd(text: str) -> str:
    return text.replace("%", "%%")


def _quote_systemd(word: str, *, is_command: bool = True) -> str:
    """Quote a word of a line of a unit if needed; its % and, in a command, its $ are literal."""
    plain = _escape_systemd(word)
    plain = plain.replace("$", "$$") if is_command else plain
    if re.fullmatch(r"[A-Za-z0-9_@%+=:,./$-]+", plain):
        return plain
    escaped = plain.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
