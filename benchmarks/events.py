"""Events in motion: what is found of injected ones, how early, and false alarms on recordings.

Injected are digging in, spinning wheels (in the air, too: they bring nothing), sliding, stops under commands
and take-overs, on vehicles that drive as drawn. Found is an event that begins within a second of the truth;
the lead is the time from the first alarm of digging in until the vehicle stands.
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
from measuring import RECORDINGS

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import (
    VEHICLES,
    Disturbance,
    PoseSensor,
    Program,
    Scenario,
    write_log,
)  # fmt: skip

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fixtures"))

from incidents import Incident, IncidentKind, simulate_incidents

KINDS: tuple[IncidentKind, ...] = (
    "digging_in", "stuck", "spinning", "sliding", "stopped", "manual_driving",
)  # fmt: skip
LOST = {"stuck", "spinning", "digging_in"}
FOUND_AS = dict.fromkeys(LOST, LOST)
"""One becomes another: wheels that dig in spin, and a vehicle whose wheels spin is stuck."""
SHOWS = 0.15
"""Of the time of a digging in, after which three tenths of the motion are lost: it begins to show."""
WITHIN_S = 1.0
LEADS_S = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
KNOWN = {
    ("husky_snow_boreal", "stuck"): 2,
    ("warthog_wheels_asphalt_2024_9_20_8h13s12", "stopped"): 1,
    ("warthog_wheels_sand_2024_9_25_14h32s32", "manual_driving"): 1,
}
"""Events of the recordings that were looked at one by one, and are none of false alarms."""


def draw(seed: int) -> tuple[Scenario, Incident]:
    """A drive with one event in its midst; long enough for the vehicle to show what is usual."""
    draws = np.random.default_rng([38, seed])
    kind = KINDS[seed % len(KINDS)]
    start = float(draws.uniform(60.0, 70.0))
    length = float(draws.uniform(8.0, 20.0) if kind == "digging_in" else draws.uniform(4.0, 8.0))
    name = str(draws.choice(["husky", "warthog", "jackal"]))
    noise = float(draws.choice([0.001, 0.003]))
    # Before an event the vehicle drives straight ahead, as one that digs in does.
    scenario = Scenario(
        vehicle=VEHICLES[name],
        seed=seed,
        duration_s=130.0,
        program=Program("smooth", speed_scale=0.6, turn_scale=0.3),
        pose=PoseSensor(rate_hz=float(draws.choice([20.0, 50.0])), noise_m=noise, noise_rad=0.5 * noise),
        disturbance=Disturbance(0.03, 0.05),
        effects={"effective_track": {"k": 1.5}, "drive_lag": {"tau": float(draws.uniform(0.1, 0.4))}},
    )
    return scenario, Incident(kind, start, start + length)


def find_event(scenario: Scenario, incident: Incident, scratch: Path) -> dict[str, object] | None:
    """What a drive's event became: its kind, delays of its begin and its alarm [s], the lead, others found.

    None where the vehicle did not drive straight ahead when it began, so that nothing showed.
    """
    made = simulate_incidents(scenario, incident)
    drive, step = made.truth.drive, made.truth.drive.step_s
    radius = scenario.vehicle.wheel_radius_m
    wanted = slice(int((incident.start_s - 2.0) / step), int((incident.start_s + 4.0) / step))
    if incident.kind in {"stopped", "sliding"}:
        wanted = slice(wanted.start, int(incident.start_s / step))
    left, right = radius * drive.left[wanted], radius * drive.right[wanted]
    ahead, turning = 0.5 * (left + right), 0.5 * np.abs(right - left)
    fast = np.abs(ahead).min() > 0.25 * scenario.vehicle.max_speed_mps * scenario.program.speed_scale
    if not fast or (turning > np.abs(ahead)).any() or np.ptp(np.sign(ahead)) > 0.0:
        return None
    log = scratch / "run.mcap"
    write_log(made, log)
    options = Options(out=scratch / "out", through="slip", diagnosis=False, report=False, force=True)
    outcome = analyze_log(log, options)
    events = outcome.manifest.read("events")
    near = events.filter(
        (pl.col("t_end") > incident.start_s - WITHIN_S) & (pl.col("t_start") < incident.end_s + WITHIN_S)
    )
    same = near.filter(pl.col("kind").is_in(FOUND_AS.get(incident.kind, {incident.kind})))
    first = None if same.is_empty() else same.row(0, named=True)
    begins = incident.start_s
    if incident.kind == "digging_in":
        begins += SHOWS * (incident.end_s - incident.start_s)
    stands = 0.5 * (incident.start_s + incident.end_s)
    return {
        "kind": incident.kind,
        "late": None if first is None else first["t_start"] - begins,
        "alarm": None if first is None else first["t_known"] - begins,
        "lead": None if first is None else stands - first["t_known"],
        "others": events.height - near.height,
    }


def play(count: int, seed: int) -> Iterator[str]:
    """Draw events until so many showed, and tell what was found."""
    results: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as scratch:
        while len(results) < count:
            found = find_event(*draw(seed), Path(scratch))
            seed += 1
            if found is not None:
                results.append(found)
    for kind in KINDS:
        some = [one for one in results if one["kind"] == kind]
        late = [float(str(one["late"])) for one in some if one["late"] is not None]
        alarm = [float(str(one["alarm"])) for one in some if one["alarm"] is not None]
        within = sum(abs(one) <= WITHIN_S for one in late)
        told = f"{kind:<16}{len(some)} drawn, {len(late)} found, {within} begin within {WITHIN_S:g} s"
        yield f"{told}, alarm after {_say_quartiles(alarm)} s" if alarm else told
    leads = [
        float(str(one["lead"])) for one in results if one["kind"] == "digging_in" and one["lead"] is not None
    ]
    yield f"lead before the vehicle stands: {_say_quartiles(leads)} s" if leads else "no lead"
    # As a distribution: whoever stops a robot by it asks how often the lead is long enough.
    shares = [f"{np.mean([one >= least for one in leads]):.0%} of {least:g} s" for least in LEADS_S if leads]
    if shares:
        yield f"leads of at least: {', '.join(shares)}"
    yield f"events elsewhere in these drives: {sum(int(str(one['others'])) for one in results)}"


def _say_quartiles(values: list[float]) -> str:
    low, middle, high = np.quantile(values, (0.05, 0.5, 0.95))
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def count_alarms(logs: Path) -> Iterator[str]:
    """False alarms an hour over the recordings of a folder."""
    seconds, false = 0.0, Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        for log in sorted(logs.glob("*.mcap")):
            outcome = analyze_log(log, Options(out=Path(scratch), diagnosis=False, report=False))
            seconds += float(str(outcome.summary["duration_s"]))
            kinds = Counter(outcome.manifest.read("events")["kind"].to_list())
            more = {kind: count - KNOWN.get((log.stem, kind), 0) for kind, count in kinds.items()}
            false.update({kind: count for kind, count in more.items() if count > 0})
            told = [f"{count} {kind}" for kind, count in more.items() if count > 0]
            if told:
                yield f"  {log.stem}: {', '.join(told)}"
    hours = seconds / 3600.0
    yield f"false alarms: {false.total()} in {hours:.2f} h, {false.total() / hours:.2f} an hour"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=int, default=60, help="how many drawn events")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--logs", type=Path, default=RECORDINGS, help="recordings of normal driving")


def run(asked: argparse.Namespace) -> int:
    """Print what is found of drawn events, and false alarms of recordings."""
    for line in play(asked.count, asked.seed):
        print(line, flush=True)
    for line in count_alarms(asked.logs) if asked.logs.is_dir() else ():
        print(line, flush=True)
    return 0
