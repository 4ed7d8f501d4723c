"""Write the three mystery logs of data_samples, each with its sealed answer; or open a seal.

python benchmarks/hidden/mystery.py write data_samples
python benchmarks/hidden/mystery.py open data_samples/mystery_1.sealed
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from draw import Category, Riddle, draw_riddle, open_seal, write_riddle

_DRAWN: tuple[tuple[Category, int], ...] = (("single", 901), ("sets", 902), ("odd", 903))
_LONGEST_S = 150.0


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


def describe_answer(path: Path) -> str:
    """The answer of a seal in words."""
    answer = open_seal(path.read_text(encoding="ascii"))
    effects = [
        f"{name} ({', '.join(f'{key} = {value:.3g}' for key, value in values.items())})"
        for name, values in answer.effects.items()
    ]
    hidden = " and ".join(effects) or f"physics that no catalogue has: {answer.odd} (in {answer.channel})"
    return f"{path.stem}: {hidden}"


if __name__ == "__main__":
    verb, place = sys.argv[1:3]
    if verb == "write":
        sys.stdout.write("\n".join(map(str, write_mysteries(Path(place)))) + "\n")
    else:
        sys.stdout.write(describe_answer(Path(place)) + "\n")
