"""How large an effect must be to be seen, against what the diagnosis says it must be.

Every seed draws a scene and an effect of one number (`game.draw`). The log without any effect is diagnosed:
`detectable` says how large the effect would have had to be. Then the same scene is driven with the effect at
shares of that size, and diagnosed. Printed is how often it was named, left undecided, or not seen, by share.
"""

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from game.draw import draw_riddle
from game.play import parse_seeds
from measuring import add_row, read_rows
from plan_game import record

from pipeline.estimation import diagnose_runs
from pipeline.models import find_effect
from pipeline.results import RunDiagnosis
from pipeline.simulate import Scenario

SHARES = (0.25, 0.5, 1.0, 2.0)
ASKED = (
    "wheel_radius", "wheel_asymmetry", "effective_track", "icr_offset", "icr_lateral", "lateral_skid",
    "speed_slip", "turning_resistance", "slope_creep", "lateral_drift", "yaw_drift", "time_drift",
    "speed_track", "heading_skew", "yaw_misalignment",
)  # fmt: skip


def diagnose(scenario: Scenario) -> RunDiagnosis:
    """Simulate, record, analyze and diagnose."""
    with tempfile.TemporaryDirectory() as folder:
        vehicle, recording = record(scenario, Path(folder) / "run.mcap")
        return diagnose_runs([recording], vehicle).runs[0]


def play(seed: int) -> list[dict[str, object]]:
    """All shares of one seed; empty where the log could not tell of its effect."""
    draw = np.random.default_rng([seed, 4])
    effect = str(draw.choice(ASKED))
    scene = draw_riddle("single", seed, effect).scenario
    (name, value), *_ = scene.effects[effect].items()
    empty = diagnose(replace(scene, effects={}))
    limits = [one for one in empty.detectable if (one.id, one.parameter) == (effect, name)]
    rows: list[dict[str, object]] = []
    for share in SHARES if limits else ():
        neutral = find_effect(effect)().parameter(name).neutral
        size = neutral + np.sign(value - neutral) * share * limits[0].size
        told = diagnose(replace(scene, effects={effect: {name: float(size)}}))
        undecided = {one for item in told.undecided for one in item.candidates}
        named = {one.id for one in told.effects} | {e for one in told.effects for e in one.equivalent_to}
        verdict = "named" if effect in named else "undecided" if effect in undecided else "unseen"
        wrong = sorted({one.id for one in told.effects if effect not in {one.id, *one.equivalent_to}})
        row = {"seed": seed, "effect": effect, "share": share, "size": float(size)}
        rows.append({**row, "verdict": verdict, "wrong": wrong})
    return rows


def describe(rows: list[dict[str, object]]) -> str:
    """The table by share."""
    counts: dict[float, Counter[str]] = defaultdict(Counter)
    for row in rows:
        counts[float(str(row["share"]))].update([str(row["verdict"]), *(["wrong"] if row["wrong"] else [])])
    kinds = ("named", "undecided", "unseen", "wrong")
    lines = [f"{'of the stated size':<20}" + "".join(f"{key:>11}" for key in ("logs", *kinds))]
    for share, count in sorted(counts.items()):
        logs = count["named"] + count["undecided"] + count["unseen"]
        lines.append(f"{share:<20g}" + "".join(f"{n:>11}" for n in (logs, *(count[key] for key in kinds))))
    return "\n".join(lines) + "\n"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", default=list(range(20)), type=parse_seeds)
    parser.add_argument("--out", type=Path, help="file to add a JSON line to for each log")
    parser.add_argument("--resume", action="store_true", help="go on where the file of --out ends")


def run(asked: argparse.Namespace) -> int:
    rows = read_rows(asked.out) if asked.resume else []
    done = {row["seed"] for row in rows}
    for seed in asked.seeds:
        for row in play(seed) if seed not in done else ():
            rows.append(row)
            add_row(asked.out, row)
    sys.stdout.write(describe(rows))
    return 0
