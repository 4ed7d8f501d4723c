"""Drawn logs replayed as they grew: what a running log states, against what the finished log says.

Each log is cut where a recorder would have been after shares of its length, and every cut is diagnosed as
`slip watch` diagnoses it. Counted are the stated intervals that hold the finished log's value, the names that
the finished log does not have, and the CPU time of a look.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

from game.draw import Category, draw_riddle, write_riddle
from measuring import add_row, read_rows

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.live import list_known, list_passing
from pipeline.results import RunDiagnosis, read_result, to_json

Content = Mapping[str, object]
_Ends = tuple[float, float, float]

SHARES = (0.35, 0.55, 0.75, 1.0)
"""Of the file's bytes, at which it is looked at."""
LONGEST_S = 180.0
"""Longer drawn logs are shortened to it: what counts is how often a log is looked at, and in what order."""
MIX: tuple[Category, ...] = ("single", "sets", "natural", "equipped", "empty")


CLOSED = "closed"
"""Logs without a missing effect whose commands answer the measured pose."""


def replay(category: str, seed: int) -> dict[str, object]:
    """Diagnose a drawn log after each of `SHARES`.

    Args:
        category: kind of log, one of `MIX` or `CLOSED`.
        seed: from which it is drawn.
    """
    is_closed = category == CLOSED
    riddle = draw_riddle(
        "empty" if is_closed else cast("Category", category), seed, CLOSED if is_closed else None
    )
    scenario = replace(riddle.scenario, duration_s=min(riddle.scenario.duration_s, LONGEST_S))
    looks = []
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch, "whole.mcap")
        write_riddle(replace(riddle, scenario=scenario), whole)
        content = whole.read_bytes()
        for number, share in enumerate(SHARES):
            log = Path(scratch, f"cut_{number}.mcap")
            log.write_bytes(content[: int(share * len(content))])
            looks.append({"share": share, **look(log, Path(scratch, f"out_{number}"))})
    return {"category": category, "seed": seed, "duration_s": scenario.duration_s, "looks": looks}


def look(log: Path, out: Path) -> dict[str, object]:
    """One look: the effects that are named, and what it took."""
    begin, spent = time.perf_counter(), time.process_time()
    try:
        outcome = analyze_log(log, Options(out=out, report=False, diagnosis=True))
        diagnosis, problem = read_result(outcome.summary["diagnosis"], RunDiagnosis), None
    except SlipError as error:
        diagnosis, problem = RunDiagnosis(), str(error)
    return {
        "effects": to_json(RunDiagnosis(effects=diagnosis.effects))["effects"],
        "undecided": [list(one.candidates) for one in diagnosis.undecided],
        "cpu_s": round(time.process_time() - spent, 2),
        "wall_s": round(time.perf_counter() - begin, 2),
        "error": problem,
    }


def judge(record: Content) -> Iterator[dict[str, object]]:
    """Every statement of a running log: the effect, whether the end has it, and which intervals hold."""
    *running, last = cast("list[Content]", record["looks"])
    final = {str(one["id"]): one for one in cast("list[Content]", last["effects"])}
    for one in list(final.values()):
        final |= dict.fromkeys(cast("list[str]", one["equivalent_to"]), one)
    before: list[str] = []
    for here in running:
        seen = read_result({"effects": here["effects"]}, RunDiagnosis)
        stated: dict[str, list[Content]] = {}
        for one in list_known(seen, before):
            stated.setdefault(one["effect"], []).append(one)
        for effect, numbers in stated.items():
            found = cast("Mapping[str, Content]", final.get(effect, {}).get("parameters", {}))
            ends = [
                (one["low"], found[str(one["parameter"])]["value"], one["high"])
                for one in numbers
                if one["parameter"] in found
                and one["low"] is not None
                and found[str(one["parameter"])]["value"] is not None
            ]
            yield {
                "share": here["share"],
                "effect": effect,
                "kept": effect in final,
                "held": [
                    low <= value <= high
                    for low, value, high in cast("list[tuple[float, float, float]]", ends)
                ],
            }
        before = list_passing(seen)


def describe(records: list[Content]) -> list[str]:
    """The table of what was counted."""
    statements = [(record, one) for record in records for one in judge(record)]
    held = [value for _, one in statements for value in cast("list[bool]", one["held"])]
    names = {(r["category"], r["seed"], one["effect"]): one["kept"] for r, one in statements}
    looks = [look for record in records for look in cast("list[Content]", record["looks"])]
    cpu = sorted(cast("float", one["cpu_s"]) for one in looks)
    final = sum(len(cast("list[Content]", cast("list[Content]", r["looks"])[-1]["effects"])) for r in records)
    back = [not kept for kept in names.values()]
    return [
        f"logs {len(records)}, looks {len(looks)}, names of the finished logs {final}",
        f"names stated before the end {len(names)}, taken back {_share(back)}",
        f"intervals stated {len(held)}, hold the final value {_share(held)}",
        f"CPU time of a look: median {cpu[len(cpu) // 2]:.1f} s, largest {cpu[-1]:.1f} s" if cpu else "",
    ]


def _share(flags: list[bool]) -> str:
    """How many of some are true, with the 95 % interval of the share."""
    count, size = sum(flags), max(len(flags), 1)
    half = 1.96 * math.sqrt(max(count * (size - count), 1) / size**3)
    return f"{count} of {len(flags)} ({count / size:.1%} +- {half:.1%})"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--logs", type=int, default=20, help="how many logs")
    parser.add_argument("--closed", type=int, default=0, help="how many of them are driven in closed loop")
    parser.add_argument("--until", type=float, default=math.inf, help="minutes after which no log is begun")
    parser.add_argument("--file", type=Path, help="JSON lines of what was counted, gone on with")
    parser.add_argument("--table", action="store_true", help="only print the table of the file")


def run(asked: argparse.Namespace) -> int:
    """Replay the drawn logs of some seeds, each category in turn, and print the table."""
    records: list[Content] = [*read_rows(asked.file)]
    done = {(record["category"], record["seed"]) for record in records}
    begin = time.perf_counter()
    for number in range(0 if asked.table else asked.logs):
        category = MIX[number % len(MIX)] if number < asked.logs - asked.closed else CLOSED
        seed = asked.seed + number
        if (category, seed) in done or time.perf_counter() - begin > 60.0 * asked.until:
            continue
        records.append(replay(category, seed))
        print(f"{category} {seed}: {[(s['effect'], s['kept']) for s in judge(records[-1])]}", flush=True)
        add_row(asked.file, records[-1])
    print("\n".join(describe(records)))
    return 0
