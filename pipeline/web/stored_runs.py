"""Stored runs for the page (list, plans, diagnoses), and logs that are uploaded through it."""

import asyncio
import hashlib
import os
import re
import secrets
import shutil
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pipeline.core import (
    INPUTS,
    SlipError,
    mapping_in,
    naming_os_errors,
    objects_in,
    read_object,
    resolve_inside,
)
from pipeline.estimation.stored_diagnosis import (
    diagnose_stored,
    find_diagnosis,
    keep_diagnosis,
    read_recording,
    read_stored_diagnosis,
)
from pipeline.report.drive_pages import PREVIEW, leave_plan, locate_plan, read_preview
from pipeline.results import RunDiagnosis, find_refusal, read_findings
from pipeline.store import DIAGNOSIS, MANIFEST, UPLOADS, Manifest, Store, StoreError, hold_lock
from pipeline.web import Limits, WorkbenchError

_LONGEST = 500
"""Largest number of characters of a text from a log; longer ones are cut on the page."""

_KEYS = (
    "vehicle",
    "vehicle_name",
    "terrain",
    "dataset",
    "median_modulus",
    "length_scale_m",
    "distance_m",
    "leading_input",
    "verdict",
)


def list_runs(store: Store) -> dict[str, object]:
    """Every run with the values that the list shows and sorts by, and the runs that cannot be read."""
    survey = store.survey()
    return {
        "runs": [summarize_run(manifest) for manifest in survey.manifests],
        "errors": [{"code": error.code, "message": str(error)} for error in survey.errors],
    }


def summarize_run(manifest: Manifest) -> dict[str, object]:
    """Values of one run for the list."""
    summary = read_summary(manifest)
    log = mapping_in(summary, "log")
    return {
        "run": manifest.run,
        "analyzed_s": _find_age(manifest),
        **{key: _cut(summary.get(key)) for key in _KEYS},
        "sha256": _cut(log.get("sha256")),
        "duration_s": _cut(log.get("duration_s")),
        "complete": log.get("complete") is True,
        "losses": _cut_all(log, "losses", ("kind", "text")),
        "findings": _cut_all(summary, "findings", ("id", "severity", "text")),
        "refusal": _cut(find_refusal(read_findings(summary))),
        "report": "report.html" in manifest.files,
    }


def _find_age(manifest: Manifest) -> float:
    """When the results of a run were written [s]; 0 if that is not known."""
    try:
        return (manifest.folder.parent / MANIFEST).stat().st_mtime
    except OSError:
        return 0.0


def _cut_all(of: Mapping[str, object], name: str, keys: tuple[str, ...]) -> list[dict[str, object]]:
    return [{key: _cut(entry.get(key)) for key in keys} for entry in objects_in(of, name)]


def _cut(value: object) -> object:
    """A number, or a text cut to the largest length; None for anything else."""
    if isinstance(value, str):
        return value if len(value) <= _LONGEST else f"{value[:_LONGEST]} \u2026"
    return value if isinstance(value, int | float) else None


def read_summary(manifest: Manifest) -> dict[str, object]:
    """The stored summary; empty if there is none, or if it is unreadable."""
    return read_json(manifest.path("summary.json")) if "summary.json" in manifest.files else {}


def read_json(path: Path) -> dict[str, object]:
    """The object in a file; empty if there is none, or if it contains an unpaired surrogate."""
    content = read_object(path)
    try:
        msgspec.json.encode(content)
    except (ValueError, RecursionError):
        return {}
    return content


def find_run(store: Store, run: str) -> Manifest:
    """The current results of a run.

    Raises:
        WorkbenchError: ``no_such_run``.
    """
    manifest = store.manifest(run) if run else None
    if manifest is None:
        raise WorkbenchError(
            "no_such_run", "there is no such run", where=run, hint="Choose one of the list, or drop a log."
        )
    return manifest


KINDS = {
    "plan.html": "text/html",
    PREVIEW: "application/json",
    "plan.toml": "application/toml",
    "plan.csv": "text/csv",
    "plan.mcap": "application/octet-stream",
}
"""Files of a plan, with their media types."""
_TIME = "60s"


def write_run_plan(store: Store, manifest: Manifest, area: str, notify: Callable[[str], None]) -> None:
    """Plan the drive that decides the open questions of a stored run; this takes many seconds.

    Args:
        store: the results.
        manifest: manifest of the run.
        area: free area, as `20x10m`.
        notify: called with what is being done.

    Raises:
        SlipError: the run cannot be diagnosed, or no drive fits into the area.
    """
    from pipeline import plan  # noqa: PLC0415 - heavy

    vehicle, recording = read_recording(manifest)
    ground, seconds = plan.parse_area(area, vehicle), plan.parse_time(_TIME)
    studied = plan.study([recording], vehicle, notify)
    limits = plan.choose_limits(vehicle, studied.largest)
    played = plan.choose_topic(vehicle, manifest)
    made = plan.make_plan(studied, limits, ground, seconds, played, notify)
    leave_plan(store, manifest, made)


def find_plan(results: Path, manifest: Manifest) -> str | None:
    """Version of the run's plan, which changes with every new plan; None if these results have none."""
    if not read_preview(results, manifest.run, manifest.key):
        return None
    return str(find_file(results, manifest.run, PREVIEW).stat().st_mtime_ns)


def find_file(results: Path, run: str, name: str) -> Path:
    """Path of a file of a run's plan; it need not exist.

    Raises:
        WorkbenchError: ``no_plan``: a plan has no such file.
        PathError: a link leads out of the results.
    """
    if name not in KINDS:
        raise WorkbenchError("no_plan", "a plan has no such file", where=run, hint="Open the run again.")
    return locate_plan(results, run, name)


def read_diagnosis(results: Path, manifest: Manifest) -> RunDiagnosis | None:
    """The stored diagnosis of a run; None if it has not been diagnosed, or if that cannot be read."""
    if DIAGNOSIS not in manifest.files:
        return find_diagnosis(results, manifest)
    try:
        return read_stored_diagnosis(manifest)
    except StoreError:
        return None


def write_diagnosis(results: Path, manifest: Manifest) -> None:
    """Diagnose a stored run and store the diagnosis with the results; this takes many seconds.

    Raises:
        SlipError: the run cannot be diagnosed.
    """
    keep_diagnosis(results, manifest, diagnose_stored([manifest], INPUTS, None, None, None))


# Uploaded logs are limited in size and number, and are deleted after their analysis.
#
# They are stored in a folder of this server, under generated names. Files of a killed server are deleted when
# the next one starts.

_LOCK = ".lock"
_NAME_BYTES = 8
_OWN_NAME = re.compile(rf"[0-9a-f]{{{2 * _NAME_BYTES}}}")
_SPARE_BYTES = 200_000_000
_LOST_NAME = "dropped.mcap"
_PLAIN = re.compile(r"[^0-9A-Za-z._ -]")


@dataclass(frozen=True)
class Upload:
    """An uploaded log, complete or in transfer.

    Attributes:
        folder: its own folder, which is deleted with it.
        name: file name from the browser, for display; never a path.
        total: announced size [bytes].
    """

    folder: Path
    name: str
    total: int

    @property
    def path(self) -> Path:
        """Path of the log."""
        return self.folder / "log.mcap"

    @property
    def notes(self) -> Path:
        """Path of the file with the current stage of its analysis."""
        return self.folder / "stage"


class Uploads:
    """All uploaded logs that are not yet processed.

    Args:
        results: the results folder.
        limits: limits of number and size.
    """

    def __init__(self, results: Path, limits: Limits) -> None:
        self._results = results
        self._limits = limits
        self._known: dict[str, Upload] = {}
        self._held = ExitStack()
        self._folder: Path | None = None
        self._root = resolve_inside(results.resolve(), UPLOADS)
        _sweep(self._root)

    async def take(
        self,
        name: str,
        total: int,
        chunks: AsyncIterator[bytes],
        begin: Callable[[], None],
        notify: Callable[[int], None],
    ) -> tuple[Upload, str]:
        """Receive a log in chunks.

        Args:
            name: file name from the browser.
            total: announced size [bytes].
            chunks: the content.
            begin: called once when the log is accepted.
            notify: called with the number of received bytes.

        Returns:
            The log and its SHA-256.

        Raises:
            WorkbenchError: too large or too many, not enough disk space, or the connection broke; the
                received data are then deleted.
        """
        what, hint = "the log cannot be stored", "Free some space."
        with naming_os_errors(WorkbenchError, "upload_not_written", what, where=name, hint=hint):
            upload = self.make_room(name, total)
            try:
                begin()
                return upload, await self._fill(upload, chunks, notify)
            except BaseException:
                self.remove(upload)
                raise

    def make_room(self, name: str, total: int) -> Upload:
        """Make a folder for a log.

        Args:
            name: name of the log, for display.
            total: size of the log [bytes].

        Raises:
            WorkbenchError: too large or too many, or not enough disk space.
            OSError: the folder cannot be made.
        """
        self._check_quota(name, total)
        self._check_room(name, total)
        upload = Upload(self._open() / secrets.token_hex(_NAME_BYTES), name, total)
        upload.folder.mkdir()
        self._known[upload.folder.name] = upload
        return upload

    def remove(self, upload: Upload) -> None:
        """Delete a log."""
        self._known.pop(upload.folder.name, None)
        shutil.rmtree(upload.folder, ignore_errors=True)

    def close(self) -> None:
        """Delete all logs."""
        for upload in tuple(self._known.values()):
            self.remove(upload)
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._held.close()

    def _open(self) -> Path:
        """This server's private folder; locked, so that no other server deletes it."""
        if self._folder is None or not self._folder.is_dir():
            folder = self._root / secrets.token_hex(_NAME_BYTES)
            folder.mkdir(parents=True, mode=0o700)
            self._held.enter_context(hold_lock(folder / _LOCK, patience_s=0.0))
            self._folder = folder
        return self._folder

    async def _fill(self, upload: Upload, chunks: AsyncIterator[bytes], notify: Callable[[int], None]) -> str:
        received, digest = 0, hashlib.sha256()
        with upload.path.open("xb") as file:
            try:
                while True:
                    async with asyncio.timeout(self._limits.silence_s):
                        chunk = await anext(chunks, None)
                    if chunk is None:
                        break
                    received += len(chunk)
                    if received > upload.total:
                        break
                    digest.update(chunk)
                    file.write(chunk)
                    notify(received)
            except TimeoutError:
                pass
        if received != upload.total:
            hint = "Drop it again."
            raise WorkbenchError(
                "upload_broken", f"{received} of {upload.total} bytes came", where=upload.name, hint=hint
            )
        return digest.hexdigest()

    def _check_quota(self, name: str, total: int) -> None:
        held = sum(upload.total for upload in self._known.values())
        if total > self._limits.log_bytes:
            raise WorkbenchError(
                "too_large",
                f"more than {self._limits.log_bytes / 1e6:.0f} MB are not taken in",
                where=name,
                hint="Run `slip analyze` on the file where it is; it appears here by itself.",
            )
        if len(self._known) >= self._limits.logs or held + total > self._limits.all_bytes:
            raise WorkbenchError(
                "too_many",
                f"{len(self._known)} logs of together {held / 1e6:.0f} MB wait here already",
                where=name,
                hint="Wait until they are analyzed, or dismiss those that failed.",
            )

    def _check_room(self, name: str, total: int) -> None:
        self._results.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self._results).free
        if total + _SPARE_BYTES > free:
            raise WorkbenchError(
                "disk_full",
                f"the log has {total / 1e6:.0f} MB, the disk {free / 1e6:.0f} MB left",
                where=name,
                hint="Free some space, or run `slip analyze` on the file where it is.",
            )


def _sweep(root: Path) -> None:
    """Delete folders of servers that have ended, whose locks are free."""
    for folder in root.glob("*"):
        # The results are untrusted: follow no links out of them, and remove nothing else.
        if not _OWN_NAME.fullmatch(folder.name) or (folder / _LOCK).resolve() != folder / _LOCK:
            continue
        try:
            with hold_lock(folder / _LOCK, patience_s=0.0):
                shutil.rmtree(folder, ignore_errors=True)
        except SlipError:
            # Its server is still running.
            continue


def clean_name(name: str) -> str:
    """A safe file name from that of a browser: its last part, plain characters, one suffix."""
    last = os.path.basename(name.replace("\\", "/"))  # noqa: PTH119 - the text need not be a path here
    plain = _PLAIN.sub("_", last).strip(". ")[-100:]
    stem = plain.removesuffix(".mcap").strip(". ") or _LOST_NAME.removesuffix(".mcap")
    return f"{stem}.mcap"
