"""Write the three mystery logs of data_samples with their sealed answers; or set an answer beside a guess.

python benchmarks/hidden/mystery.py write data_samples
python benchmarks/hidden/mystery.py reveal data_samples/mystery_1.mcap results
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from draw import Category, Riddle, draw_riddle, open_seal, write_riddle
from odd_physics import ODD
from score import Json, Score, score_run

from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import DIAGNOSIS
from pipeline.simulate import list_effects

_DRAWN: tuple[tuple[Category, int], ...] = (("single", 901), ("sets", 902), ("odd", 903))
_LONGEST_S = 150.0
_NAME, _TRUTH = 20, 18


def write_mysteries(folder: Path) -> list[Path]:
    """Write mystery_1 to mystery_3 and their seals."""
    written = []
    for number, (category, seed) in enumerate(_DRAWN, start=1):
        path = folder / f"mystery_{number}.mcap"
        write_riddle(_shorten(draw_riddle(category, seed)), path)
        written.append(path)
    return written


def _shorten(riddle: Riddle) -> Riddle:
    """The same riddle, small enough to be kept beside the code."""
    scene = riddle.scenario
    pose = replace(scene.pose, rate_hz=min(scene.pose.rate_hz, 20.0))
    duration = min(scene.duration_s, _LONGEST_S)
    return replace(riddle, scenario=replace(scene, duration_s=duration, pose=pose))


def reveal(log: Path, results: Path) -> list[str]:
    """The guess of the program beside what its seal says: names, formulas, numbers with intervals.

    Args:
        log: the mystery; its seal stands beside it.
        results: where its diagnosis is, or is to be written.
    """
    answer = open_seal(log.with_suffix(".sealed").read_text(encoding="ascii"))
    manifest = analyze_log(log, Options(out=results, diagnosis=True)).manifest
    guess = manifest.read_json(DIAGNOSIS)
    score, formulas = score_run(answer, guess), {spec.id: spec.formula for spec in list_effects()}
    named = {str(entry["id"]): entry["parameters"] for entry in guess["effects"]}
    lines = [f"{log.stem}", f"{'':{_NAME}}{'truth':<{_TRUTH}}guess, 95 % interval"]
    for name, truth in answer.effects.items():
        lines.append(f"{name:<{_NAME}}{formulas[name]}")
        told = next((key for key in (name, *score.named) if key in named and name in score.found), "")
        # By another name of the same thing it has no number to compare.
        lines += _compare_numbers(truth, named.get(name, {}))
        lines += [f"{'':{_NAME}}{word}" for word in _say_fate(name, told, score)]
    if answer.odd:
        lines.append(f"{answer.odd:<{_NAME}}{ODD[answer.odd].about} (in {answer.channel})")
    lines += [f"{name:<{_NAME}}was named, but is not hidden" for name in score.false]
    rest = guess.get("unexplained")
    if rest:
        lines.append(f"{'unexplained':<{_NAME}}guess: {rest['share']:.0%} of the residual: {rest['where']}")
        formula = (rest.get("formula") or "").splitlines()[2:]
        lines += [f"{'':{_NAME}}{line}" for line in formula if line]
    elif answer.odd:
        lines.append(f"{'unexplained':<{_NAME}}guess: nothing")
    return lines


def _compare_numbers(truth: Mapping[str, float], guess: Json) -> list[str]:
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


def _say_fate(name: str, told: str, score: Score) -> list[str]:
    """What was said of an effect that was not named for itself."""
    fates = {
        f"named as {told}, another name of the same thing": bool(told) and told != name,
        "left undecided": name in score.undecided,
        "said to leave no trace in this log": name in score.unobservable,
        "missed": name in score.missed,
    }
    return [f"guess: {words}" for words, true in fates.items() if true]


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["write", place]:
            told = list(map(str, write_mysteries(Path(place))))
        case ["reveal", place, results]:
            told = reveal(Path(place), Path(results))
        case _:
            sys.exit("Say what: mystery.py write FOLDER, or mystery.py reveal LOG RESULTS")
    sys.stdout.write("\n".join(told) + "\n")
