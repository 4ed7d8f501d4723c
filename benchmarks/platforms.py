"""What the program makes of logs as platforms publish them.

Every platform's log is simulated with hidden effects and handed to `slip diagnose` without any configuration.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))
from simulated_platforms import PLATFORMS, Platform, simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log

CAR = {"steering_offset": 0.05, "drive_lag": 0.3}
SIDES = {"effective_track": 1.5, "drive_lag": 0.3}
GROUND = {"wheel_radius": 0.93}
"""For a platform whose commands are no speeds: what its measured wheels do on the ground."""
MECANUM = {"lateral_scale": 0.85, "effective_track": 1.2, "drive_lag": 0.3}


@dataclass(frozen=True)
class Row:
    """What became of one platform's log."""

    platform: str
    command: str
    wheels: str
    pose: str
    vehicle: str
    effects: tuple[str, ...]
    hidden: tuple[str, ...]

    @property
    def named(self) -> bool:
        return set(self.effects) == set(self.hidden)


def hidden_effects(platform: Platform) -> dict[str, float]:
    if platform.vehicle.name == "tartandrive":
        return GROUND
    return {"ackermann": CAR, "mecanum": MECANUM}.get(platform.vehicle.kind, SIDES)


def try_platform(name: str, folder: Path, *, duration_s: float = 180.0, seed: int = 3) -> Row:
    platform = PLATFORMS[name]
    hidden = hidden_effects(platform)
    log = simulate_platform(name, hidden, out=folder / f"{name}.mcap", seed=seed, duration_s=duration_s)
    options = Options(out=folder / "results", report=False, diagnosis=True)
    summary = analyze_log(log, options).summary
    topics, diagnosis = summary["topics"], summary["diagnosis"]
    chosen = {role: (topics[role] or {}).get("topic", "-") for role in ("command", "wheels", "pose")}
    effects = tuple(effect["id"] for effect in diagnosis["effects"])
    vehicle = f"{summary['vehicle']} ({str(summary['vehicle_source']).replace('_', ' ')})"
    return Row(name, **chosen, vehicle=vehicle, effects=effects, hidden=tuple(hidden))


def print_table(rows: list[Row]) -> None:
    print("| platform | command | wheels | pose | vehicle (geometry from) | hidden effects named |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        named = "yes" if row.named else f"no: {', '.join(row.effects) or 'nothing'}"
        cells = (row.platform, row.command, row.wheels, row.pose, row.vehicle, named)
        print(f"| {' | '.join(cells)} |", flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("platforms", nargs="*", help="which; all without")
    parser.add_argument("--seed", type=int, default=3)


def run(chosen: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory(prefix="slip-platforms-") as folder:
        names = chosen.platforms or list(PLATFORMS)
        print_table([try_platform(name, Path(folder), seed=chosen.seed) for name in names])
