"""What `slip watch` takes of a live server: CPU, memory and how late it is, over a replay faster than it was.

A drawn log is played through the server of the Foxglove SDK in a process of its own. `slip watch` records and
follows it; its processes are sampled from /proc.

    make live-replay ARGS="--minutes 60 --speed 20"
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import cast

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "live"))

from live_servers import FoxgloveServer, read_messages

from pipeline.logs import open_log
from pipeline.simulate import Scenario, simulate_run, write_log

_PERIOD_S = 0.25
_TICKS = os.sysconf("SC_CLK_TCK")


def list_tree(root: int) -> list[int]:
    """A process and all that descend from it."""
    found, waiting = [], [root]
    while waiting:
        number = waiting.pop()
        found.append(number)
        try:
            text = Path(f"/proc/{number}/task/{number}/children").read_text()
        except OSError:
            continue
        waiting += [int(word) for word in text.split()]
    return found


def sample(number: int) -> tuple[float, float, str]:
    """CPU time [s] with that of children that have ended, memory [MB], and what it is."""
    try:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        words = Path(f"/proc/{number}/cmdline").read_bytes().split(b"\0")
        status = Path(f"/proc/{number}/status").read_text()
    except OSError:
        return 0.0, 0.0, "gone"
    memory = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")), 0)
    kind = next((k for k in ("receiver", "analyze", "watch") if any(k.encode() in w for w in words)), "-")
    return sum(map(int, fields[11:15])) / _TICKS, memory / 1024, kind


def follow(
    process: subprocess.Popen[str], done: threading.Event
) -> dict[str, list[tuple[float, float, float]]]:
    """Time, CPU time and memory of each kind of process, until the replay is over."""
    seen: dict[str, list[tuple[float, float, float]]] = {}
    while not done.is_set() and process.poll() is None:
        now, total, memory_of_all = time.monotonic(), 0.0, 0.0
        for number in list_tree(process.pid):
            cpu, memory, kind = sample(number)
            seen.setdefault(kind, []).append((now, cpu, memory))
            total, memory_of_all = total + cpu, memory_of_all + memory
        seen.setdefault("all", []).append((now, total, memory_of_all))
        time.sleep(_PERIOD_S)
    return seen


def measure(minutes: float, speed: float, seed: int) -> None:
    """Play a log and print the table."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        log, run = folder / "log.mcap", folder / "run"
        effects = {"effective_track": {"k": 1.8}, "drive_lag": {"tau": 0.3}}
        write_log(simulate_run(Scenario(duration_s=60.0 * minutes, seed=seed, effects=effects)), log)
        command = [sys.executable, __file__, "--serve", str(log), "--speed", str(speed)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            port = cast("str", cast("object", server.stdout and server.stdout.readline())).strip()
            watch = [sys.executable, "-m", "pipeline", "watch", f"ws://127.0.0.1:{port}", "--json"]
            watch += [
                "--record",
                str(run),
                "--results",
                str(folder / "out"),
                "--for",
                "3",
                "--vehicle",
                "husky_a200",
            ]
            begin, done, late = time.monotonic(), threading.Event(), []
            with subprocess.Popen(
                watch, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            ) as process:
                looks = []

                def read() -> None:
                    for line in process.stdout or ():
                        look = json.loads(line)
                        looks.append(look)
                        if look["kind"] == "look" and look["duration_s"]:
                            late.append(time.monotonic() - begin - look["duration_s"] / speed)
                        if look["kind"] == "final":
                            done.set()

                reader = threading.Thread(target=read, daemon=True)
                reader.start()
                ended = threading.Event()
                waiter = threading.Thread(target=lambda: (server.wait(), ended.set()), daemon=True)
                waiter.start()
                seen = follow(process, ended)
                process.wait()
                reader.join()
        sent, kept = open_log(log), open_log(run)
        print(f"log of {minutes:g} min played {speed:g} times as fast: {sent.message_count} messages")
        print(f"recorded {kept.message_count}, {'complete' if kept.complete else kept.losses}")
        for kind in ("all", "watch", "receiver", "analyze"):
            rows = seen.get(kind, [])
            if len(rows) < 2:
                continue
            share = (rows[-1][1] - rows[0][1]) / (rows[-1][0] - rows[0][0])
            half = len(rows) // 2
            first, second = (max(row[2] for row in part) for part in (rows[:half], rows[half:]))
            told = f"{share:6.1%} of a core" if kind != "analyze" else "     (in `watch`)"
            print(
                f"{kind:14s} CPU {told}, memory at most {first:.0f} MB in the first half, "
                f"{second:.0f} MB in the second"
            )
        counted = [one for one in looks if one["kind"] == "look"]
        known = [one["knowledge"] for one in counted if one["knowledge"].get("until_s")]
        print(f"looks {len(counted)}, diagnoses seen {len({one['until_s'] for one in known})}")
        behind = statistics.median(late) - min(late)
        print(f"a look is {behind:.1f} s (median) behind the newest message, beyond the least")
        enough = [one["until_s"] for one in known if one.get("enough")]
        asked = [one for one in known if one.get("enough") and one.get("drive")]
        print(f"said enough after {enough[0]:.0f} s of driving" if enough else "never said enough", end="; ")
        print(f"asked for more afterwards: {len(asked)}")


def main() -> int:
    """Measure, or serve for the measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="length of the log")
    parser.add_argument("--speed", type=float, default=20.0, help="times as fast as it was driven")
    parser.add_argument("--seed", type=int, default=7, help="of the log")
    parser.add_argument("--serve", type=Path, help="play this log and end")
    asked = parser.parse_args()
    if asked.serve is None:
        measure(asked.minutes, asked.speed, asked.seed)
        return 0
    messages, server = read_messages(asked.serve), FoxgloveServer()
    server.advertise(messages)
    print(server.port, flush=True)
    server.play(messages, asked.speed)
    time.sleep(2.0)
    server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
