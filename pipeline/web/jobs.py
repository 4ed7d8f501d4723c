"""Analyses of dropped logs and diagnoses of stored runs, one at a time, each in a process with limits."""

import multiprocessing
import re
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pipeline.analysis import STAGE_WORDS, STAGES, Options
from pipeline.analysis.analyze import analyze_log, update_datasets
from pipeline.api import diagnose_together, read_run
from pipeline.batch import executors
from pipeline.batch.batch_work import Entry, Report, Task
from pipeline.core import SlipError, naming_os_errors, resolve_inside
from pipeline.store import UPLOADS, LogSighting, Manifest, Store, hold_lock
from pipeline.web import Limits, WorkbenchError
from pipeline.web.runs import find_run

DIAGNOSE, ANALYZE, SAMPLE = "diagnosis", "read", "sample"
"""Kinds of jobs, which stand in place of a fingerprint; each is called by its first stage."""
_WORDS = {
    SAMPLE: "driving a simulated Husky over tile",
    "upload": "receiving the log",
    **STAGE_WORDS,
    DIAGNOSE: "estimating effects",
}
_STEPS = ("upload", ANALYZE, *STAGES, DIAGNOSE, "report")
_HINTS = {
    "timed_out": "Give `slip serve` a longer --timeout, or run it in a terminal.",
    "out_of_memory": "Give `slip serve` more --memory, or look at the log with `slip inspect`.",
    "worker_died": "Look at the log with `slip inspect`; the other runs are unchanged.",
}
_ASKED = "vehicle"
"""Part of the codes of errors that the choice of a vehicle resolves."""
_CASE = "husky_tile"
_SPARE_BYTES = 200_000_000
"""Free space that a dropped log leaves on the disk [bytes], for its results."""
_END_S = 5.0
_LOCK = ".lock"
_PLAIN = re.compile(r"[^0-9A-Za-z._ -]")


def work(task: Task) -> Report:
    """Analyze a log, or diagnose a stored run."""
    options, store = task.options, Store(task.options.out)
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="done", run=options.run or "")
    try:
        if task.fingerprint == DIAGNOSE:
            manifest = find_run(store, entry.run)
            diagnose_together([read_run(manifest)], options.out)
            return Report(entry=entry)
        if task.fingerprint == SAMPLE:
            from pipeline.simulate import simulate_case  # noqa: PLC0415 - only for who has no log

            simulate_case(_CASE, out=task.path)
        outcome = analyze_log(task.path, options, partial(_note, task.path))
        update_datasets(store)
        state = "lossy" if outcome.lossy else "done"
        return Report(entry=replace(entry, run=outcome.manifest.run, state=state))
    except SlipError as error:
        reason = error.what if _ASKED in error.code else str(error)
        return Report(entry=replace(entry, state="failed", code=error.code, reason=reason, hint=error.hint))


def _note(log: Path, stage: str) -> None:
    """Say the stage of the analysis of a dropped log, in a file beside it."""
    (log.parents[1] / "stage").write_text(stage)


@dataclass
class Job:
    """The analysis of a dropped log, or a diagnosis.

    Attributes:
        id: id for the page.
        name: what the page calls it.
        stage: its first stage, or the one that the server is in.
        path: the log, or the folder of the run.
        total: size of the log [bytes].
        received: received size [bytes].
        began: start of the stage [s since 1970].
        run: name of the resulting run; empty until it exists.
        error: error as JSON; None without an error.
        done: whether it has ended.
        lossy: whether the log had losses.
        future: the worker's report; None before the worker starts.
    """

    id: str
    name: str
    stage: str
    path: Path
    total: int = 0
    received: int = 0
    began: float = field(default_factory=time.time)
    run: str = ""
    error: dict[str, str] | None = None
    done: bool = False
    lossy: bool = False
    future: Future[Report] | None = None

    def show(self) -> dict[str, object]:
        """The job as JSON."""
        stage, began = self.stage, self.began
        with suppress(OSError):
            note = self.path.parents[1] / "stage"
            stage, began = note.read_text() or stage, note.stat().st_mtime
        return {
            "id": self.id,
            "name": self.name,
            "stage": stage,
            "words": _WORDS.get(stage, stage),
            "step": _STEPS.index(stage) if stage in _STEPS else 0,
            "steps": len(_STEPS),
            "seconds": round(time.time() - began, 1),
            "received": self.received,
            "total": self.total,
            "run": self.run,
            "error": self.error,
            "done": self.done,
            "lossy": self.lossy,
        }


class Jobs:
    """All jobs since the server started.

    Args:
        results: the results folder.
        limits: limits of logs and their processing.
        diagnosis: whether a dropped log is also diagnosed.
        do: function of the worker process; importable by its name there.
    """

    def __init__(
        self, results: Path, limits: Limits, *, diagnosis: bool, do: Callable[[Task], Report] = work
    ) -> None:
        self._results = results.resolve()
        self._limits = limits
        self._diagnosis = diagnosis
        self._do = do
        self._jobs: dict[str, Job] = {}
        self._line = ThreadPoolExecutor(1)
        self._held = ExitStack()
        self._uploads = resolve_inside(self._results, UPLOADS)
        for folder in self._uploads.glob("*"):
            # The results are untrusted: a link out of them is not followed.
            if (folder / _LOCK).resolve() == folder / _LOCK:
                # What the server leaves that was killed; another one that lives holds its lock.
                with suppress(SlipError), hold_lock(folder / _LOCK, patience_s=0.0):
                    shutil.rmtree(folder, ignore_errors=True)
        self._folder = self._uploads / secrets.token_hex(8)

    def show(self) -> list[dict[str, object]]:
        """All jobs as JSON, the newest first."""
        return [job.show() for job in reversed(tuple(self._jobs.values()))]

    def dismiss(self, name: str) -> None:
        """Remove a job; what is being worked on is ended, and the results stay as they were."""
        job = self._jobs.pop(name, None)
        if job is not None and job.future is not None:
            job.future.cancel()
        if job is not None and job.done:
            self._delete(job)

    def close(self) -> None:
        """End all jobs, and delete the logs."""
        for name in tuple(self._jobs):
            self.dismiss(name)
        self._line.shutdown(cancel_futures=True)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._held.close()

    async def take(self, name: str, total: int, chunks: AsyncIterator[bytes]) -> Job:
        """Receive a log in chunks, and start its analysis.

        Args:
            name: file name from the browser.
            total: announced size [bytes].
            chunks: the content.

        Raises:
            WorkbenchError: ``no_length``, ``too_large``, ``disk_full``, or the log cannot be stored.
        """
        if total < 0:
            raise WorkbenchError("no_length", "the size of the log is not known", hint="Drop it again.")
        hint = "Run `slip analyze` on the file where it is; it appears here by itself."
        if total > self._limits.log_bytes:
            what = f"more than {self._limits.log_bytes / 1e6:.0f} MB are not taken in"
            raise WorkbenchError("too_large", what, where=name, hint=hint)
        self._results.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self._results).free
        if total + _SPARE_BYTES > free:
            what = f"the log has {total / 1e6:.0f} MB, the disk {free / 1e6:.0f} MB left"
            raise WorkbenchError("disk_full", what, where=name, hint=f"Free some space. {hint}")
        job = self._add_log(name, "upload", total)
        try:
            what, hint = "the log cannot be stored", "Free some space."
            guard = naming_os_errors(WorkbenchError, "upload_not_written", what, where=name, hint=hint)
            with guard, job.path.open("xb") as file:
                async for chunk in chunks:
                    file.write(chunk)
                    job.received += len(chunk)
        except BaseException:
            self._jobs.pop(job.id, None)
            self._delete(job)
            raise
        self._analyze(job, ANALYZE)
        return job

    def make_sample(self) -> Job:
        """Simulate a log with two hidden effects and analyze it, for users without a log."""
        job = self._add_log(f"{_CASE}.mcap", SAMPLE)
        self._analyze(job, SAMPLE)
        return job

    def retry(self, name: str, vehicle: str) -> Job:
        """Repeat an analysis with the vehicle that the user has chosen.

        Raises:
            WorkbenchError: ``no_such_job``.
        """
        job = self._jobs.get(name)
        if job is None or not job.done or not job.path.is_file():
            raise WorkbenchError("no_such_job", "that log is not waiting", hint="Drop it again.")
        self._analyze(job, ANALYZE, {"vehicle": {"preset": vehicle}})
        return job

    def diagnose(self, manifest: Manifest) -> Job:
        """Diagnose a stored run in the background.

        Raises:
            WorkbenchError: ``busy``, that is being done already.
        """
        name = f"diagnosis of {manifest.run}"
        if any(job.name == name and not job.done for job in tuple(self._jobs.values())):
            hint = "Wait for it."
            raise WorkbenchError("busy", "that is being done already", where=manifest.run, hint=hint)
        job = self._add(Job(secrets.token_hex(4), name, DIAGNOSE, manifest.folder))
        self._start(job, DIAGNOSE, Options(out=self._results, run=manifest.run))
        return job

    def _add(self, job: Job) -> Job:
        """Take a job; it replaces what failed before under its name, so that notices do not pile up."""
        for old in tuple(self._jobs.values()):
            if old.error is not None and old.name == job.name:
                self.dismiss(old.id)
        self._jobs[job.id] = job
        return job

    def _add_log(self, name: str, stage: str, total: int = 0) -> Job:
        if not self._folder.is_dir():
            self._folder.mkdir(parents=True, mode=0o700)
            self._held.enter_context(hold_lock(self._folder / _LOCK, patience_s=0.0))
        key = secrets.token_hex(4)
        path = self._folder / key / "dropped" / clean_name(name)
        path.parent.mkdir(parents=True)
        return self._add(Job(key, name[:200], stage, path, total))

    def _analyze(self, job: Job, kind: str, overrides: dict[str, dict[str, object]] | None = None) -> None:
        options = Options(out=self._results, overrides=overrides or {}, diagnosis=self._diagnosis)
        self._start(job, kind, options)

    def _start(self, job: Job, kind: str, options: Options) -> None:
        job.error, job.done, job.stage, job.began = None, False, kind, time.time()
        log = LogSighting(path=str(job.path), size=0, mtime_ns=0, inode=0, seen_ns=0)
        self._line.submit(self._run, job, Task(path=job.path, log=log, fingerprint=kind, options=options))

    def _run(self, job: Job, task: Task) -> None:
        code = ""
        try:
            limits = executors.Limits(self._limits.timeout_s, self._limits.memory_bytes)
            job.future = executors.open_executor("local", self._do, limits, 1).submit(task)
            if job.id not in self._jobs:
                job.future.cancel()
            entry = job.future.result().entry
            job.run, job.lossy = entry.run, entry.state == "lossy"
            code, reason, hint = entry.code, entry.reason, entry.hint
        except Exception as error:  # noqa: BLE001 - whoever waits for the job must hear that it has ended
            code, reason = executors.find_blame(task, error)
            hint = _HINTS.get(code, "Try it in a terminal.")
        if code:
            # The page offers a list instead of command-line options.
            reason = f"{reason}: choose it from the list" if _ASKED in code else reason
            message = reason.replace(str(task.path), job.name)
            job.run, job.error = "", {"code": code, "message": message, "hint": hint}
        # A process that was ended is gone before its files are.
        for process in multiprocessing.active_children():
            process.join(_END_S)
        # A log whose vehicle the user must choose is needed again.
        if not (_ASKED in code and job.id in self._jobs):
            self._delete(job)
        job.done = True

    def _delete(self, job: Job) -> None:
        if self._folder in job.path.parents:
            shutil.rmtree(job.path.parents[1], ignore_errors=True)


def clean_name(name: str) -> str:
    """A safe file name from that of a browser: its last part, plain characters, one suffix."""
    last = _PLAIN.sub("_", re.split(r"[/\\]", name)[-1]).strip(". ")[-100:]
    return f"{last.removesuffix('.mcap').strip('. ') or 'dropped'}.mcap"
