"""Players' answers to the rings that are there, and their table.

    make bench NAME=game/answers [ARGS="--only sparse slip --resume"]

Answers stand in <answers>/<player>/<task>.json; rings without their truths are answered and not scored.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from game.baselines import BASELINES, write_answers
from game.player import answer_slip
from game.read_task import Read
from game.score import AnswerError, measure_scores, read_truths, score_ring

PLAYERS: dict[str, Callable[[Read], dict[str, Any]]] = {"slip": answer_slip, **BASELINES}
_COLUMNS = (
    "points", "right", "undecided", "wrong", "false_in_empty", "coverage", "width",
    "position_over_floor", "yaw_over_floor", "position_over_ideal", "yaw_over_ideal", "cpu_s",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rings", type=Path, default=Path("rings"))
    parser.add_argument("--truths", type=Path, default=Path("truths"))
    parser.add_argument("--answers", type=Path, default=Path("answers"))
    parser.add_argument("--only", nargs="+", choices=list(PLAYERS), default=list(PLAYERS))
    parser.add_argument("--resume", action="store_true", help="leave answers that are there")
    parser.add_argument("--table", action="store_true", help="only the table of what is answered")


def run(given: argparse.Namespace) -> int:
    """Answer and tabulate; 1 where there is nothing to score with."""
    for name in () if given.table else given.only:
        count = write_answers(given.rings, given.answers / name, PLAYERS[name], resume=given.resume)
        print(f"{name}: {count} answers in {given.answers / name}", flush=True)
    try:
        print(*tabulate(given.rings, given.truths, given.answers, given.only), sep="\n")
    except AnswerError as problem:
        print(problem, file=sys.stderr)
        return 1
    return 0


def tabulate(rings: Path, truths: Path, answers: Path, chosen: list[str]) -> list[str]:
    """A table in Markdown for each ring: a row a player, each score with its interval."""
    names = json.loads((rings / "names.json").read_text("utf-8"))
    lines = []
    for ring, tasks in read_truths(rings, truths).items():
        lines += ["", f"{ring}, {len(tasks)} tasks", ""]
        lines += [f"| | {' | '.join(_COLUMNS)} |", f"|---|{'---|' * len(_COLUMNS)}"]
        for name in chosen:
            scores = score_ring(answers / name, tasks, names, lambda line: print(line, file=sys.stderr))
            measured = measure_scores(scores)
            lines.append(f"| `{name}` | {' | '.join(_show(*measured[column]) for column in _COLUMNS)} |")
    return lines


def _show(value: float, low: float, high: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f} [{low:.2f}, {high:.2f}]"
