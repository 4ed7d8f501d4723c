"""Logs that were dropped on the page: taken in piece by piece, then analyzed, with progress."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pipeline.core.errors import SlipError
from pipeline.job.analyze import analyze_log, update_datasets
from pipeline.job.options import STAGES, Options
from pipeline.store import Store
from pipeline.workbench.desk import FOLDER
from pipeline.workbench.diagnoses import write_diagnosis
from pipeline.workbench.errors import WorkbenchError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from pipeline.store import Manifest

WORDS = {
    "upload": "taking the log in",
    "read": "reading the log",
    "extract": "extracting commands and poses",
    "align": "putting clocks and scales right",
    "velocity": "differentiating poses",
    "slip": "computing slip",
    "aggregate": "aggregating",
    "diagnosis": "naming what is missing",
    "report": "drawing the report",
}

_STEPS = ("upload", "read", *STAGES, "diagnosis", "report")
_SPARE_BYTES = 200_000_000
_MOST_JOBS = 50
_LOST_NAME = "dropped.mcap"
_PLAIN = re.compile(r"[^0-9A-Za-z._ -]")


@dataclass
class Job:
    """One log on its way to a run.

    Attributes:
        id: for the page.
        name: of the file, as dropped.
        path: where it stands.
        total: bytes that were announced.
        received: bytes that have come.
        stage: what is being done.
        began: when the stage began [s, monotonic].
        run: the run it became; empty until then.
        error: what went wrong, as JSON; None while nothing did.
        done: whether it has ended.
        lossy: whether the log had losses.
    """

    id: str
    name: str
    path: Path
    total: int
    received: int = 0
    stage: str = "upload"
    began: float = field(default_factory=time.monotonic)
    run: str = ""
    error: dict[str, str] | None = None
    done: bool = False
    lossy: bool = False

    def tell(self, stage: str) -> None:
        """Go on to a stage."""
        self.stage, self.began = stage, time.monotonic()

    def show(self) -> dict[str, object]:
        """As JSON."""
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
            "lossy": self.lossy,
        }


class Jobs:
    """All logs that were dropped since the server started.

    Args:
        results: the results folder.
        most_bytes: the largest log that is taken in.
        diagnosis: whether a dropped log is diagnosed too.
    """

    def __init__(self, results: Path, most_bytes: int, *, diagnosis: bool) -> None:
        self._results = results
        self._most = most_bytes
        self._diagnosis = diagnosis
        self._jobs: dict[str, Job] = {}
        self._one_at_a_time = threading.Lock()

    def show(self) -> list[dict[str, object]]:
        """All jobs as JSON, the newest first."""
        return [job.show() for job in reversed(self._jobs.values())]

    def dismiss(self, name: str) -> None:
        """Forget a job that has ended."""
        if name in self._jobs and self._jobs[name].done:
            del self._jobs[name]

    async def take(self, name: str, total: int, chunks: AsyncIterator[bytes]) -> Job:
        """Take a log in, piece by piece, and begin to analyze it.

        Args:
            name: of the file; only its last part is used, and only plain characters of it.
            total: bytes that were announced.
            chunks: the content.

        Raises:
            WorkbenchError: too large, no room on the disk, or the connection broke.
        """
        self._check_room(name, total)
        folder = self._results.resolve() / FOLDER / "uploads" / secrets.token_hex(4)
        # A run is called after its log's folder and name.
        place = folder / "dropped"
        place.mkdir(parents=True)
        job = Job(folder.name, name, place / clean_name(name), total)
        self._jobs[job.id] = job
        while len(self._jobs) > _MOST_JOBS:
            self._jobs.pop(next(iter(self._jobs)))
        try:
            await self._fill(job, chunks)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            self._jobs.pop(job.id, None)
            if isinstance(error, OSError):
                raise WorkbenchError(
                    "upload_not_written",
                    f"the log cannot be kept: {error.strerror}",
                    where=name,
                    hint="Free some space.",
                ) from error
            raise
        self.start(job, None)
        return job

    async def _fill(self, job: Job, chunks: AsyncIterator[bytes]) -> None:
        part = job.path.with_name(f".{job.path.name}.part")
        with part.open("wb") as file:
            async for chunk in chunks:
                job.received += len(chunk)
                if job.received > self._most:
                    raise self._too_large(job.name)
                file.write(chunk)
        if job.received != job.total:
            raise WorkbenchError(
                "upload_broken",
                f"{job.received} of {job.total} bytes came",
                where=job.name,
                hint="Drop it again.",
            )
        part.replace(job.path)

    def start(self, job: Job, vehicle: str | None) -> None:
        """Analyze the log of a job in the background."""
        job.error, job.done = None, False
        threading.Thread(target=self._analyze, args=(job, vehicle), daemon=True).start()

    def retry(self, name: str, vehicle: str) -> Job:
        """Analyze again, now that the vehicle is known.

        Raises:
            WorkbenchError: ``no_such_job``.
        """
        job = self._jobs.get(name)
        if job is None or not job.done or job.error is None:
            raise WorkbenchError("no_such_job", "that log is not waiting", hint="Drop it again.")
        self.start(job, vehicle)
        return job

    def diagnose(self, manifest: Manifest) -> Job:
        """Name what is missing from the model of a stored run, in the background.

        Raises:
            WorkbenchError: ``busy``, that is being done already.
        """
        name = f"diagnosis of {manifest.run}"
        if any(job.name == name and not job.done for job in self._jobs.values()):
            raise WorkbenchError(
                "busy", "that is being done already", where=manifest.run, hint="Wait for it."
            )
        job = Job(secrets.token_hex(4), name, manifest.folder, 0)
        job.tell("diagnosis")
        self._jobs[job.id] = job
        threading.Thread(target=self._diagnose, args=(job, manifest), daemon=True).start()
        return job

    def _diagnose(self, job: Job, manifest: Manifest) -> None:
        try:
            with self._one_at_a_time:
                write_diagnosis(self._results, manifest)
            job.run = manifest.run
        except SlipError as error:
            job.error = {"code": error.code, "message": str(error), "hint": error.hint}
        finally:
            job.done = True

    def _analyze(self, job: Job, vehicle: str | None) -> None:
        job.tell("read")
        overrides = {"vehicle": {"preset": vehicle}} if vehicle else {}
        options = Options(out=self._results, overrides=overrides, diagnosis=self._diagnosis)
        try:
            with self._one_at_a_time:
                outcome = analyze_log(job.path, options, job.tell)
                update_datasets(Store(self._results))
            job.run, job.lossy = outcome.manifest.run, outcome.lossy
        except SlipError as error:
            job.error = {"code": error.code, "message": str(error), "hint": error.hint}
        except Exception as error:  # noqa: BLE001 - a log must not take the server down, whatever is in it
            job.error = {
                "code": "failed",
                "message": f"{type(error).__name__}: {error}",
                "hint": "Try `slip analyze` on it.",
            }
        finally:
            job.done = True

    def _check_room(self, name: str, total: int) -> None:
        if total > self._most:
            raise self._too_large(name)
        self._results.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self._results).free
        if total + _SPARE_BYTES > free:
            raise WorkbenchError(
                "disk_full",
                f"the log has {total / 1e6:.0f} MB, the disk {free / 1e6:.0f} MB left",
                where=name,
                hint="Free some space, or run `slip analyze` on the file where it is.",
            )

    def _too_large(self, name: str) -> WorkbenchError:
        return WorkbenchError(
            "too_large",
            f"more than {self._most / 1e6:.0f} MB are not taken in",
            where=name,
            hint="Run `slip analyze` on the file where it is; it appears here by itself.",
        )


def clean_name(name: str) -> str:
    """A file name out of whatever a browser sends: its last part, plain characters, one suffix."""
    last = os.path.basename(name.replace("\\", "/"))  # noqa: PTH119 - the text need not be a path here
    plain = _PLAIN.sub("_", last).strip(". ")[-100:]
    stem = plain.removesuffix(".mcap").strip(". ") or _LOST_NAME.removesuffix(".mcap")
    return f"{stem}.mcap"
