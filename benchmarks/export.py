"""What exporting a long run as MCAP or CSV takes: time and peak memory against the length of the log.

A simulated log of ten minutes is analyzed, and its tables are laid end to end until the run is long
enough. Ours is `slip export --to mcap`, without a model and with one of two effects. The peer in the same run
writes the same topics without the model, trail, path and findings: whole tables in memory, sorted, through
the official writer.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import polars as pl
from measuring import RUNNER, Cost, measure_command

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case
from pipeline.store import Manifest, Store

PIECE_S = 600.0
RUN = "bench/long"
MODEL = """format = 1
[vehicle]
preset = "husky_a200"
[[effect]]
id = "effective_track"
k = 1.8
[[effect]]
id = "drive_lag"
tau = 0.3
"""

PEER = """
import sys
from pathlib import Path
import polars as pl
from mcap_ros2.writer import Writer
from pipeline.logs.schema import definition_text
from pipeline.store import Store
(manifest,) = Store(Path(sys.argv[1])).manifests()
velocities, slip = manifest.read("velocities"), manifest.read("slip")
messages = []
def stamp(ns):
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base_link"}
def twist(x, y, w):
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {"linear": {**zero, "x": x, "y": y}, "angular": {**zero, "z": w}}
for row in velocities.iter_rows(named=True):
    at = row["stamp"]
    measured = {"header": stamp(at), "twist": twist(row["v_x"], row["v_y"], row["v_w"])}
    messages.append((at, "/slip/velocity/measured", measured))
    place = {"position": {"x": row["x"], "y": row["y"], "z": row["z"]}}
    turn = {"orientation": {"x": 0.0, "y": 0.0, "z": row["yaw"], "w": 1.0}}
    messages.append((at, "/slip/pose", {"header": stamp(at), "pose": {**place, **turn}}))
    messages.append((at, "/slip/segment", {"data": row["segment"]}))
for row in slip.iter_rows(named=True):
    at, name = row["stamp"], row["input"]
    ideal = {"header": stamp(at), "twist": twist(row["f_x"], row["f_y"], row["f_w"])}
    rest = {"header": stamp(at), "twist": twist(row["g_x"], row["g_y"], row["g_w"])}
    messages.append((at, f"/slip/velocity/ideal_{name}", ideal))
    messages.append((at, f"/slip/slip_{name}", rest))
    messages.append((at, f"/slip/modulus_{name}", {"data": row["modulus"]}))
messages.sort(key=lambda message: message[0])
with open(sys.argv[2], "wb") as stream:
    writer = Writer(stream)
    kinds = {
        name: writer.register_msgdef(name, definition_text(name))
        for name in ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Int32",
                     "std_msgs/msg/Float64")
    }
    def kind_of(topic):
        if topic == "/slip/pose":
            return kinds["geometry_msgs/msg/PoseStamped"]
        if topic == "/slip/segment":
            return kinds["std_msgs/msg/Int32"]
        return kinds["std_msgs/msg/Float64" if "modulus" in topic else "geometry_msgs/msg/TwistStamped"]
    for at, topic, message in messages:
        writer.write_message(topic, kind_of(topic), message, log_time=at, publish_time=at)
    writer.finish()
"""


def lengthen(piece: Manifest, folder: Path, hours: float) -> None:
    """Lay a run's tables end to end until it is so long, and store the whole as a run of its own."""
    count = round(hours * 3600.0 / PIECE_S)
    with Store(folder).open_generation(RUN, "0" * 16) as generation:
        for name in piece.tables:
            table = piece.read(name)
            # Aggregates are numbers of the whole run: they do not get longer.
            parts = [shift(table, number) for number in range(1 if name == "aggregates" else count)]
            whole = pl.concat(parts)
            if "input" in whole.columns:
                whole = whole.sort("input", maintain_order=True)
            generation.write_table(name, whole)
        generation.commit(dict(piece.details))


def shift(table: pl.DataFrame, number: int) -> pl.DataFrame:
    """The same rows, so many pieces later."""
    later = number * PIECE_S
    seconds = [pl.col(name) + later for name in ("t", "t_start", "t_end") if name in table.columns]
    stamps = [pl.col(name) + round(later * 1e9) for name in ("stamp", "log_time") if name in table.columns]
    counts = [pl.col(name) + 1000 * number for name in ("segment", "step") if name in table.columns]
    return table.with_columns(*seconds, *stamps, *counts)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 3.0, 10.0])
    parser.add_argument("--peer-hours", type=float, default=1.0, help="longest log that the peer is given")
    parser.add_argument("--prepare", type=Path, help=argparse.SUPPRESS)


def run(chosen: argparse.Namespace) -> None:
    if chosen.prepare:
        prepare_run(chosen.prepare, chosen.hours[0])
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare = [*RUNNER, "export", "--prepare", str(folder), "--hours"]
        model = folder / "model.toml"
        model.write_text(MODEL, encoding="utf-8")
        print(f"{'log':<8}{'':<34}{'wall s':>8}{'peak MB':>9}{'file MB':>9}")
        for hours in chosen.hours:
            results = folder / f"{hours:g}"
            # In a process of its own: what a parent holds counts as its child's peak.
            subprocess.run([*prepare, str(hours)], check=True)
            out = folder / "out.mcap"
            export = [sys.executable, "-m", "pipeline", "export", RUN, "--to", "mcap", "--quiet"]
            export += ["--results", str(results), "--file", str(out)]
            table = {"slip export": export, "slip export --model": [*export, "--model", str(model)]}
            if hours <= chosen.peer_hours:
                table["whole tables, official writer"] = [
                    sys.executable,
                    "-c",
                    PEER,
                    str(results),
                    str(out),
                ]
            folder_of_tables = folder / "out.csv"
            words = ["csv" if word == "mcap" else word for word in export[:-1]]
            cost = measure_command([*words, str(folder_of_tables)])
            size = sum(file.stat().st_size for file in folder_of_tables.iterdir()) / 1e6
            show(hours, "slip export --to csv", cost, size)
            shutil.rmtree(folder_of_tables)
            for title, command in table.items():
                cost = measure_command(command)
                size = out.stat().st_size / 1e6
                show(hours, title, cost, size)
                out.unlink()


def show(hours: float, title: str, cost: Cost, size_mb: float) -> None:
    """Print a row."""
    label = f"{hours:g} h"
    print(f"{label:<8}{title:<34}{cost.wall_s:>8.1f}{cost.peak_mb:>9.0f}{size_mb:>9.0f}", flush=True)


def prepare_run(folder: Path, hours: float) -> None:
    """Simulate and analyze ten minutes once, and make a run of so many hours of it."""
    log, results = folder / "ten_minutes.mcap", folder / "ten_minutes"
    if not results.exists():
        simulate_case("husky_tile", out=log, duration_s=PIECE_S)
        analyze_log(log, Options(out=results, report=False, diagnosis=False))
    (piece,) = Store(results).manifests()
    lengthen(piece, folder / f"{hours:g}", hours)
