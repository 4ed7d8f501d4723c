"""A process that runs cases of the command line: limited in memory, started anew when it hangs or dies."""

import contextlib
import os
import resource
import sys
import tempfile
import traceback
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

HANG_S = 60.0
MEMORY = 8 << 30
CASES_A_WORKER = 400


@dataclass(frozen=True)
class Answer:
    """What came of a case: exit code (None for a crash or a hang), both outputs, the traceback of a crash."""

    code: int | None
    out: str = ""
    err: str = ""
    crash: str = ""


def work(pipe: Connection, home: str) -> None:
    """A worker: runs cases until it is told to stop."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    os.environ |= {"HOME": home, "XDG_CACHE_HOME": f"{home}/.cache", "POLARS_MAX_THREADS": "1"}
    from pipeline.cli import main as slip  # noqa: PLC0415 - after the environment is set

    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        while (given := pipe.recv()) is not None:
            folder, arguments = given
            os.chdir(folder)
            code: object = None
            crash = ""
            try:
                slip(arguments)
            except SystemExit as end:
                code = 0 if end.code is None else end.code
            except BaseException:  # noqa: BLE001 - that is what is looked for
                crash = traceback.format_exc()
            sys.stdout.flush()
            sys.stderr.flush()
            texts = []
            for stream in (out, err):
                stream.seek(0)
                texts.append(stream.read().decode("utf-8", "replace"))
                stream.seek(0)
                stream.truncate()
            pipe.send(Answer(code if isinstance(code, int) else None, *texts, crash or f"exit code {code!r}"))


class Worker:
    """A process that runs cases, started anew when it hangs, dies or has run many."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._cases = 0
        self._start()

    def _start(self) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=work, args=(theirs, str(self._home)), daemon=True)
        self._process.start()
        theirs.close()

    def run(self, folder: Path, arguments: list[str]) -> Answer:
        """Run one case."""
        self._cases += 1
        if self._cases % CASES_A_WORKER == 0:
            self.end()
            self._start()
        answer = Answer(None, crash=f"it hung for {HANG_S:g} s")
        try:
            self._pipe.send((str(folder), arguments))
            if self._pipe.poll(HANG_S):
                found: Answer = self._pipe.recv()
                return found
        except (EOFError, OSError):
            self._process.join(10.0)
            answer = Answer(None, crash=f"the process died with {self._process.exitcode}")
        self.end()
        self._start()
        return answer

    def end(self) -> None:
        """End the process."""
        with contextlib.suppress(OSError):
            self._pipe.send(None)
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()
