"""Whether starts that the wheels show to be late are late in the gyro, too.

Run: python benchmarks/late_starts.py [WORD ...]. Every recording under ../shared/logs with commands, wheels
and a gyro: the lateness of every first command after a stop or a gap, from the wheels, and once more with the
yaw rate of the gyro in place of the wheels. If the drive was late, both show it; if the encoders were, the
gyro does not. The spread is that of all other steps; `late` counts the starts above 0.15 s by the wheels, and
`in both` those of which the gyro shows at least half.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.core.arrays import robust_spread
from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.job.run_results import read_recording
from pipeline.stages.drive_numbers import measure_responses

LOGS = Path(__file__).parents[2] / "shared" / "logs"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", default=[""], help="words of the recordings' names")
    words = parser.parse_args().words
    sys.stdout.write(
        f"{'recording':<44}{'starts':>7}{'spread':>8}{'late':>6}{'in both':>8}{'correlation':>13}\n"
    )
    for log in sorted(LOGS.glob("*.mcap")):
        if any(word in log.name for word in words) and (row := compare(log)):
            sys.stdout.write(f"{log.stem:<44}{row}\n")
    return 0


def compare(log: Path) -> str:
    """One row of the table; empty without commands, wheels and gyro, or without starts."""
    with tempfile.TemporaryDirectory() as folder:
        vehicle, recording = read_recording(
            analyze_log(log, Options(out=Path(folder), report=False)).manifest
        )
        tables = recording.tables
    imu, commands, wheels = (tables.get(name) for name in ("imu", "commands", "wheels"))
    if imu is None or commands is None or wheels is None or imu.is_empty() or not vehicle.track_width_m:
        return ""
    side = imu["rate_z"].to_numpy() * 0.5 * vehicle.track_width_m / vehicle.wheel_radius_m
    if float(tables["alignments"]["gyro_scale"].fill_null(1.0)[0]) < 0.0:
        side = -side
    turning = imu.select("t", "active").with_columns(pl.Series("left", -side), pl.Series("right", side))
    one, two = (measure_responses(commands, table, vehicle) for table in (wheels, turning))
    both, first, second = np.intersect1d(one.start, two.start, return_indices=True)
    starts = one.is_first[first]
    if not starts.any():
        return ""
    seen, felt = one.late[first][starts], two.late[second][starts]
    late = seen > 0.15
    agree = np.count_nonzero(felt[late] > 0.5 * seen[late])
    correlation = float(np.corrcoef(seen, felt)[0, 1]) if both.size > 2 and np.ptp(seen) else float("nan")
    spread = robust_spread(one.late[~one.is_first]) if (~one.is_first).any() else float("nan")
    return f"{seen.size:>7}{spread:>8.3f}{np.count_nonzero(late):>6}{agree:>8}{correlation:>13.2f}"


if __name__ == "__main__":
    sys.exit(main())
