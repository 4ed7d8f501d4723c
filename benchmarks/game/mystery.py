"""The mystery logs of data_samples, and their truths beside a diagnosis.

    make samples
    make bench NAME=game/mystery ARGS="reveal data_samples/mystery_1.mcap results"

The truth of `mystery_1.mcap` is in `mystery_1.spoiler.json`, for nobody to read by accident.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from game.draw import Answer, Category, Riddle, draw_riddle, write_riddle
from game.odd import ODD
from game.play import score_runs
from game.score import TaskScore
from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import list_effects
from pipeline.store.stored_runs import DIAGNOSIS

_DRAWN: tuple[tuple[Category, int], ...] = (("single", 901), ("sets", 902), ("odd", 903))
_LONGEST_S = 150.0
_NAME, _TRUTH = 20, 18


def write_mysteries(folder: Path) -> list[Path]:
    """Write mystery_1 to mystery_3 and their truths."""
    written = []
    for number, (category, seed) in enumerate(_DRAWN, start=1):
        path = folder / f"mystery_{number}.mcap"
        riddle = _shorten(draw_riddle(category, seed))
        write_riddle(riddle, path)
        hidden = json.dumps(vars(riddle.answer), indent=1, sort_keys=True) + "\n"
        spoil(path).write_text(hidden, encoding="utf-8")
        written.append(path)
    return written


def spoil(log: Path) -> Path:
    """The file of a mystery's truth."""
    return log.with_suffix(".spoiler.json")


def _shorten(riddle: Riddle) -> Riddle:
    """The same riddle, small enough to stand beside the code."""
    scene = riddle.scenario
    pose = replace(scene.pose, rate_hz=min(scene.pose.rate_hz, 20.0))
    duration = min(scene.duration_s, _LONGEST_S)
    return replace(riddle, scenario=replace(scene, duration_s=duration, pose=pose))


def reveal(log: Path, results: Path) -> list[str]:
    """The guess of the program beside the truth: names, formulas, numbers with intervals.

    Args:
        log: the mystery; its truth stands beside it.
        results: where its diagnosis is, or is to be written.
    """
    answer = Answer(**json.loads(spoil(log).read_text(encoding="utf-8")))
    manifest = analyze_log(log, Options(out=results, diagnosis=True)).manifest
    guess = cast("Mapping[str, Any]", manifest.read_json(DIAGNOSIS))
    score, formulas = score_runs(answer, [guess]), {spec.id: spec.formula for spec in list_effects()}
    named = {str(entry["id"]): entry["parameters"] for entry in guess["effects"]}
    lines = [f"{log.stem}", f"{'':{_NAME}}{'truth':<{_TRUTH}}guess, 95 % interval"]
    for name, truth in answer.effects.items():
        lines.append(f"{name:<{_NAME}}{formulas[name]}")
        # By another name of the same thing it has no number to compare.
        lines += _compare_numbers(truth, named.get(name, {}))
        lines += [f"{'':{_NAME}}{word}" for word in _describe_fate(name, score)]
    if answer.odd:
        lines.append(f"{answer.odd:<{_NAME}}{ODD[answer.odd].about} (in {answer.channel})")
    lines += [f"{name:<{_NAME}}was named, but is not hidden" for name in score.wrong_names]
    rest = guess.get("unexplained")
    if rest:
        lines.append(f"{'unexplained':<{_NAME}}guess: {rest['share']:.0%} of the residual: {rest['where']}")
        formula = (rest.get("formula") or "").splitlines()[2:]
        lines += [f"{'':{_NAME}}{line}" for line in formula if line]
    elif answer.odd:
        lines.append(f"{'unexplained':<{_NAME}}guess: nothing")
    return lines


def _compare_numbers(truth: Mapping[str, float], guess: Mapping[str, Any]) -> list[str]:
    """A line a number: what it is, what it was taken for, and whether the interval holds it."""
    lines = []
    for key, value in truth.items():
        told = guess.get(key)
        text = f"{'':{_NAME}}{f'{key} = {value:.3g}':<{_TRUTH}}"
        if told is not None:
            text += f"{told['value']:.3g}"
            if told["low"] is not None:
                inside = "holds it" if told["low"] <= value <= told["high"] else "misses it"
                text += f" [{told['low']:.3g}, {told['high']:.3g}]  {inside}"
        lines.append(text.rstrip())
    return lines


def _describe_fate(name: str, score: TaskScore) -> list[str]:
    """What was said of an effect that was not named for itself."""
    if name in score.named:
        return []
    words = {
        "right": "named by another name of the same thing",
        "undecided": "left undecided",
        "unobservable": "said to leave no trace in this log",
    }
    return [f"guess: {words.get(score.outcomes[name], 'missed')}"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="command", required=True)
    writing = commands.add_parser("write", help="write the mystery logs and their truths")
    writing.add_argument("folder", type=Path)
    revealing = commands.add_parser("reveal", help="set the truth beside the diagnosis")
    revealing.add_argument("log", type=Path)
    revealing.add_argument("results", type=Path)


def run(given: argparse.Namespace) -> None:
    """Write, or reveal."""
    if given.command == "write":
        print(*write_mysteries(given.folder), sep="\n")
    else:
        print(*reveal(given.log, given.results), sep="\n")
