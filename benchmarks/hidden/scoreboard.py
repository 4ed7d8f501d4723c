"""Records as text: rates with Wilson intervals, confusion tables, times, and every miss with its seed."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from draw import CATEGORIES
from odd_physics import ODD
from records import Record
from score import confusion_table, describe_rate

# What contact does to any skid-steer made of rigid bodies, beside what was built into it. Scrub slows the
# wheels, too, as their controllers have no integral part: the encoders' difference falls .067 rad/s short of
# the command at every rate of turn (seed 993004). A curve's centripetal force takes grip from scrubbing, so
# that turning gains with speed: on a Warthog .54 of the wheels' rate on the spot, .76 at 2.5 m/s and 1 rad/s
# (`test_a_fast_curve_turns_more_of_what_its_wheels_ask_than_a_spin`).
_CONTACT = frozenset(
    {
        "effective_track", "icr_offset", "lateral_skid", "body_inertia", "turning_resistance", "speed_slip",
        "wheel_radius", "drive_lag", "turn_lag", "acceleration_limit", "difference_gain", "turn_droop",
        "wheel_servo", "speed_track", "contact_friction",
    }
)  # fmt: skip
_BUILT_IN = {"payload": {"icr_lateral"}, "small_wheels": {"wheel_asymmetry", "icr_lateral"}}
_WORSE = 1.05
_FORMULA = 0.02
_WEAKEST = 0.8

_MODELLED = frozenset({"single", "small", "sets", "equipped", "rigid"})
_KINDS: dict[str, Callable[[Record], str]] = {
    "empty": lambda record: record.answer.note,
    "rigid": lambda record: record.answer.note,
    "odd": lambda record: record.answer.odd,
    "poor": lambda record: record.answer.program,
    "equipped": lambda record: record.answer.note,
}

Test = Callable[[Record], bool]


def write_scoreboard(records: Iterable[Record]) -> str:
    """All categories, one after the other."""
    by_category = _group(records, lambda record: record.job.category)
    versions = Counter(record.version for group in by_category.values() for record in group)
    played_with = ", ".join(f"{version or 'unknown'} ({count})" for version, count in versions.items())
    lines = [f"played with {played_with}", ""]
    for category in CATEGORIES:
        if category in by_category:
            lines += [*describe(category, by_category[category]), ""]
    return "\n".join(lines)


def describe(category: str, played: Sequence[Record]) -> list[str]:
    """The rates that belong to a category, by kind of riddle, then confusions, times and misses."""
    played = sorted(played, key=lambda record: (record.job.seed, record.job.effect or ""))
    lines = [f"== {category}: {len(played)} logs"]
    counted = played
    if category == "empty":
        lines.append(_rate(played, "nothing named and nothing flagged", is_clean))
    elif category == "odd":
        lines.append(_rate(played, "flagged in the right channel", is_flagged))
        lines.append(_rate(played, "so flagged, or named as what it is like", is_owned_up_to))
        lines.append(_rate(played, "a wrong name, and nothing flagged", is_mistaken))
        lines.append(_rate(played, "the pasted formula lowers the held-out error", has_useful_formula))
    elif category == "poor":
        lines.append(_rate(played, "undecided or unobservable", is_admitted))
        lines.append(_rate(played, "undecided, unobservable or rightly named", is_not_missed))
        lines.append(_rate(played, "a confident wrong name", has_wrong_name))
    else:
        counted = [record for record in played if not record.is_weak]
        weak = Counter(_KINDS.get(category, _join_truth)(record) for record in played if record.is_weak)
        lines.append(
            f"{weak.total()} too weak to count: an effect lowers the true model's error by less than 5 %"
        )
        lines += [f"  {', '.join(f'{name} {count}' for name, count in weak.most_common())}"] if weak else []
        lines.append(_rate(counted, "all that is hidden is named", is_found))
        lines.append(_rate(counted, "nothing else beside it", _has_no_other))
        lines.append(_rate(counted, "exactly right", is_exact))
        lines.append(_rate(counted, "named, or undecided with it", is_narrowed))
        hiding = [record for record in counted if record.score.truth]
        lines.append(_rate(hiding, f"error within {_WORSE:g} of the true model's", is_as_good))
        if category == "rigid":
            lines.append(_rate(counted, "all is named, a turn_lag being a motor's lag", is_found_in_contact))
            extras = [len(list_unphysical(record)) for record in played]
            lines.append(
                f"unphysical names beside them: {sum(extras)} in {len(extras)} logs, "
                f"{7.0 * sum(extras) / len(extras):.2f} in seven"
            )
    right = _choose_test(category)
    lines += describe_intervals(counted)
    lines += _list_kinds(category, counted, right)
    if category == "odd":
        lines += _list_kinds(category, counted, has_useful_formula, "a formula that helps, by kind")
    lines += confusion_table([record.score for record in counted])
    lines += describe_times(played)
    lines += [
        f"  {record.outcome}: {record.job.replay}   {' '.join(record.note.split())[:200]}"
        for record in played
        if record.note or record.outcome != "scored"
    ]
    misses = [record for record in counted if record.outcome == "scored" and not right(record)]
    lines += [_describe_miss(record) for record in misses]
    return lines


def describe_intervals(played: Sequence[Record]) -> list[str]:
    """How often a stated 95 % interval holds the truth, by the way that the number was found on."""
    found: dict[str, list[bool]] = defaultdict(list)
    missed: Counter[str] = Counter()
    for record in played:
        for way, label, truth, _, low, high in record.score.intervals:
            found[way].append(low <= truth <= high)
            missed[label] += not found[way][-1]
    lines = [
        describe_rate(f"95 % intervals that hold the truth, {way}", sum(held), len(held))
        for way, held in sorted(found.items())
    ]
    outside = ", ".join(f"{label} {count}" for label, count in missed.most_common() if count)
    return [*lines, f"  outside: {outside}"] if outside else lines


def is_clean(record: Record) -> bool:
    """Nothing named, nothing undecided, nothing flagged."""
    score = record.score
    return record.outcome == "scored" and not (score.named or score.groups or score.flagged)


def is_exact(record: Record) -> bool:
    """All that was hidden is named, and nothing else."""
    return record.score.is_exact


def is_found(record: Record) -> bool:
    """All that was hidden is named."""
    return len(record.score.found) == len(record.score.truth)


def is_narrowed(record: Record) -> bool:
    """All that was hidden is named or stands among the candidates of what is undecided, and nothing else."""
    score = record.score
    return not score.missed and not score.unobservable and not score.false


def is_found_in_contact(record: Record) -> bool:
    """As `is_found`; slow motors on ground that brakes turning are late in the two ways of turn_lag."""
    found = {*record.score.found, *({"drive_lag"} if "turn_lag" in record.score.named else ())}
    return set(record.score.truth) <= found


def has_wrong_name(record: Record) -> bool:
    """Something is named that was not hidden."""
    return bool(record.score.false)


def is_not_missed(record: Record) -> bool:
    """What was hidden is named, undecided or unobservable."""
    return not record.score.missed


def is_admitted(record: Record) -> bool:
    """What was hidden is undecided or unobservable."""
    return not record.score.missed and not record.score.found


def is_flagged(record: Record) -> bool:
    """Something is unexplained in a channel that the odd physics acts on."""
    return bool(set(record.score.flagged) & set(record.answer.channel))


def is_owned_up_to(record: Record) -> bool:
    """It is flagged in its channel, or what is named says the same."""
    return is_flagged(record) or bool(set(record.score.named) & set(ODD[record.answer.odd].alike))


def is_mistaken(record: Record) -> bool:
    """Something is named that it is not like, without a flag that more is there."""
    return bool(set(record.score.named) - set(ODD[record.answer.odd].alike)) and not is_flagged(record)


def has_useful_formula(record: Record) -> bool:
    """The formula, pasted after what was named, lowers one 2 s error and raises none."""
    checked = record.checked
    if checked is None or checked.formula is None or checked.named is None:
        return False
    return checked.formula.falls_below(checked.named, _FORMULA) and (
        checked.formula.ratio(checked.named) <= 1.0 + _FORMULA
    )


def is_as_good(record: Record) -> bool:
    """The named model's 2 s errors are within 1.05 times the true model's."""
    checked = record.checked
    if checked is None or checked.named is None or checked.true is None:
        return False
    return checked.named.ratio(checked.true) <= _WORSE


def list_unphysical(record: Record) -> list[str]:
    """Names that neither contact nor what was built into a rigid body explains."""
    physical = _CONTACT | _BUILT_IN.get(record.answer.note, set())
    return [name for name in record.score.false if name not in physical]


def describe_times(played: Sequence[Record]) -> list[str]:
    """Wall and CPU time of `slip diagnose` by length of the log, and of the harness round it."""
    scored = [record for record in played if "ask" in record.wall_s]
    if not scored:
        return []
    lines = [f"{'log':<10}{'logs':>6}{'wall s: median':>16}{'p95':>8}{'CPU s: median':>16}{'p95':>8}"]
    by_length = _group(scored, lambda record: f"{float(str(record.scene['duration_s'])):.0f} s")
    rows = [*sorted(by_length.items(), key=lambda item: float(item[0].split()[0])), ("all", scored)]
    for name, group in rows:
        wall = np.array([record.wall_s["ask"] for record in group])
        cpu = np.array([record.cpu_s["ask"] for record in group])
        lines.append(
            f"{name:<10}{len(group):>6}{np.median(wall):>16.2f}{np.quantile(wall, 0.95):>8.2f}"
            f"{np.median(cpu):>16.2f}{np.quantile(cpu, 0.95):>8.2f}"
        )
    parts = [
        f"{part} {np.median([record.cpu_s[part] for record in scored if part in record.cpu_s]):.2f} s"
        for part in ("draw", "stages", "diagnosis", "check")
        if any(part in record.cpu_s for record in scored)
    ]
    lines.append(f"CPU, medians: {', '.join(parts)}")
    return lines


def _has_no_other(record: Record) -> bool:
    """Whether a log was diagnosed and nothing was named that it does not hide."""
    return record.outcome == "scored" and not has_wrong_name(record)


def _rate(played: Sequence[Record], name: str, test: Test) -> str:
    return describe_rate(name, sum(test(record) for record in played), len(played))


def _choose_test(category: str) -> Test:
    """What counts as right, where one thing must be chosen for a table."""
    tests: dict[str, Test] = {"empty": is_clean, "odd": is_owned_up_to}
    tests["rigid"] = lambda record: is_found_in_contact(record) and not list_unphysical(record)
    tests["poor"] = lambda record: is_not_missed(record) and not has_wrong_name(record)
    return tests.get(category, is_exact)


def _list_kinds(
    category: str, played: Sequence[Record], right: Test, about: str = "right, by kind"
) -> list[str]:
    """The rate of each kind: effect, set, empty log, manoeuvre, odd physics, machine."""
    by_kind = _group(played, _KINDS.get(category, _join_truth))
    if len(by_kind) <= 1:
        return []
    lines = [about]
    for name, group in sorted(by_kind.items()):
        good = sum(right(record) for record in group)
        line = describe_rate(f"  {name}", good, len(group))
        if category in _MODELLED:
            found, near = (sum(test(record) for record in group) for test in (is_found, is_as_good))
            line += f"   named {found}, within {_WORSE:g}: {near}"
        mark = "   <- under 80 %" if good < _WEAKEST * len(group) else ""
        lines.append(line + mark)
    return lines


def _describe_miss(record: Record) -> str:
    score, hidden = record.score, dict(record.answer.effects)
    told = [f"hidden {hidden or record.answer.odd or 'nothing'}", f"named {list(score.named)}"]
    if score.groups:
        told.append(f"undecided {list(score.groups)}")
    if score.unobservable:
        told.append(f"unobservable {list(score.unobservable)}")
    if score.flagged:
        told.append(f"flagged {score.flagged}")
    if record.checked is not None and record.checked.true and record.checked.named:
        ratio = record.checked.named.ratio(record.checked.true)
        if math.isfinite(ratio):
            told.append(f"error {ratio:.3g} x the true model's")
    return f"  {record.job.replay}   {record.answer.program}: {', '.join(told)}"


def _join_truth(record: Record) -> str:
    return " + ".join(record.score.truth)


def _group(records: Iterable[Record], key: Callable[[Record], str]) -> dict[str, list[Record]]:
    groups: defaultdict[str, list[Record]] = defaultdict(list)
    for record in records:
        groups[key(record)].append(record)
    return dict(groups)
