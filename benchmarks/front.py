"""Logs written anew with one thing changed: the same medians, or a finding that names the change.

Every log is analyzed as it is and with every change of `rewritten_logs.py` that it allows. An answer is
`same` where the medians of slip differ by less than 2 %, `told` where a finding names the change (and, where
the change is undone, the medians stay the same), `WRONG` otherwise.
"""

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))
from measuring import RECORDINGS
from rewritten_logs import Change, Roles, list_changes, read, write
from simulated_platforms import PLATFORMS, simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.core import SlipError
from pipeline.recording.log_setup import set_up_log

SAMPLES = Path(__file__).parents[1] / "data_samples"
STANDING = ("husky_wheels_avide2", "husky_wheels_plank")
"""Recordings of a robot that is lifted or stands: nothing can be said of its signals."""
_SAME = 0.02


@dataclass(frozen=True)
class Answer:
    """Medians of slip by input, and what was told."""

    medians: Mapping[str, float]
    told: str


def ask(log: Path) -> Answer:
    """Analyze a log."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            made = analyze_log(log, Options(out=Path(folder), report=False, diagnosis=False))
        except SlipError as error:
            return Answer({}, f"refused: {error.what}")
    summary = made.summary
    medians = {
        name: float(values["median_modulus"])
        for name, values in dict(summary["by_input"]).items()  # type: ignore[call-overload]
        if values.get("median_modulus") is not None
    }
    findings = [str(one["text"]) for one in summary["findings"]]  # type: ignore[union-attr, index, call-overload]
    return Answer(medians, "\n".join(findings))


def find_roles(log: Path) -> Roles:
    """Topics of the unchanged log."""
    sources = set_up_log(log, Options(out=Path())).sources
    wheels, command = (
        tuple(dict.fromkeys(signal.topic for signal in one.signals)) if one else ()
        for one in (sources.wheels, sources.command)
    )
    return Roles("" if sources.pose is None else sources.pose.topic, wheels, command)


def judge(change: Change, before: Answer, after: Answer) -> str:
    """`same`, `told`, or `WRONG`."""
    shared = before.medians.keys() & after.medians.keys()
    same = bool(shared) and all(
        abs(after.medians[name] - before.medians[name]) <= _SAME * before.medians[name] + 1e-4
        for name in shared
    )
    news = set(after.told.splitlines()) - set(before.told.splitlines())
    if change.never:
        return "WRONG" if any(re.search(change.never, text) for text in news) else "same"
    if change.told and any(re.search(change.told, text) for text in news):
        return "told, same" if same else "told"
    return "same" if same else "WRONG"


def try_log(log: Path, folder: Path, changes: Iterable[Change]) -> list[tuple[str, str]]:
    """Verdict by change that the log allows."""
    content, roles, before = read(log), find_roles(log), ask(log)
    found = []
    for change in changes:
        made = change.make(content, roles)
        if made is None:
            continue
        after = ask(write(made, folder / f"{log.stem}.mcap"))
        found.append((change.name, judge(change, before, after)))
        if found[-1][1] == "WRONG":
            print(f"    {log.stem}: {change.name}: {before.medians} -> {after.medians}; {after.told[:300]}")
    return found


def list_logs(folder: Path, which: str) -> list[Path]:
    """Samples, recordings, or a drawn log of every platform."""
    if which == "samples":
        return sorted(SAMPLES.glob("*.mcap"))
    if which == "recordings":
        logs = [path for path in RECORDINGS.glob("*.mcap") if not path.stem.startswith(STANDING)]
        return sorted(logs, key=lambda path: path.stat().st_size)
    for name in PLATFORMS:
        simulate_platform(name, {}, out=folder / f"{name}.mcap", seed=5, duration_s=100.0)
    return sorted(folder.glob("*.mcap"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--logs", choices=["samples", "recordings", "platforms"], default="samples")
    parser.add_argument("--change", help="pattern of names of changes")


def run(chosen: argparse.Namespace) -> None:
    """Print a table."""
    changes = [one for one in list_changes() if re.search(chosen.change or "", one.name)]
    counts: dict[str, dict[str, int]] = {}
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folder, kept = Path(scratch) / "changed", Path(scratch) / "drawn"
        folder.mkdir()
        kept.mkdir()
        for log in list_logs(kept, chosen.logs):
            try:
                verdicts = try_log(log, folder, changes)
            except Exception as error:  # noqa: BLE001 - the library's parsers raise errors of their own
                print(f"    {log.stem}: not written anew: {str(error)[:100]}")
                continue
            for name, verdict in verdicts:
                counts.setdefault(name, {}).setdefault(verdict, 0)
                counts[name][verdict] += 1
    kinds = ("same", "told, same", "told", "WRONG")
    print(f"{'change':<28}" + "".join(f"{kind:>12}" for kind in kinds))
    for name, found in counts.items():
        print(f"{name:<28}" + "".join(f"{found.get(kind, 0):>12}" for kind in kinds))
    print(f"{time.monotonic() - begun:.0f} s")
