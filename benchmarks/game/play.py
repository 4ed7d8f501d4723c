"""Drawn riddles: each is recorded, diagnosed as `slip diagnose` does it, scored, and kept as a JSON line.

    make bench NAME=game/play ARGS="--category single --effect each --seeds 0-20 --jobs 2 --out scores.jsonl"
    make bench NAME=game/play ARGS="--table scores.jsonl more.jsonl"

With --command-line the program itself is run for each log. Each log's score is written when it is known:
stopped at any moment, the same command with --resume goes on.
"""

import argparse
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
from pebble import ProcessExpired, ProcessPool

from game.draw import CATEGORIES, POOLS, Answer, Category, Riddle, draw_riddle, write_riddle
from game.player import read_run
from game.rings import describe_effect, make_truth
from game.score import Answer as Claims
from game.score import TaskScore, list_intervals, score_task
from game.true_model import Checked, check_models
from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.estimation import DiagnosisInput, diagnose_runs
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.sources import Vehicle
from pipeline.words.objects import diagnosis_as_json

Json = Mapping[str, Any]
Outcome = Literal["scored", "failed", "timeout"]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
# An empty log has no true model to compare with; poor driving is asked what it admits not to know.
_UNCHECKED = frozenset({"empty", "poor"})
_TIME_OUT_S = 180.0
_STOPPED = 130
_AGAIN = 200
_OFTEN = 20


@dataclass(frozen=True)
class Job:
    """One log to draw and to diagnose.

    Attributes:
        category, seed, effect: see `draw.draw_riddle`.
        by_command_line: run the program itself, in place of the same code in this process.
    """

    category: Category
    seed: int
    effect: str | None = None
    by_command_line: bool = False

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.category}-{self.seed}-{self.effect or 'any'}{'-program' * self.by_command_line}"

    @property
    def replay(self) -> str:
        """The command that plays it again."""
        effect = f" --effect {self.effect}" if self.effect else ""
        return f'make bench NAME=game/play ARGS="--category {self.category} --seeds {self.seed}{effect}"'


@dataclass(frozen=True)
class Record:
    """One played log.

    Attributes:
        job: what was asked for.
        answer: what it hid.
        score: what was said of it; all missed where the diagnosis failed or took too long.
        errors: 2 s position error before, after, and the floor [m]; None where not stated.
        checked: the true model beside the named one; None where there is none, or where it failed.
        outcome: whether a diagnosis was given.
        note: why not.
        scene: what the log was like.
        wall_s, cpu_s: time to `draw`, `ask` (of it `stages` and `diagnosis`) and `check` [s].
        version: of the code that was played with.
    """

    job: Job
    answer: Answer
    score: TaskScore
    errors: tuple[float | None, float | None, float | None] = (None, None, None)
    checked: Checked | None = None
    outcome: Outcome = "scored"
    note: str = ""
    scene: dict[str, str | float] = field(default_factory=dict)
    wall_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    version: str = ""

    @property
    def is_weak(self) -> bool:
        """Whether an effect that was hidden lowers the true model's held-out error by less than 5 %."""
        checked = self.checked
        return checked is not None and any(checked.is_weak(name) for name in self.answer.effects)


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


def _spent() -> float:
    """CPU time of this process and of the programs that it has waited for [s]."""
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def score_runs(answer: Answer, runs: Sequence[Json], task: str = "") -> TaskScore:
    """Compare what was said with the answer of a riddle.

    Args:
        answer: what was hidden.
        runs: of `slip diagnose --json`; several were diagnosed together, each with a clock of its own.
        task: its name.
    """
    score = score_task(task, make_truth(answer), read_run(runs[0]))
    more = [
        interval
        for late, run in zip(answer.clocks[1:], runs[1:], strict=True)
        for interval in list_intervals([describe_effect("clock_offset", {"d": late})], read_run(run))
    ]
    return replace(score, intervals=(*score.intervals, *more))


def play(job: Job, scratch: Path) -> Record:
    """Write a log, have it diagnosed, and only then score it and fit the true model.

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
    checked, note = None, ""
    if job.category not in _UNCHECKED:
        with watch.measure("check"):
            try:
                checked = check_models(vehicle, recording, told[0], riddle.answer)
            except SlipError as error:
                # What was said stands; that it is as good as the true model cannot be shown.
                note = f"not checked: {error}"
    return Record(
        job,
        riddle.answer,
        score_runs(riddle.answer, told, job.name),
        _read_errors(told[0]),
        checked,
        note=note,
        scene=describe_scene(riddle),
        wall_s=watch.wall,
        cpu_s=watch.cpu,
    )


def _ask(logs: Sequence[Path], watch: Watch) -> tuple[Vehicle, DiagnosisInput, Sequence[Json]]:
    """What `slip diagnose LOG... --json` does, in this process."""
    with watch.measure("stages"):
        loaded = [_load(log) for log in logs]
    (vehicle, recording), *_ = loaded
    with watch.measure("diagnosis"):
        found = diagnose_runs([one for _, one in loaded], vehicle)
        told = [diagnosis_as_json(run) for run in found.runs]
    return vehicle, recording, told


def _ask_program(logs: Sequence[Path]) -> tuple[Vehicle, DiagnosisInput, Sequence[Json]]:
    """The program itself."""
    out = str(logs[0].parent / "out")
    command = [sys.executable, "-m", "pipeline", "diagnose", *map(str, logs), "--json", "--results", out]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode not in {0, 3}:
        raise RuntimeError(done.stderr.strip())
    return *_load(logs[0]), json.loads(done.stdout)["runs"]


def _load(log: Path) -> tuple[Vehicle, DiagnosisInput]:
    """The log taken through the stages, or what is stored of it."""
    return read_recording(analyze_log(log, Options(out=log.parent / "out", report=False)).manifest)


def _read_errors(run: Json) -> tuple[float | None, float | None, float | None]:
    ladder = run.get("ladder") or [{}]
    floor = run.get("noise_floor") or {}
    before, after, least = (one.get("t_mrmse_m") for one in (ladder[0], ladder[-1], floor))
    return before, after, least


def describe_scene(riddle: Riddle) -> dict[str, str | float]:
    """What tables of scores are made by."""
    scene = riddle.scenario
    return {
        "vehicle": scene.vehicle.name,
        "program": scene.program.name,
        "duration_s": scene.duration_s,
        "pose_hz": scene.pose.rate_hz,
        "noise_m": scene.pose.noise_m,
    }


def record_failure(job: Job, outcome: Outcome, note: str) -> Record:
    """A log of which no diagnosis was given: nothing was named."""
    riddle = draw_riddle(job.category, job.seed, job.effect)
    score = score_task(job.name, make_truth(riddle.answer), Claims())
    return Record(job, riddle.answer, score, outcome=outcome, note=note, scene=describe_scene(riddle))


def append_record(record: Record, path: Path) -> None:
    """Add a line to a file of records; a line that an interruption has torn is closed first."""
    with path.open("ab+") as stream:
        if stream.tell() > 0:
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                stream.write(b"\n")
        stream.write(msgspec.json.encode(record) + b"\n")


def read_records(paths: Iterable[Path]) -> dict[Job, Record]:
    """Records of several files by job; of a job played twice, the later line counts. Torn lines do not."""
    found: dict[Job, Record] = {}
    for path in paths:
        for line in path.read_bytes().splitlines() if path.exists() else ():
            try:
                record = msgspec.json.decode(line, type=Record)
            except msgspec.DecodeError:
                continue
            found[record.job] = record
    return found


def list_jobs(
    categories: Sequence[Category], seeds: Sequence[int], effect: str | None = None, *, program: bool = False
) -> list[Job]:
    """Jobs by seed, so that those played first are of all kinds; `each` goes through every effect.

    Args:
        categories: what to draw.
        seeds: from which to draw.
        effect: what to hide, drawn when None, every one that the category has when `each`.
        program: run the program itself.
    """
    jobs = []
    for seed in seeds:
        for category in categories:
            pool: Sequence[str | None] = POOLS.get(category, (None,)) if effect == "each" else (effect,)
            jobs += [Job(category, seed, name, program) for name in pool]
    return jobs


def play_all(
    jobs: Sequence[Job], tell: Callable[[Record], None], *, workers: int = 1, time_out_s: float = _TIME_OUT_S
) -> None:
    """Play many logs, each in a process of a pool and under a time-out.

    Args:
        jobs: what to play.
        tell: called with each record as soon as it is there.
        workers: processes.
        time_out_s: after it a log is given up, and its process with it.
    """
    with tempfile.TemporaryDirectory(prefix="game_") as folder, one_core_each():
        scratch = Path(folder)
        context = multiprocessing.get_context("spawn")
        pool = ProcessPool(workers, max_tasks=_AGAIN, context=context)
        try:
            # What is taken lies in the pool until it is played: a few at a time are enough.
            waiting = list(reversed(jobs))
            running = {}
            while waiting or running:
                while waiting and len(running) < 2 * workers:
                    job = waiting.pop()
                    running[pool.schedule(play, args=(job, scratch), timeout=time_out_s)] = job
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    tell(_collect(done.result, running.pop(done), time_out_s))
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


@contextmanager
def one_core_each() -> Iterator[None]:
    """What is measured must not depend on how many logs are played at once."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _collect(result: Callable[[], Record], job: Job, time_out_s: float) -> Record:
    try:
        return result()
    except TimeoutError:
        return record_failure(job, "timeout", f"no diagnosis after {time_out_s:.0f} s")
    except (ProcessExpired, CancelledError) as error:
        return record_failure(job, "failed", f"its process ended: {error}")
    except Exception as error:  # noqa: BLE001 - a log that fails costs itself, and is counted
        return record_failure(job, "failed", f"{type(error).__name__}: {error}")


def read_version() -> str:
    """The commit that is played with; empty outside of a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def parse_seeds(text: str) -> list[int]:
    """`7`, `7-12` (12 is not among them), or several of these with commas."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last)) if last else [int(first)]
    return seeds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--category", default="single", help=f"one, several with commas, or all: {', '.join(CATEGORIES)}"
    )
    parser.add_argument(
        "--seeds", default=[0], type=parse_seeds, help="one, first-last (the last not included), with commas"
    )
    parser.add_argument("--effect", default=None, help="what to hide, or `each`")
    parser.add_argument("--jobs", default=1, type=int, help="logs at a time")
    parser.add_argument("--time-out", default=_TIME_OUT_S, type=float, help="seconds a log")
    parser.add_argument("--out", type=Path, help="file to add a JSON line to for each log")
    parser.add_argument("--resume", action="store_true", help="go on where the file of --out ends")
    parser.add_argument(
        "--table", type=Path, nargs="+", help="print the score of such files, and play nothing"
    )
    parser.add_argument("--command-line", action="store_true", help="run the program itself for each log")


def run(given: argparse.Namespace) -> int:
    """Play, or print the table of what was played."""
    from game.tables import write_tables  # noqa: PLC0415 - tables are of records

    if given.table:
        missing = [str(path) for path in given.table if not path.is_file()]
        if missing:
            print(f"there is no {', '.join(missing)}", file=sys.stderr)
            return 2
        print(write_tables(read_records(given.table).values()))
        return 0
    categories = list(CATEGORIES) if given.category == "all" else given.category.split(",")
    unknown = set(categories) - set(CATEGORIES)
    if unknown:
        print(
            f"no such category: {', '.join(sorted(unknown))}; all: {', '.join(CATEGORIES)}", file=sys.stderr
        )
        return 2
    if given.out and given.out.exists() and not given.resume:
        print(f"{given.out} is there: say --resume to go on with it, or give another name", file=sys.stderr)
        return 2
    jobs = list_jobs(categories, given.seeds, given.effect, program=given.command_line)
    done = read_records([given.out]) if given.out and given.resume else {}
    code = _play_rest(given, jobs, done)
    wanted = set(jobs)
    print(write_tables(record for job, record in done.items() if job in wanted))
    return code


def _play_rest(given: argparse.Namespace, jobs: Sequence[Job], done: dict[Job, Record]) -> int:
    """Play what is not scored yet; records are added to those that are done."""
    rest = [job for job in jobs if job not in done or done[job].outcome != "scored"]
    version, begin, count = read_version(), time.monotonic(), 0

    def tell(record: Record) -> None:
        nonlocal count
        count += 1
        known = replace(record, version=version)
        done[known.job] = known
        if given.out:
            append_record(known, given.out)
        left = (time.monotonic() - begin) / count * (len(rest) - count)
        if sys.stderr.isatty() or count % _OFTEN == 0:
            print(f"\r{count} of {len(rest)} logs, {left / 60.0:.0f} min left ", end="", file=sys.stderr)

    try:
        with _ending_on_signals():
            play_all(rest, tell, workers=given.jobs, time_out_s=given.time_out)
    except KeyboardInterrupt:
        return _STOPPED
    return 0


@contextmanager
def _ending_on_signals() -> Iterator[None]:
    """SIGTERM ends the scoring as Ctrl-C does: with the table of what is there."""

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
