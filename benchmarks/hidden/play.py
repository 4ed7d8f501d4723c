"""Play the hidden-effect test: draw logs by seed, diagnose them, open the answers, print the score.

    python benchmarks/hidden/play.py --category single --effect each --seeds 0-20 --jobs 2 --out scores.jsonl
    python benchmarks/hidden/play.py ...the same... --resume
    python benchmarks/hidden/play.py --table scores.jsonl more.jsonl

The same code path as `slip diagnose LOG --json`; with --command-line the program itself is run for each log.
Each log's score is written when it is known: stopped at any moment, the same command with --resume goes on.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from draw import CATEGORIES, POOLS, Category
from pebble import ProcessExpired, ProcessPool
from play_log import play
from records import Job, Record, append_record, read_records, record_failure
from scoreboard import write_scoreboard

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
_TIME_OUT_S = 180.0
_STOPPED = 130
_AGAIN = 200
_OFTEN = 20


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
    with tempfile.TemporaryDirectory(prefix="hidden_effect_") as folder, _one_core_each():
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
def _one_core_each() -> Iterator[None]:
    """What is measured must not depend on how many logs are played at once."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
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


def main() -> int:
    """Read the command line and play."""
    asked = _read_command_line()
    if asked.table:
        missing = [str(path) for path in asked.table if not path.is_file()]
        if missing:
            sys.stderr.write(f"there is no {', '.join(missing)}\n")
            return 2
        sys.stdout.write(write_scoreboard(read_records(asked.table).values()) + "\n")
        return 0
    categories = list(CATEGORIES) if asked.category == "all" else asked.category.split(",")
    jobs = list_jobs(categories, asked.seeds, asked.effect, program=asked.command_line)
    done = read_records([asked.out]) if asked.out and asked.resume else {}
    if asked.out and asked.out.exists() and not asked.resume:
        sys.stderr.write(f"{asked.out} is there: say --resume to go on with it, or give another name\n")
        return 2
    rest = [job for job in jobs if job not in done or done[job].outcome != "scored"]
    version, begin, count = read_version(), time.monotonic(), 0

    def tell(record: Record) -> None:
        nonlocal count
        count += 1
        known = replace(record, version=version)
        done[known.job] = known
        if asked.out:
            append_record(known, asked.out)
        left = (time.monotonic() - begin) / count * (len(rest) - count)
        if sys.stderr.isatty() or count % _OFTEN == 0:
            sys.stderr.write(f"\r{count} of {len(rest)} logs, {left / 60.0:.0f} min left ")
            sys.stderr.flush()

    code = 0
    try:
        with _ending_on_signals():
            play_all(rest, tell, workers=asked.jobs, time_out_s=asked.time_out)
    except KeyboardInterrupt:
        code = _STOPPED
    sys.stderr.write("\n")
    wanted = set(jobs)
    sys.stdout.write(write_scoreboard(record for job, record in done.items() if job in wanted) + "\n")
    return code


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


def _read_command_line() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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
    asked = parser.parse_args()
    unknown = set(asked.category.split(",")) - {*CATEGORIES, "all"}
    if unknown:
        parser.error(
            f"no such category: {', '.join(sorted(unknown))}; there are {', '.join(CATEGORIES)}, all"
        )
    return asked


if __name__ == "__main__":
    sys.exit(main())
