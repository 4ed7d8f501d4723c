"""Played riddles as text: rates with Wilson intervals, what was said of what, times, misses by seed."""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence

from game.draw import CATEGORIES
from game.play import Record

_WORSE = 1.05
_FORMULA = 0.02
_WEAKEST = 0.8

Test = Callable[[Record], bool]

_KINDS: dict[str, Callable[[Record], str]] = {
    "empty": lambda record: record.answer.note,
    "rigid": lambda record: record.answer.note,
    "odd": lambda record: record.answer.odd,
    "poor": lambda record: record.answer.program,
    "equipped": lambda record: record.answer.note,
    "hills": lambda record: record.answer.note,
}


def write_tables(records: Iterable[Record]) -> str:
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
    counted = played if category in _RATES else [record for record in played if not record.is_weak]
    lines = [f"== {category}: {len(played)} logs"]
    if len(counted) < len(played):
        weak = len(played) - len(counted)
        lines.append(f"{weak} too weak to count: an effect lowers the true model's error by less than 5 %")
    for words, test in _RATES.get(category, _MODELLED).items():
        lines.append(describe_rate(words, sum(map(test, counted)), len(counted)))
    right = next(iter(_RATES.get(category, _MODELLED).values()))
    lines += _describe_intervals(counted)
    lines += _list_kinds(category, counted, right)
    lines += confusion_table(counted)
    lines += _describe_times(played)
    lines += [
        f"  {record.outcome}: {record.job.replay}   {' '.join(record.note.split())[:200]}"
        for record in played
        if record.note or record.outcome != "scored"
    ]
    lines += [
        _describe_miss(record) for record in counted if record.outcome == "scored" and not right(record)
    ]
    return lines


def is_clean(record: Record) -> bool:
    """Nothing named, nothing undecided, nothing flagged."""
    return record.score.outcomes == {"nothing": "right"}


def is_found(record: Record) -> bool:
    """All that was hidden is named."""
    return not record.score.list_hidden("undecided", "unobservable", "abstained", "wrong")


def is_exact(record: Record) -> bool:
    """All that was hidden is named, and nothing else."""
    return is_found(record) and not has_wrong_name(record) and record.outcome == "scored"


def is_narrowed(record: Record) -> bool:
    """All that was hidden is named or stands among the candidates of what is undecided, and nothing else."""
    missed = record.score.list_hidden("unobservable", "abstained", "wrong")
    return not missed and not has_wrong_name(record) and record.outcome == "scored"


def has_wrong_name(record: Record) -> bool:
    """Something is named that was not hidden."""
    return bool(record.score.wrong_names)


def is_not_missed(record: Record) -> bool:
    """What was hidden is named, undecided or unobservable, and nothing else is named."""
    return not record.score.list_hidden("abstained", "wrong") and not has_wrong_name(record)


def is_flagged(record: Record) -> bool:
    """Something is unexplained in a channel that the odd physics acts on."""
    return record.score.outcomes.get("unlisted") == "right"


def is_owned_up_to(record: Record) -> bool:
    """It is flagged in its channel, or what is named says the same."""
    return is_flagged(record) or bool(set(record.score.named) - set(record.score.wrong_names))


def is_mistaken(record: Record) -> bool:
    """Something is named that it is not like, without a flag that more is there."""
    return has_wrong_name(record) and not is_flagged(record)


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


_MODELLED: dict[str, Test] = {
    "exactly right": is_exact,
    "all that is hidden is named": is_found,
    "named, or undecided with it, and nothing else": is_narrowed,
    f"error within {_WORSE:g} of the true model's": is_as_good,
}
_RATES: dict[str, dict[str, Test]] = {
    "empty": {"nothing named and nothing flagged": is_clean},
    "odd": {
        "flagged in its channel, or named as what it is like": is_owned_up_to,
        "flagged in the right channel": is_flagged,
        "a wrong name, and nothing flagged": is_mistaken,
        "the pasted formula lowers the held-out error": has_useful_formula,
    },
    "poor": {
        "undecided, unobservable or rightly named": is_not_missed,
        "a confident wrong name": has_wrong_name,
    },
}
"""By category: rates of its logs, the first of which says what is right."""


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
    return f"{name:<52}{successes:>4} / {trials:<4} = {share:6.1%}   [{low:.1%}, {high:.1%}]"


def confusion_table(played: Sequence[Record]) -> list[str]:
    """Rows: what was hidden; columns: what was said of it."""
    said: dict[str, Counter[str]] = defaultdict(Counter)
    for record in played:
        for name, outcome in record.score.outcomes.items():
            said[name].update([outcome, *(f"+ {other}" for other in record.score.false)])
    lines = [f"{'hidden':<22}said of it"]
    for name in sorted(said):
        cells = ", ".join(f"{key} {count}" for key, count in said[name].most_common())
        lines.append(f"{name:<22}{cells}")
    return lines


def _describe_intervals(played: Sequence[Record]) -> list[str]:
    """How often a stated 95 % interval holds the truth, and of which numbers it does not."""
    intervals = [one for record in played for one in record.score.intervals]
    if not intervals:
        return []
    outside = Counter(one.label for one in intervals if not one.holds)
    held = describe_rate(
        "95 % intervals that hold the truth", sum(one.holds for one in intervals), len(intervals)
    )
    missed = ", ".join(f"{label} {count}" for label, count in outside.most_common())
    return [held, *([f"  outside: {missed}"] if missed else [])]


def _describe_times(played: Sequence[Record]) -> list[str]:
    """CPU time of each part."""
    parts = [
        f"{part} {statistics.median(spent):.2f} s"
        for part in ("draw", "ask", "stages", "diagnosis", "check")
        if (spent := [record.cpu_s[part] for record in played if part in record.cpu_s])
    ]
    return [f"CPU, medians: {', '.join(parts)}"] if parts else []


def _list_kinds(category: str, played: Sequence[Record], right: Test) -> list[str]:
    """The rate of each kind: effect, set, empty log, manoeuvre, odd physics, machine."""
    by_kind = _group(played, _KINDS.get(category, _join_truth))
    if len(by_kind) <= 1:
        return []
    lines = ["right, by kind"]
    for name, group in sorted(by_kind.items()):
        good = sum(map(right, group))
        mark = f"   <- under {_WEAKEST:.0%}" if good < _WEAKEST * len(group) else ""
        lines.append(describe_rate(f"  {name}", good, len(group)) + mark)
    return lines


def _describe_miss(record: Record) -> str:
    score, hidden = record.score, dict(record.answer.effects)
    told = [f"hidden {hidden or record.answer.odd or 'nothing'}", f"named {list(score.named)}"]
    if score.groups:
        told.append(f"undecided {list(score.groups)}")
    if score.flagged:
        told.append(f"flagged {score.flagged}")
    if record.checked is not None and record.checked.true and record.checked.named:
        ratio = record.checked.named.ratio(record.checked.true)
        if math.isfinite(ratio):
            told.append(f"error {ratio:.3g} x the true model's")
    return f"  {record.job.replay}   {record.answer.program}: {', '.join(told)}"


def _join_truth(record: Record) -> str:
    return " + ".join(sorted(record.answer.effects))


def _group(records: Iterable[Record], key: Callable[[Record], str]) -> dict[str, list[Record]]:
    groups: defaultdict[str, list[Record]] = defaultdict(list)
    for record in records:
        groups[key(record)].append(record)
    return dict(groups)
