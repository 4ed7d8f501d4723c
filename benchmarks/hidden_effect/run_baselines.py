"""All baselines of HiddenEffect on the rings that are there, and their table.

make hidden-effect-baselines
make hidden-effect-baselines ARGS="--only sparse slip --resume"
"""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from answer_simple import BASELINES, write_answers
from answer_slip import answer
from read_task import Read  # noqa: TC002 - it runs as a script, too
from score_answers import measure_scores, read_truth, score_ring

SOLVERS: dict[str, Callable[[Read], dict[str, Any]]] = {"slip": answer, **BASELINES}
_COLUMNS = (
    "points", "right", "undecided", "abstained", "wrong", "false_in_empty", "coverage", "width",
    "position_over_floor", "yaw_over_floor", "position_over_ideal", "yaw_over_ideal", "cpu_s",
)  # fmt: skip


def tabulate(rings: Path, answers: Path, chosen: list[str]) -> list[str]:
    """A table in Markdown for each ring: a row a baseline, each score with its interval."""
    names = tomllib.loads(Path(__file__).with_name("names.toml").read_text("utf-8"))
    lines = []
    for path in sorted(rings.glob("*/truth.json")):
        truth = read_truth(path)
        lines += ["", f"{truth['ring']}, {len(truth['tasks'])} tasks", ""]
        lines += [f"| | {' | '.join(_COLUMNS)} |", f"|---|{'---|' * len(_COLUMNS)}"]
        for name in chosen:
            scores = score_ring(answers / name, truth, names, lambda line: print(line, file=sys.stderr))
            measured = measure_scores(scores)
            cells = [_show(*measured[column]) for column in _COLUMNS]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _show(value: float, low: float, high: float) -> str:
    return "" if value != value else f"{value:.2f} [{low:.2f}, {high:.2f}]"  # noqa: PLR0124 - NaN


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rings", type=Path, default=Path("rings"))
    parser.add_argument("--answers", type=Path, default=Path("answers"))
    parser.add_argument("--only", nargs="+", choices=list(SOLVERS), default=list(SOLVERS))
    parser.add_argument("--resume", action="store_true", help="leave answers that are there")
    parser.add_argument("--table", action="store_true", help="only the table of what is answered")
    given = parser.parse_args()
    if not list(given.rings.glob("*/truth.json")):
        print(f"{given.rings}: no ring with a truth.json; make hidden-effect makes them", file=sys.stderr)
        return 1
    for name in () if given.table else given.only:
        count = write_answers(given.rings, given.answers / name, SOLVERS[name], resume=given.resume)
        print(f"{name}: {count} answers in {given.answers / name}", flush=True)
    print(*tabulate(given.rings, given.answers, given.only), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
