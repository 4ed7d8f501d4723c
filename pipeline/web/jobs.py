"""Analyses of uploaded logs, diagnoses and plans, in the background in a separate process."""

import hashlib
import multiprocessing
import secrets
import shutil
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from pipeline.analysis import STAGE_WORDS, STAGES, Options
from pipeline.analysis.analyze import analyze_log, update_datasets
from pipeline.batch import executors
from pipeline.batch.batch_work import Entry, Report, Task
from pipeline.core import SlipError
from pipeline.store import LogSighting, Manifest, Store, name_run, see_log
from pipeline.web import Limits, ServerFolders, WorkbenchError
from pipeline.web.stored_runs import Upload, Uploads, clean_name, find_run, write_diagnosis, write_run_plan

# Analyses and diagnoses run as the logs of a batch do, each in a process with limits of time and memory: a
# crash or a hang affects nothing else.

ASKED = "vehicle"
"""Part of the codes of errors that the choice of a vehicle resolves."""
DIAGNOSE = "diagnose"
PLAN = "plan"
ANALYZE = "analyze"

_LOOK_S = 0.2
_END_S = 5.0
_HINTS = {
    "timed_out": "Give `slip serve` a longer --timeout, or run it in a terminal.",
    "out_of_memory": "Give `slip serve` more --memory, or look at the log with `slip inspect`.",
    "worker_died": "Look at the log with `slip inspect`; the other runs are unchanged.",
}


@dataclass(frozen=True, kw_only=True)
class Errand(Task):
    """A task of the workbench; its kind (`DIAGNOSE`, `PLAN`, `ANALYZE`) stands in place of a fingerprint.

    Attributes:
        notes: file in which the worker stores the name of the current stage; None if it has only one.
        area: free area for a plan.
    """

    notes: Path | None
    area: str = ""


class Workers:
    """A process for each task, one at a time.

    Args:
        limits: limits of time and memory of a task.
        work: function to run; importable by its name in a new process.
    """

    def __init__(self, limits: Limits, work: Callable[[Task], Report] | None = None) -> None:
        self._limits = executors.Limits(limits.timeout_s, limits.memory_bytes)
        self._work = work or work_on_errand
        self._one_at_a_time = threading.Lock()
        self._closed = threading.Event()

    def run(self, errand: Errand, notify: Callable[[str], None], cancelled: threading.Event) -> Entry:
        """Run a task to its end.

        Args:
            errand: the task.
            notify: callback, called with the name of each stage.
            cancelled: when it is set, the worker process is ended.

        Raises:
            SlipError: the task failed, or its process was lost.
        """
        with self._one_at_a_time:
            if self._closed.is_set():
                raise WorkbenchError("closing", "the server is ending", hint="Start it again.")
            future = executors.open_executor("local", self._work, self._limits, 1).submit(errand)
            stage = ""
            while not future.done():
                if self._closed.is_set() or cancelled.is_set():
                    future.cancel()
                    for process in multiprocessing.active_children():
                        process.join(_END_S)
                    if self._closed.is_set():
                        raise WorkbenchError("closing", "the server is ending", hint="Start it again.")
                    raise WorkbenchError("cancelled", "it was cancelled", hint="Start it again.")
                wait([future], timeout=_LOOK_S)
                noted = _read_notes(errand)
                if noted not in {"", stage}:
                    stage = noted
                    notify(stage)
            error = future.exception()
            if error is not None:
                code, reason = executors.find_blame(errand, error)
                raise WorkbenchError(code, reason, hint=_HINTS.get(code, "Try it in a terminal."))
            entry = future.result().entry
        if entry.state == "failed":
            raise WorkbenchError(entry.code, entry.reason, hint=entry.hint)
        return entry

    def close(self) -> None:
        """End the process, even if it is busy."""
        self._closed.set()
        # The task that is running sees it, and ends its process.
        with self._one_at_a_time:
            pass


def _read_notes(errand: Errand) -> str:
    try:
        return "" if errand.notes is None else errand.notes.read_text(encoding="utf-8")
    except OSError:
        return ""


def work_on_errand(task: Task) -> Report:
    """Analyze a log, diagnose a stored run, or plan the next drive after it.

    Raises:
        SlipError: it cannot be done.
    """
    entry = Entry(log=task.log, fingerprint=task.fingerprint, state="failed", run=task.options.run or "")
    try:
        store = Store(task.options.out)
        if task.fingerprint == DIAGNOSE:
            write_diagnosis(task.options.out, find_run(store, entry.run))
        elif isinstance(task, Errand) and task.fingerprint == PLAN:
            write_run_plan(store, find_run(store, entry.run), task.area, partial(_note, task))
        else:
            return Report(entry=_analyze(task, entry))
        return Report(entry=replace(entry, state="done"))
    except SlipError as error:
        reason = f"{error.where}: {error.what}" if error.where else error.what
        return Report(entry=replace(entry, code=error.code, reason=reason, hint=error.hint))


def _note(task: Task, stage: str) -> None:
    """Report what is being done, which is optional."""
    with suppress(OSError):
        if isinstance(task, Errand) and task.notes is not None:
            task.notes.write_text(stage, encoding="utf-8")


def _analyze(task: Task, entry: Entry) -> Entry:
    outcome = analyze_log(task.path, task.options, partial(_note, task))
    update_datasets(Store(task.options.out))
    return replace(entry, state="lossy" if outcome.lossy else "done", run=outcome.manifest.run)


WORDS = {
    "sample": "driving a simulated Husky over tile",
    "upload": "receiving the log",
    **STAGE_WORDS,
    "diagnosis": "estimating effects",
    "plan": "planning the next drive",
}

_STEPS = ("upload", "read", *STAGES, "diagnosis", "report")
_MOST_JOBS = 50
_LONGEST_NAME = 200
_SAMPLE = "husky_tile"
_SAMPLE_BYTES = 20_000_000
_FOLDER = Path("/dropped")
"""Folder in the names of runs of uploaded logs (folder and name of the log); it need not exist."""


@dataclass
class Job:
    """One job: the analysis of an uploaded log, a diagnosis or a plan.

    Attributes:
        id: id for the page.
        name: name of the uploaded file.
        total: announced size [bytes].
        received: received size [bytes].
        stage: current stage.
        began: start time of the stage [s, monotonic].
        run: name of the resulting run; empty until it exists.
        error: error as JSON; None without an error.
        done: whether the job has ended.
        lossy: whether the log had losses.
        upload: the log, until it is analyzed, or while the user must choose its vehicle.
        sha256: hash of the log.
        is_stored: whether it works on a stored run, which stays as it is: it can be cancelled.
        cancelled: set when the user cancels it.
    """

    id: str
    name: str
    total: int = 0
    received: int = 0
    stage: str = "upload"
    began: float = field(default_factory=time.monotonic)
    run: str = ""
    error: dict[str, str] | None = None
    done: bool = False
    lossy: bool = False
    upload: Upload | None = None
    sha256: str = ""
    is_stored: bool = False
    cancelled: threading.Event = field(default_factory=threading.Event)

    @property
    def stops(self) -> bool:
        """Whether it can be cancelled."""
        return self.is_stored and not self.done

    def notify(self, stage: str) -> None:
        """Start a stage."""
        self.stage, self.began = stage, time.monotonic()

    def show(self) -> dict[str, object]:
        """The job as JSON."""
        return {
            "id": self.id,
            "name": self.name,
            "stage": self.stage,
            "words": WORDS.get(self.stage, self.stage),
            "step": _STEPS.index(self.stage) if self.stage in _STEPS else 0,
            "steps": len(_STEPS),
            "seconds": round(time.monotonic() - self.began, 1),
            "received": self.received,
            "total": self.total,
            "run": self.run,
            "error": self.error,
            "done": self.done,
            "stops": self.stops,
            "lossy": self.lossy,
        }


class Jobs:
    """All jobs since the server started: uploaded logs, diagnoses and plans.

    Args:
        results: the results folder.
        limits: limits of logs and their processing.
        diagnosis: whether an uploaded log is also diagnosed.
        work: function of the worker process; importable by its name there.
    """

    def __init__(
        self,
        results: Path,
        limits: Limits,
        *,
        diagnosis: bool,
        places: ServerFolders,
        work: Callable[[Task], Report] | None = None,
    ) -> None:
        self._results = results.resolve()
        self._diagnosis = diagnosis
        self._places = places
        self._jobs: dict[str, Job] = {}
        self._uploads = Uploads(results, limits)
        self._workers = Workers(limits, work)

    def show(self) -> list[dict[str, object]]:
        """All jobs as JSON, the newest first."""
        return [job.show() for job in reversed(tuple(self._jobs.values()))]

    def dismiss(self, name: str) -> None:
        """Remove a job that has ended; cancel one that works on a stored run, which leaves its results."""
        job = self._jobs.get(name)
        if job is not None and job.stops:
            job.cancelled.set()
        if job is not None and job.done:
            self._forget(job)

    def close(self) -> None:
        """End all jobs, and delete the logs."""
        self._workers.close()
        self._uploads.close()

    async def take(self, name: str, total: int, chunks: AsyncIterator[bytes]) -> Job:
        """Receive a log in chunks, and start its analysis.

        Args:
            name: file name from the browser.
            total: announced size [bytes].
            chunks: the content.

        Raises:
            WorkbenchError: too large or too many, not enough disk space, or the connection broke.
        """
        job = Job(secrets.token_hex(4), name[:_LONGEST_NAME], total)

        begin = partial(self._add, job)

        def notify(received: int) -> None:
            job.received = received

        try:
            job.upload, job.sha256 = await self._uploads.take(job.name, total, chunks, begin, notify)
        except BaseException:
            self._jobs.pop(job.id, None)
            raise
        self._start(job, job.upload, None)
        return job

    def make_sample(self) -> Job:
        """Simulate a log with two hidden effects and analyze it, for users without a log.

        Raises:
            WorkbenchError: too many logs are waiting, or there is not enough disk space.
        """
        job = Job(secrets.token_hex(4), f"{_SAMPLE}.mcap")
        job.upload = self._uploads.make_room(job.name, _SAMPLE_BYTES)
        job.notify("sample")
        self._add(job)
        self._begin(job, partial(self._simulate, job, job.upload))
        return job

    def _simulate(self, job: Job, upload: Upload) -> Errand:
        from pipeline.simulate import simulate_case  # noqa: PLC0415 - only for who has no log

        simulate_case(_SAMPLE, out=upload.path)
        job.sha256 = hashlib.sha256(upload.path.read_bytes()).hexdigest()
        job.notify("read")
        return self._make_analysis(upload, job.sha256, None)

    def retry(self, name: str, vehicle: str) -> Job:
        """Repeat an analysis with the vehicle that the user has chosen.

        Raises:
            WorkbenchError: ``no_such_job``.
        """
        job = self._jobs.get(name)
        if job is None or not job.done or job.upload is None:
            raise WorkbenchError("no_such_job", "that log is not waiting", hint="Drop it again.")
        self._start(job, job.upload, vehicle)
        return job

    def diagnose(self, manifest: Manifest) -> Job:
        """Diagnose a stored run in the background.

        Raises:
            WorkbenchError: ``busy``, the same job is already running.
        """
        return self._begin_on(manifest, f"diagnosis of {manifest.run}", "diagnosis", DIAGNOSE)

    def plan(self, manifest: Manifest, area: str) -> Job:
        """Plan the drive that decides the open questions of a stored run, in the background.

        Raises:
            WorkbenchError: ``busy``, the same job is already running.
        """
        return self._begin_on(manifest, f"plan after {manifest.run}", "plan", PLAN, area)

    def _begin_on(self, manifest: Manifest, name: str, stage: str, kind: str, area: str = "") -> Job:
        """Start a task on a stored run."""
        if any(job.name == name and not job.done for job in tuple(self._jobs.values())):
            raise WorkbenchError(
                "busy", "that is being done already", where=manifest.run, hint="Wait for it."
            )
        job = Job(secrets.token_hex(4), name, is_stored=True)
        job.notify(stage)
        self._add(job)
        notes = Path(tempfile.mkdtemp(prefix="slip-")) / "stage" if kind == PLAN else None
        self._begin(job, partial(self._make_errand, manifest, kind, area, notes), notes)
        return job

    def _add(self, job: Job) -> None:
        """Take a job; it replaces what failed before under its name, so that notices do not pile up."""
        self._jobs[job.id] = job
        for old in tuple(self._jobs.values()):
            replaced = old is not job and old.done and old.error is not None and old.name == job.name
            if replaced or (len(self._jobs) > _MOST_JOBS and old.done):
                self._forget(old)

    def _forget(self, job: Job) -> None:
        self._jobs.pop(job.id, None)
        if job.upload is not None:
            self._uploads.remove(job.upload)

    def _start(self, job: Job, upload: Upload, vehicle: str | None) -> None:
        job.error, job.done = None, False
        job.notify("read")
        self._begin(job, partial(self._make_analysis, upload, job.sha256, vehicle))

    def _begin(self, job: Job, prepare: Callable[[], Errand], notes: Path | None = None) -> None:
        threading.Thread(target=self._do, args=(job, prepare, notes), daemon=True).start()

    def _do(self, job: Job, prepare: Callable[[], Errand], notes: Path | None) -> None:
        try:
            entry = self._workers.run(prepare(), job.notify, job.cancelled)
            job.run, job.lossy = entry.run, entry.state == "lossy"
        except SlipError as error:
            code, upload = error.code, job.upload
            message = str(error)
            if ASKED in code:
                # The page offers a list instead of command-line options.
                message = f"{error.what}: choose it from the list"
            message = message if upload is None else message.replace(str(upload.path), job.name)
            job.error = {"code": code, "message": self._places.hide(message), "hint": error.hint}
        except Exception as error:  # noqa: BLE001 - whoever waits for the job must hear that it has ended
            message = self._places.hide(f"{type(error).__name__}: {error}")
            job.error = {"code": "failed", "message": message, "hint": "Try it in a terminal."}
        finally:
            # A log whose vehicle the user must choose is needed again.
            waits = job.error is not None and ASKED in job.error["code"]
            if job.upload is not None and not waits:
                self._uploads.remove(job.upload)
                job.upload = None
            if notes is not None:
                shutil.rmtree(notes.parent, ignore_errors=True)
            job.done = True
            if job.cancelled.is_set():
                self._forget(job)

    def _make_analysis(self, upload: Upload, sha256: str, vehicle: str | None) -> Errand:
        store = Store(self._results)
        options = Options(
            out=self._results,
            run=name_run(_FOLDER / clean_name(upload.name), sha256, store),
            overrides={"vehicle": {"preset": vehicle}} if vehicle else {},
            diagnosis=self._diagnosis,
        )
        log = see_log(upload.path)
        return Errand(path=upload.path, log=log, fingerprint=ANALYZE, options=options, notes=upload.notes)

    def _make_errand(self, manifest: Manifest, kind: str, area: str, notes: Path | None) -> Errand:
        options = Options(out=self._results, run=manifest.run)
        log = LogSighting(path=manifest.run, size=0, mtime_ns=0, inode=0, seen_ns=0)
        return Errand(
            path=manifest.folder, log=log, fingerprint=kind, options=options, notes=notes, area=area
        )
