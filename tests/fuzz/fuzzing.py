"""What the scripts that try odd files share: a case that is kept if it fails, and the command line."""

import argparse
import faulthandler
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def keep_failure(finds: Path | None, name: str, case: bytes, *, hang_s: float) -> Iterator[None]:
    """Run one case: one that raises is kept, one that hangs ends the process with its traceback.

    Args:
        finds: folder of kept cases; None keeps none.
        name: name of its file there.
        case: content of that file.
        hang_s: time that it may take [s].
    """
    faulthandler.dump_traceback_later(hang_s, exit=True)
    try:
        yield
    except BaseException:
        if finds is not None:
            finds.mkdir(parents=True, exist_ok=True)
            (finds / name).write_bytes(case)
        raise
    finally:
        faulthandler.cancel_dump_traceback_later()


def run_script(about: str | None, memory: int, run: Callable[[float, int, Path], int]) -> int:
    """Try cases as a script, and print their number and the highest memory.

    Args:
        about: what the script does.
        memory: address space that it may use [bytes].
        run: tries cases for so many seconds, from a seed, and keeps finds in a folder; their number.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--finds", type=Path, default=Path("fuzz_finds"))
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    cases = run(given.minutes * 60.0, given.seed, given.finds)
    sys.stdout.write(f"{cases} cases in {given.minutes:g} minutes, no find, peak {peak_mb():.0f} MB\n")
    return 0


def peak_mb() -> float:
    """Highest resident memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
