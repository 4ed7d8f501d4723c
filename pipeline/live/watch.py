"""Analysis of a recording while it is written: scheduling of updates, and the knowledge so far."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import msgspec
import polars as pl

from pipeline.analysis import Options
from pipeline.analysis.work import as_recorded, identify
from pipeline.core import SlipError, make_plain, read_object, return_freed_memory, shorten
from pipeline.estimation.stored_diagnosis import add_model
from pipeline.live import LiveError
from pipeline.logs import SUFFIXES, LogError, list_files, read_topics
from pipeline.logs.index import GrowingLog, find_parts
from pipeline.models import read_model
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.results import RunDiagnosis, read_result
from pipeline.run import read_drive
from pipeline.stages import Finding, Given, align_tables, extract_tables, list_wanted, slip_stage, velocity
from pipeline.store import JSON, Store, check_table

Content = Mapping[str, object]

TAIL_S = 120.0
"""Length of the end of the log that a light update reads [s]: enough for similar commands at other times."""
RECENT_S = 10.0
"""Length of the window of the current slip and error [s]."""
LIGHT_SHARE, HEAVY_SHARE = 0.1, 0.3
"""Fractions of one core for light updates and diagnoses: together with polling less than half a core."""
_POLL_S = 0.25
"""Interval between two checks of the file size [s]."""
_LEAST_GROWTH = 0.1
"""Relative growth of a log before it is diagnosed again: less hardly changes an interval."""
_LEAST_LOG_S = 20.0
"""Shortest log to diagnose [s]: `slip diagnose` refuses shorter ones."""
_NICE = 10
"""Nice value of a diagnosis, so that the robot's own processes have priority."""
_MOST_EVENTS = 100
NOTES = "watches"


def measure_cpu() -> float:
    """CPU time of this process and of the processes that it has waited for [s]."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def _measure_children() -> float:
    """CPU time of the processes that this one has waited for [s]."""
    spent = os.times()
    return spent.children_user + spent.children_system


def choose_recording(path: Path) -> Path:
    """Recording to follow: the file or split recording itself, or the newest file of a folder.

    Raises:
        LogError: ``log_not_found``; ``not_a_recording``, the folder holds no MCAP file.
    """
    if not path.is_dir():
        if not path.exists():
            raise LogError("log_not_found", "there is no such file", where=str(path), hint="Check the path")
        return path
    files = [file for file in list_files(path) if file.suffix == SUFFIXES[0]]
    if not files:
        what = "the folder holds no MCAP file"
        hint = "Start the recorder first, or name the folder it writes to"
        raise LogError("not_a_recording", what, where=str(path), hint=hint)
    with suppress(LogError):
        find_parts(path)
        return path
    return max(files, key=lambda file: file.stat().st_mtime_ns)


@dataclass
class _Clock:
    """Schedule of one kind of update.

    Attributes:
        share: allowed fraction of one core.
        due: time of the next update [s of `time.monotonic`].
        cpu_s: total CPU time so far [s].
    """

    share: float
    due: float = 0.0
    cpu_s: float = 0.0

    def note(self, begin: float, cpu_s: float) -> None:
        """Delay the next update so that the CPU time of this one stays within the allowed fraction."""
        self.cpu_s += cpu_s
        self.due = max(begin + cpu_s / self.share, time.monotonic())


@dataclass
class Live:
    """State of a log from light updates; times are in seconds since its start.

    Attributes:
        duration_s: duration of the log.
        distance_m: driven distance.
        slip_mps: median slip modulus over the last `RECENT_S`, by input.
        error_mps: median residual speed of the last model over the last `RECENT_S`, by input.
        events: events: ``id``, ``text``, ``t_start``, ``t_end``.
        problem: reason why there is no slip yet; empty if there is.
    """

    duration_s: float = 0.0
    distance_m: float = 0.0
    slip_mps: dict[str, float] = field(default_factory=dict)
    error_mps: dict[str, float] = field(default_factory=dict)
    events: list[dict[str, object]] = field(default_factory=list)
    problem: str = ""


@dataclass
class _Diagnosing:
    """A running diagnosis of the log so far, in a separate process that frees its memory at the end."""

    process: subprocess.Popen[bytes]
    output: Path
    begin: float
    cpu_s: float
    duration_s: float


class Watch:
    """Follows one recording until it is closed.

    Memory is bounded: between updates it keeps only the index of chunks and the last events. A light update
    reads `TAIL_S`; a diagnosis runs in a separate process with the memory and time of `slip diagnose`.

    Args:
        path: path from `choose_recording`.
        options: options of the user, including the results folder.
        arguments: the user's options for the command line of a diagnosis.
        quiet_s: time without growth of the log after which the watch ends [s].
    """

    def __init__(self, path: Path, options: Options, arguments: Sequence[str], quiet_s: float) -> None:
        self.path, self._options, self._arguments, self._quiet_s = path, options, arguments, quiet_s
        self.live = Live()
        self.knowledge: dict[str, object] = {}
        self._log = GrowingLog(path)
        self._light, self._heavy = _Clock(LIGHT_SHARE), _Clock(HEAVY_SHARE)
        self._setup: tuple[int, LogSetup] | None = None
        self._model: Path | None = None
        # End of the distance that has been counted.
        self._driven_s = 0.0
        self._diagnosing: _Diagnosing | None = None
        self._notes = Store(options.out).notes(NOTES)
        self._begin, self._cpu = time.monotonic(), measure_cpu()
        # A restarted watch continues with the knowledge of the previous one.
        self.knowledge = _check_noted(self._notes.read(str(path.resolve())))

    def follow(self) -> Iterator[dict[str, object]]:
        """Yield the state after every change until the log is closed.

        Raises:
            LogError: the log is missing, cannot be read, or has never grown.
        """
        grown = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="slip-watch-") as scratch:
            try:
                while True:
                    now = time.monotonic()
                    if self._log.update():
                        grown = now
                    # The last update need not wait: nothing else runs.
                    is_over = self._log.is_closed or now - grown > self._quiet_s
                    seen = self._log.end_s > self.live.duration_s and (is_over or now >= self._light.due)
                    if seen:
                        self._look()
                    try:
                        judged = self._diagnose(Path(scratch))
                    except Exception as error:  # noqa: BLE001 - neither does one of a diagnosis
                        judged, self.knowledge["problem"] = True, _describe_defect(error)
                        self._heavy.note(now, 1.0)
                    if seen or judged:
                        yield self.to_json()
                    if is_over and not self._log.is_closed:
                        self._refuse_still()
                    if is_over:
                        return
                    time.sleep(_POLL_S)
            finally:
                self._end()

    def _refuse_still(self) -> None:
        """Raise an error if the log is empty and not being written."""
        if self.live.duration_s:
            return
        what = f"nothing was written to it for {self._quiet_s:g} s"
        hint = "Start the recorder, or wait longer with --for SECONDS"
        raise LiveError("never_grows", what, where=str(self.path), hint=hint)

    def _look(self) -> None:
        """Light update: run the stages on the end of the log."""
        begin, spent = time.monotonic(), measure_cpu()
        try:
            self._read_end()
            self.live.problem = ""
        except SlipError as error:
            # A log that has just started may have no pose or command yet.
            self.live.problem = error.what
        except Exception as error:  # noqa: BLE001 - a defect of a look ends neither the watch nor the recording
            self.live.problem = _describe_defect(error)
        self.live.duration_s = self._log.end_s
        return_freed_memory()
        self._light.note(begin, measure_cpu() - spent)

    def _read_end(self) -> None:
        end_s = self._log.end_s
        index = self._log.make_index(max(TAIL_S, end_s - self._driven_s) if self._driven_s else None)
        if self._setup is None or self._setup[0] != len(index.channels):
            self._setup = len(index.channels), set_up_log(self.path, self._options, self._log.make_index())
        setup = self._setup[1]
        where = str(self.path)
        data = read_topics(index, list_wanted(setup.sources, index.types), sha256="growing")
        made = extract_tables(Given(data, setup.sources, setup.configuration, setup.vehicle, str(self.path)))
        del data
        aligned = align_tables(
            {
                # Rows that break the contract are left out, as of a finished log.
                name: check_table(name, identify(name, as_recorded(name, frame), "live", setup)).valid
                for name, frame in made.tables.items()
                if not frame.is_empty()
            },
            setup.vehicle,
            setup.alignment,
            body_commanded=setup.is_body_commanded,
            where=where,
            is_drive_alone=setup.is_drive_alone,
        )
        tables, alignment = aligned.tables, aligned.alignment
        speeds = velocity.compute_velocities(
            tables["poses"], tables.get("imu", made.tables["imu"]), alignment,
            setup.configuration.velocity, where=where,
            wheels=read_drive(tables.get("wheels"), aligned.vehicle),
        ).table  # fmt: skip
        outcome = slip_stage.compute_slip(
            speeds,
            tables,
            vehicle=aligned.vehicle,
            configuration=setup.configuration,
            hold_s=alignment.hold_s,
            inputs=self._options.inputs,
            where=where,
            is_drive_alone=setup.is_drive_alone,
        )
        slip = outcome.slip
        if self._model is not None:
            with suppress(SlipError):
                length = setup.configuration.slip.length_scale_m
                file = read_model(self._model)
                slip, _ = add_model(
                    slip, tables, file, aligned.vehicle, length=length, where=str(self._model)
                )
        # The last message of the tables is the end of the log, whatever clock its stamps are of.
        offset = end_s - max(float(frame["t"][-1]) for frame in made.tables.values() if not frame.is_empty())
        self._take(speeds, slip, offset)
        self._note_events((*aligned.findings, *outcome.findings), offset)

    def _take(self, speeds: pl.DataFrame, slip: pl.DataFrame, offset: float) -> None:
        """Update slip, error and distance from the tables of a light update."""
        times = speeds["t"].to_numpy()
        moved = speeds["v_x"].abs().to_numpy()[times + offset > self._driven_s]
        period = float(times[1] - times[0]) if times.size > 1 else 0.0
        self.live.distance_m += float(moved.sum()) * period
        self._driven_s = float(times[-1]) + offset
        recent = slip.filter(slip["t"] > times[-1] - RECENT_S)
        self.live.slip_mps = _measure_medians(recent, "modulus")
        self.live.error_mps = _measure_medians(recent, "residual_modulus")

    def _note_events(self, findings: Sequence[Finding], offset: float) -> None:
        """Merge new events with known ones; a continuing event counts once."""
        known = self.live.events
        for one in findings:
            if one.t_start is None or one.t_end is None:
                continue
            start, end = one.t_start + offset, one.t_end + offset
            same = [e for e in known if e["id"] == one.id and cast("float", e["t_end"]) >= start - 1.0]
            same = [e for e in same if cast("float", e["t_start"]) <= end + 1.0]
            start = min([start, *(cast("float", e["t_start"]) for e in same)])
            end = max([end, *(cast("float", e["t_end"]) for e in same)])
            known = [e for e in known if e not in same]
            known.append({"id": one.id, "text": one.text, "t_start": round(start, 2), "t_end": round(end, 2)})
        self.live.events = sorted(known, key=lambda e: cast("float", e["t_start"]))[-_MOST_EVENTS:]

    def _diagnose(self, scratch: Path) -> bool:
        """Start a diagnosis if one is due, or collect a finished one; return whether one has finished."""
        if self._diagnosing is not None:
            return self._collect(scratch)
        length, last = self.live.duration_s, cast("float", self.knowledge.get("until_s") or 0.0)
        is_longer = length >= max(_LEAST_LOG_S, (1.0 + _LEAST_GROWTH) * last)
        if time.monotonic() < self._heavy.due or not is_longer or self.live.problem or self._log.is_closed:
            return False
        output = scratch / "diagnosis.json"
        command = [
            sys.executable, "-m", "pipeline", "analyze", "--json", "--no-report",
            "--results", str(scratch / "results"), *self._arguments, "--", str(self.path),
        ]  # fmt: skip
        with output.open("wb") as stream:
            process = subprocess.Popen(  # noqa: S603 - this program itself
                command, stdout=stream, stderr=subprocess.DEVNULL, start_new_session=True
            )
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
        self._diagnosing = _Diagnosing(process, output, time.monotonic(), _measure_children(), length)
        return False

    def _collect(self, scratch: Path) -> bool:
        """Collect the result of a finished diagnosis."""
        from pipeline.live.running_log import summarize_knowledge  # noqa: PLC0415 - heavy

        running = self._diagnosing
        if running is None or running.process.poll() is None:
            return False
        self._diagnosing = None
        spent = _measure_children() - running.cpu_s
        self._heavy.note(running.begin, spent)
        # Empty if the process was stopped before it wrote any output.
        output = read_object(running.output)
        runs = cast("list[Content]", output.get("runs") or [])
        if not runs:
            errors = cast("list[Content]", output.get("errors") or [{}])
            self.knowledge["problem"] = str(errors[0].get("message") or "the diagnosis gave no answer")
            return True
        diagnosis = read_result(cast("Content", runs[0].get("diagnosis") or {}), RunDiagnosis)
        passing = cast("Sequence[str]", self.knowledge.get("passing") or ())
        self.knowledge = {"until_s": running.duration_s, **summarize_knowledge(diagnosis, passing)}
        if diagnosis.model is not None:
            self._model = scratch / "model.toml"
            self._model.write_text(diagnosis.model, encoding="utf-8")
        self._notes.write(str(self.path.resolve()), cast("dict[str, JSON]", self.knowledge))
        return True

    def to_json(self) -> dict[str, object]:
        """The whole state as one JSON object."""
        wall = max(time.monotonic() - self._begin, 1e-9)
        return {
            "log": str(self.path),
            "bytes": self._log.size,
            "closed": self._log.is_closed,
            **vars(self.live),
            "knowledge": dict(self.knowledge),
            "diagnosing": self._diagnosing is not None,
            "cpu_share": round((measure_cpu() - self._cpu) / wall, 3),
        }

    def _end(self) -> None:
        """Stop a running diagnosis."""
        if self._diagnosing is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._diagnosing.process.pid, signal.SIGKILL)
            self._diagnosing.process.wait()
            self._diagnosing = None

    def forget(self) -> None:
        """Delete the stored knowledge of the growing log, which now has its final diagnosis."""
        self._notes.remove(str(self.path.resolve()))


def _describe_defect(error: Exception) -> str:
    """One line on an error that ends neither the watch nor the recording."""
    if isinstance(error, SlipError):
        return error.what
    return f"this look failed ({type(error).__name__}: {make_plain(shorten(str(error)))}); the watch goes on"


def _measure_medians(slip: pl.DataFrame, column: str) -> dict[str, float]:
    """Median of a column of table `slip` by input, without inputs that have none."""
    medians = {}
    for name in slip["input"].unique(maintain_order=True):
        median = slip.filter(slip["input"] == name)[column].median()
        if isinstance(median, float):
            medians[str(name)] = round(median, 4)
    return medians


class _Number(msgspec.Struct):
    """A value with its interval and its precision."""

    value: float | None
    low: float | None
    high: float | None
    unit: str
    share: float | None


class _Stated(msgspec.Struct):
    """See `running_log.Stated`."""

    effect: str
    text: str
    parameters: dict[str, _Number]


class _Alarm(msgspec.Struct):
    """See `running_log.summarize_knowledge`."""

    effect: str
    parameter: str
    value: float
    low: float
    high: float
    text: str


class _Noted(msgspec.Struct):
    """See `running_log.summarize_knowledge`."""

    until_s: float
    stated: list[_Stated]
    waiting: list[str]
    undecided: list[list[str]]
    unseen: list[str]
    drive: list[str]
    enough: bool
    data: str | None
    error: str | None
    problem: str
    passing: list[str]
    alarms: list[_Alarm] = []


def _check_noted(noted: object) -> dict[str, object]:
    """Stored knowledge of an earlier watch; empty if there is none, or if it is invalid."""
    try:
        return cast("dict[str, object]", msgspec.to_builtins(msgspec.convert(noted, _Noted)))
    except msgspec.ValidationError:
        return {}
