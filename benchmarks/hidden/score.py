"""Opening the seals: what was named, undecided, missed, and falsely named."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from draw import Answer  # noqa: TC002 - it runs as a script, too

Json = Mapping[str, object]

# Other names of the same thing, as METHODS, section 4, has them. A point beside base_link is a centre of
# rotation shifted in two directions: both together, or one where only one was hidden.
_SHIFTED = frozenset({"icr_offset", "icr_lateral"})
_SAME: dict[str, frozenset[str]] = {
    "lever_arm": _SHIFTED,
    "icr_offset": frozenset({"lever_arm"}),
    "icr_lateral": frozenset({"lever_arm"}),
    "clock_offset": frozenset({"transport_delay"}),
    "transport_delay": frozenset({"clock_offset"}),
    # Where wheels slide little and nothing is slow, friction is a wider track.
    "contact_friction": frozenset({"effective_track"}),
    "drive_lag": frozenset({"body_inertia"}),
    "body_inertia": frozenset({"drive_lag"}),
}


@dataclass(frozen=True)
class Score:
    """What came of one log.

    Attributes:
        truth: ids that were hidden.
        named: ids that were named.
        found: hidden ids that were named, for themselves or as a member of their class.
        undecided: hidden ids that stand among candidates.
        unobservable: hidden ids that the log was said not to tell of.
        missed: hidden ids of which nothing was said.
        false: named ids that were not hidden.
        flagged: channel in which structure was called unexplained, empty without.
        errors: 2 s position error before, after, and the floor [m].
        groups: what was left undecided: candidates joined by `|`.
        intervals: of every number that was rightly named for itself: on which way it was found, its label,
            the truth, the value, and the ends of its 95 % interval.
    """

    truth: tuple[str, ...]
    named: tuple[str, ...]
    found: tuple[str, ...]
    undecided: tuple[str, ...]
    unobservable: tuple[str, ...]
    missed: tuple[str, ...]
    false: tuple[str, ...]
    flagged: str
    errors: tuple[float, float, float]
    groups: tuple[str, ...] = ()
    intervals: tuple[tuple[str, str, float, float, float, float], ...] = ()

    @property
    def is_exact(self) -> bool:
        """All that was hidden is named, and nothing else."""
        return not self.missed and not self.undecided and not self.unobservable and not self.false


def score_run(answer: Answer, run: Json) -> Score:
    """Compare a run of `slip diagnose --json` with its opened answer."""
    entries = [item for item in _list(run, "effects") if isinstance(item, Mapping)]
    named = [str(item["id"]) for item in entries]
    groups = [set(map(str, _list(item, "candidates"))) for item in _list(run, "undecided")]
    open_ids = set().union(*groups) if groups else set()
    hidden_ids = set(map(str, _list(run, "unobservable")))
    truth = tuple(sorted(answer.effects))
    answered: set[str] = set()
    found, undecided, unobservable, missed = [], [], [], []
    for name in truth:
        match = _find(name, entries)
        answered |= match
        if match:
            found.append(name)
        elif open_ids & {name, *_SAME.get(name, ())}:
            undecided.append(name)
        elif hidden_ids & {name, *_SAME.get(name, ())}:
            unobservable.append(name)
        else:
            missed.append(name)
    false = sorted(
        name for name in named if name not in answered and not ("lever_arm" in truth and name in _SHIFTED)
    )
    flagged = run.get("unexplained")
    channel = "".join(map(str, _list(flagged, "channels"))) if isinstance(flagged, Mapping) else ""
    return Score(
        truth, tuple(named), tuple(found), tuple(undecided), tuple(unobservable), tuple(missed),
        tuple(false), channel, _errors(run), tuple("|".join(sorted(group)) for group in groups),
        tuple(_list_intervals(answer, entries)),
    )  # fmt: skip


def score_runs(answer: Answer, runs: Sequence[Json]) -> Score:
    """Compare runs that were diagnosed together with their answer: each has a clock of its own."""
    score, intervals = score_run(answer, runs[0]), []
    for late, run in zip(answer.clocks[1:], runs[1:], strict=True):
        entries = [item for item in _list(run, "effects") if isinstance(item, Mapping)]
        own = replace(answer, effects={"clock_offset": {"d": late}})
        intervals += list(_list_intervals(own, entries))
    return replace(score, intervals=(*score.intervals, *intervals))


def _list_intervals(
    answer: Answer, entries: Sequence[Json]
) -> Iterator[tuple[str, str, float, float, float, float]]:
    for entry in entries:
        true = answer.effects.get(str(entry["id"]), {})
        told = entry.get("parameters")
        for name, number in told.items() if isinstance(told, Mapping) else ():
            ends = [number.get(key) for key in ("value", "low", "high")]
            # A clock that was put right beforehand, and a number at its bound, have no interval.
            if name not in true or None in ends or number.get("at_bound"):
                continue
            value, low, high = map(float, ends)
            way, label = str(entry.get("found_on", "")), f"{entry['id']}.{name}"
            yield way, label, float(true[name]), value, low, high


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % Wilson interval of a rate."""
    if trials == 0:
        return 0.0, 1.0
    z, rate = 1.959964, successes / trials
    middle = (rate + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials**2)) / (1 + z * z / trials)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def describe_rate(name: str, successes: int, trials: int) -> str:
    """A rate with its interval as a line."""
    low, high = wilson(successes, trials)
    share = successes / trials if trials else math.nan
    return f"{name:<44}{successes:>4} / {trials:<4} = {share:6.1%}   [{low:.1%}, {high:.1%}]"


def confusion_table(scores: Sequence[Score]) -> list[str]:
    """Rows: what was hidden; columns: what was said of it."""
    said: dict[str, Counter[str]] = {}
    for score in scores:
        for name in score.truth or ("nothing",):
            row = said.setdefault(name, Counter())
            if name in score.found or (name == "nothing" and not score.named):
                row["named" if name != "nothing" else "nothing"] += 1
            elif name in score.undecided:
                row["undecided"] += 1
            elif name in score.unobservable:
                row["unobservable"] += 1
            else:
                row["missed" if name != "nothing" else "wrong"] += 1
            for other in score.false:
                row[f"+ {other}"] += 1
    lines = [f"{'hidden':<22}said of it"]
    for name in sorted(said):
        cells = ", ".join(f"{key} {count}" for key, count in said[name].most_common())
        lines.append(f"{name:<22}{cells}")
    return lines


def _find(name: str, entries: Sequence[Json]) -> set[str]:
    """Entries that name an effect: its own, or one that says that it is the same thing and is."""
    ids = {str(entry["id"]) for entry in entries}
    if name in ids:
        return {name}
    if name == "lever_arm":
        return set(_SHIFTED) if ids >= _SHIFTED else set()
    told = {str(entry["id"]) for entry in entries if name in _list(entry, "equivalent_to")}
    return set(sorted(told & _SAME.get(name, frozenset()))[:1])


def _errors(run: Json) -> tuple[float, float, float]:
    ladder = [rung for rung in _list(run, "ladder") if isinstance(rung, Mapping)]
    floor = run.get("noise_floor")
    values = [
        rung.get("t_mrmse_m") if isinstance(rung, Mapping) else None
        for rung in (ladder[0] if ladder else None, ladder[-1] if ladder else None, floor)
    ]
    before, after, least = (float(v) if isinstance(v, int | float) else math.nan for v in values)
    return before, after, least


def _list(content: object, key: str) -> Sequence[object]:
    found = content.get(key) if isinstance(content, Mapping) else None
    return found if isinstance(found, list | tuple) else ()
