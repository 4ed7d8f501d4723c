"""Play one log: draw it, hand it over as a user would, and open its answer only afterwards."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from draw import Answer, Riddle, draw_riddle, open_seal, write_riddle
from records import Job, Record, describe_scene
from score import score_runs
from truth import Json, check_models

from pipeline.core import SlipError
from pipeline.estimation import Recording, diagnose_runs
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.sources import Vehicle

# An empty log has no true model to compare with; poor driving is asked what it admits not to know.
_UNCHECKED = frozenset({"empty", "poor"})


@dataclass
class Watch:
    """Wall and CPU time of each part of the work [s]."""

    wall: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Time a block; programs that it starts count, too."""
        wall, cpu = time.perf_counter(), _spent()
        yield
        self.wall[part] = round(time.perf_counter() - wall, 3)
        self.cpu[part] = round(_spent() - cpu, 3)


def play(job: Job, scratch: Path) -> Record:
    """Write a log, have it diagnosed, and only then open its answer and fit the true model.

    Args:
        job: what to draw.
        scratch: folder for the log and its results; they are removed again.
    """
    folder = scratch / job.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        return _play(job, draw_riddle(job.category, job.seed, job.effect), folder / "run.mcap")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _play(job: Job, riddle: Riddle, log: Path) -> Record:
    watch = Watch()
    with watch.measure("draw"):
        logs = write_riddle(riddle, log)
    with watch.measure("ask"):
        vehicle, recording, told = _ask_program(logs) if job.by_command_line else _ask(logs, watch)
    answer: Answer = open_seal(log.with_suffix(".sealed").read_text(encoding="ascii"))
    checked, note = None, ""
    if job.category not in _UNCHECKED:
        with watch.measure("check"):
            try:
                checked = check_models(vehicle, recording, told[0], answer)
            except SlipError as error:
                # What was said stands; that it is as good as the true model cannot be shown.
                note = f"not checked: {error}"
    return Record(
        job,
        answer,
        score_runs(answer, told),
        checked,
        note=note,
        scene=describe_scene(riddle),
        wall_s=watch.wall,
        cpu_s=watch.cpu,
    )


def _ask(logs: Sequence[Path], watch: Watch) -> tuple[Vehicle, Recording, Sequence[Json]]:
    """What `slip diagnose LOG... --json` does, in this process."""
    with watch.measure("stages"):
        loaded = [_load(log) for log in logs]
    (vehicle, recording), *_ = loaded
    with watch.measure("diagnosis"):
        told = diagnose_runs([one for _, one in loaded], vehicle).to_json()
    return vehicle, recording, told


def _ask_program(logs: Sequence[Path]) -> tuple[Vehicle, Recording, Sequence[Json]]:
    """The program itself."""
    out = str(_results(logs[0]))
    command = [sys.executable, "-m", "pipeline", "diagnose", *map(str, logs), "--json", "--results", out]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode not in {0, 3}:
        raise RuntimeError(done.stderr.strip())
    return *_load(logs[0]), json.loads(done.stdout)["runs"]


def _load(log: Path) -> tuple[Vehicle, Recording]:
    """The log taken through the stages, or what is stored of it."""
    return read_recording(analyze_log(log, Options(out=_results(log), report=False)).manifest)


def _results(log: Path) -> Path:
    return log.parent / "out"


def _spent() -> float:
    """CPU time of this process and of the programs that it has waited for [s]."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime
