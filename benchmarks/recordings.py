"""What the right effects, given by hand, leave of the ideal model's error on the real recordings.

Every recording under ../shared/logs whose name
holds one of the words (all without any), from measured wheels and from commands: held-out errors after the
effects over those of the ideal model, beside the table "On the real recordings" of METHODS.md section 5. With
--ladders the effects are climbed one by one and every rung's 2 s error is printed: it falls, or it stops.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from measuring import RECORDINGS
from real_recordings import CASES, Reached, Recordings, make_model, measure

from pipeline.estimation import EstimationData, climb


def describe_values(reached: Reached) -> str:
    timing, late = reached.fitted.state.timing[0], reached.data.runs[0].alignment.heading_delay_s
    parts = [
        f"{effect.id} " + " ".join(f"{name}={value:.3g}" for name, value in effect.values.items())
        for effect in reached.fitted.model.effects
    ]
    return "; ".join(
        (
            *parts,
            f"poses {late:.2f} s late, wheels {timing.wheel_delay_s:.2f} s",
        )
    )


def print_row(name: str, values: tuple[float, ...]) -> None:
    sys.stdout.write(f"  {name:<18}" + "".join(f"{value:8.3f}" for value in values) + "\n")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("words", nargs="*", help="of the recordings' names; all without any")
    parser.add_argument("--ladders", action="store_true", help="climb the effects one by one")


def run(given: argparse.Namespace) -> None:
    chosen = [case for case in CASES if not given.words or any(word in case.log for word in given.words)]
    worst: list[tuple[float, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        recordings = Recordings(RECORDINGS, Path(folder))
        for case in chosen:
            driven, vehicle = recordings.load(case.log)
            if given.ladders:
                ladder = climb(
                    EstimationData([driven], vehicle, case.source), make_model(vehicle, case.effects)
                )
                errors = [rung.errors.t_mrmse_m for rung in ladder.steps]
                fell = "falls" if errors == sorted(errors, reverse=True) else "RISES"
                names = ["ideal", *ladder.steps[-1].effects]
                steps = "  ".join(f"{error:.4f}" for error in errors)
                sys.stdout.write(f"{case.log} {case.source.value}: {fell}  {steps}  m  {' + '.join(names)}")
                sys.stdout.write(f"  left out: {', '.join(ladder.idle) or 'none'}\n")
                sys.stdout.flush()
                continue
            reached = measure(driven, vehicle, case.source, case.effects)
            sys.stdout.write(
                f"{case.log}, {case.source.value}: {reached.windows} windows, "
                f"ideal {reached.t_before_m:.3f} m {reached.r_before_rad:.3f} rad, "
                f"latencies vary {driven.alignment.latency_spread_s:.3f} s, "
                f"outliers {driven.alignment.outlier_s:.1f} s of {driven.duration_s:.0f} s\n"
                f"  {describe_values(reached)}\n"
                f"  {'':<18}{'x':>8}{'y':>8}{'w':>8}{'T':>8}{'R':>8}{'R turns':>8}\n"
            )
            ours = np.array((*reached.ratios, reached.turned))
            table = np.array((*case.table, case.table[4]))
            print_row("ours", tuple(ours.tolist()))
            print_row("METHODS", tuple(table.tolist()))
            print_row("ours / METHODS", tuple((ours / table).tolist()))
            sys.stdout.flush()
            for channel, share in zip("xywTR", (ours / table)[:5].tolist(), strict=True):
                if share > 1.1:
                    worst.append((share, f"{channel} of {case.log}, {case.source.value}"))
    for share, what in sorted(worst, reverse=True):
        sys.stdout.write(f"beyond 1.1: {share:.2f}  {what}\n")
