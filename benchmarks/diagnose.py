"""How much CPU time `slip diagnose` takes, and where it goes.

Without a log, ten simulated minutes. For each log: the user CPU seconds of `slip diagnose --json` as a
process of its own, the least of N runs; beside it those of another version in its own checkout, run in turns,
and the ratio. Then one diagnosis more, on one core, with its CPU seconds by stage: what a stage calls that is
a stage itself counts there alone. A machine that is busy otherwise makes all of them longer, ratios less so.
"""

import argparse
import functools
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from measuring import measure_command, simulate_ten_minutes

STAGES = {
    "import modules": ("_frozen_importlib._find_and_load",),
    "read the log, its stages, store": ("pipeline.analysis.analyze.analyze_log",),
    "pages of the results folder": ("pipeline.report.write_page",),
    "read the tables": (
        "pipeline.estimation.stored_diagnosis.read_recording",
        "pipeline.run.motion_run.load_run",
    ),
    "make runs ready": ("pipeline.estimation.estimation_data.prepare_data",),
    "search: the matrix": ("pipeline.estimation.matrix.Matrix.__init__",),
    "search: sets chosen on it": ("pipeline.estimation.matrix.Matrix.choose",),
    "search: sets fitted": ("pipeline.estimation.decision.Search._improve",),
    "search: other starts and wholes": (
        "pipeline.estimation.decision.Search._start_again",
        "pipeline.estimation.decision.Search._try_wholes",
    ),
    "search: names": ("pipeline.estimation.decision.Search.name_all",),
    "what could not be seen": ("pipeline.estimation.ambiguity.find_unobservable",),
    "formulas": ("pipeline.estimation.unexplained.search_formula",),
    "undecided effects": (
        "pipeline.estimation.ambiguity.find_undecided",
        "pipeline.estimation.ambiguity.read_clocks",
    ),
    "ladder: fits": ("pipeline.estimation.model_fit.fit_model",),
    "ladder: data not seen": ("pipeline.estimation.held_out.hold_out",),
    "noise floor": ("pipeline.estimation.floor.estimate_floor",),
    "intervals": ("pipeline.estimation.intervals.estimate_intervals",),
    "intervals by seconds driven": ("pipeline.estimation.driving_need.narrow_intervals",),
    "budget by cause": ("pipeline.estimation.apportion.apportion",),
    "regions of the error": ("pipeline.estimation.error_regions.map_errors",),
    "other conclusions": ("pipeline.estimation.conclude.summarize",),
    "other search": ("pipeline.estimation.diagnose.diagnose_runs",),
}
HERE = Path(__file__).parents[1]
REST = "everything else"
TABLE = """import sys
sys.path.insert(0, sys.argv[1])
import diagnose
diagnose.print_stages(sys.argv[2:])
"""


class Stopwatch:
    """CPU seconds and calls by stage; of stages within each other the inner one runs."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._open = [REST]
        self._since = 0.0

    def switch(self) -> None:
        """Count what has passed for the stage that runs."""
        now = time.process_time()
        self.seconds[self._open[-1]] += now - self._since
        self._since = now

    def wrap(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed as part of a stage."""

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401 - whatever it takes and returns
            self.switch()
            self._open.append(stage)
            self.calls[stage] += 1
            try:
                return function(*args, **kwargs)
            finally:
                self.switch()
                self._open.pop()

        return timed


def _find(path: str) -> tuple[Any, str, Callable[..., Any]]:
    """The object that holds a function, its name there, and the function."""
    parts = path.split(".")
    owner: Any = sys.modules.get(parts[0])
    for length in range(len(parts) - 1, 0, -1):
        try:
            owner = import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        break
    for name in parts[length:-1]:
        owner = getattr(owner, name)
    return owner, parts[-1], getattr(owner, parts[-1])


def _replace(owner: object, name: str, old: object, new: object) -> None:
    """Put a function in the place of another, wherever it was imported by its name."""
    setattr(owner, name, new)
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("pipeline.") and vars(module).get(name) is old:
            setattr(module, name, new)


def print_stages(command: list[str]) -> None:
    """Run a command of slip on one core, and print CPU seconds by stage."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    watch = Stopwatch()
    owner, name, function = _find("_frozen_importlib._find_and_load")
    setattr(owner, name, watch.wrap("import modules", function))
    for stage, paths in STAGES.items():
        for path in paths:
            if not path.startswith("_"):
                owner, name, function = _find(path)
                _replace(owner, name, function, watch.wrap(stage, function))
    main = import_module("pipeline.cli").main
    sys.argv = ["slip", *command]
    try:
        main()
    except SystemExit as end:
        if end.code not in {None, 0, 3}:
            raise
    watch.switch()
    whole = sum(watch.seconds.values())
    lines = [f"{'stage':<36}{'CPU s':>8}{'share':>8}{'calls':>8}"]
    for stage in (*STAGES, REST):
        spent = watch.seconds[stage]
        lines.append(f"{stage:<36}{spent:>8.2f}{spent / whole:>8.1%}{watch.calls[stage]:>8}")
    sys.stderr.write("\n".join([*lines, f"{'all':<36}{whole:>8.2f}", ""]))


def measure(command: list[str], checkout: Path, folder: str) -> float:
    """User CPU seconds of a command of a checkout and of all that it starts, run in a folder.

    Results are in the folder, as every version writes them there if it is not told where.
    """
    own = checkout / ".venv" / "bin" / "python"
    python = str(own) if own.exists() else sys.executable
    environment = os.environ | {"PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": ""}
    return measure_command([python, *command], folder=Path(folder), environment=environment).user_s


def compare(log: Path, checkouts: list[Path], runs: int) -> None:
    """Print the least user CPU seconds of a diagnosis by each checkout, and where the first one's go."""
    least = dict.fromkeys(checkouts, float("inf"))
    asked = ["diagnose", str(log), "--json"]
    for _ in range(runs):
        for checkout in checkouts:
            with tempfile.TemporaryDirectory() as folder:
                spent = measure(["-m", "pipeline", *asked], checkout, folder)
                least[checkout] = min(least[checkout], spent)
    own, *others = least.values()
    beside = "".join(f", {other:.2f} s with the other version: {own / other:.2f} of it" for other in others)
    print(f"{log.name}: {own:.2f} s of user CPU{beside}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        measure(["-c", TABLE, str(Path(__file__).parent), *asked], checkouts[0], folder)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", type=Path, nargs="*")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--against", type=Path, help="folder of another version's checkout")


def run(asked: argparse.Namespace) -> None:
    """Read the command line and measure."""
    checkouts = [HERE, *([asked.against.resolve()] if asked.against else [])]
    with tempfile.TemporaryDirectory() as folder:
        logs = [log.resolve() for log in asked.logs]
        if not logs:
            logs = [simulate_ten_minutes(Path(folder))]
        for log in logs:
            compare(log, checkouts, asked.runs)
