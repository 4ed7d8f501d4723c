"""A plan: the shortest list of standard manoeuvres that decides most of what the runs so far leave open.

The information of a drive is that of its manoeuvres, added to that of the runs. With that on an effect which
remains beside all else that is not known, s, its t is sqrt(s) / 2 (half, as the diagnosis tests blocks), and
a number's 95 % interval follows from 1 / sqrt(s).
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.special import chdtri, stdtrit

from pipeline.core import (
    FEWEST_OF_SPREAD,
    NORMAL_95,
    Complex,
    Floats,
    Ints,
    finite_or_none,
    format_digits,
    format_duration,
    format_share,
    name_first,
    pick,
    suffix_unit,
)
from pipeline.estimation import ModelState
from pipeline.estimation.driving_need import find_goal
from pipeline.models import Effect, Timing, find_effect, list_effects, name_number, name_term
from pipeline.plan.manoeuvres import (
    LONGEST_S,
    Area,
    Commands,
    Limits,
    PlanError,
    is_steered,
    join,
    list_manoeuvres,
    wait,
)
from pipeline.plan.rehearsal import Rehearsal, Studied
from pipeline.words import Column, Table, suggest_drive

# Sizes of effects that may act unnoticed, as multiples of the usual ones, for the area of a drive.
_SIZES = (0.7, 1.0, 1.5, 2.0)
DECIDED_T = 5.0
"""Expected t of what a drive decides: the diagnosis decides at 1.6, and t scatters by one between drives."""
LEAD_S = 3.0
"""Zero commands before the first motion [s]."""
_TAIL_S = 1.0
# Length of the blocks from whose differences the diagnosis finds intervals [s].
_BLOCK_S = 7.0
# Largest expected half-width, relative to that so far, that counts as narrower.
_NARROWER = 0.9
# How often a list of manoeuvres is repeated at most: more is another drive.
_MOST_ROUNDS = 8
# Shares of the largest speed that are tried until the drive stays inside the area.
_SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)

_TIMES_S = (60.0, 120.0, 180.0, 300.0, 600.0, 900.0, 1200.0, 1800.0, 2700.0, LONGEST_S)
"""Times of a drive that are named where another one is too short [s]."""

SAFETY = (
    "This drives a real robot in open loop: no obstacle and no error stops it.",
    "Play it with the wheels lifted first. Then clear the area, and keep an emergency stop at hand.",
    f"It begins with {LEAD_S:g} s of zero commands and obeys the limits that it states.",
)
Row = tuple[str, str, str]
"""A question, what the runs so far say of it, and what the drive adds."""


def tabulate_questions(rows: Sequence[Row], about: str = "open", note: str = "") -> Table:
    """Open questions as a table, as `Plan.list_rows` has them.

    Args:
        rows: the questions.
        about: heading of the first column.
        note: remark below the table.
    """
    columns = (Column(about), Column("so far"), Column("with this drive"))
    return Table("Open questions", columns, rows, note)


@dataclass(frozen=True)
class Question:
    """What the runs leave open, and what a drive is expected to tell of it.

    Attributes:
        question: as text.
        effects: ids of the effects concerned.
        kind: `separation`, which of several effects acts; `presence`, whether one acts; or `interval`.
        goal: the t, or the half-width of a 95 % interval, that decides it.
        now: half-width so far; 0 for a t.
        unit, value: of the number of an interval.
        rows: for each thing that is to be known, its row in the information, last, and of what is not known.
        expected: t of the drive, or half-width of the runs and the drive together.
        at_most: half-width that 19 of 20 drives reach, as the spread of few blocks scatters; 0 for a t.
        decided_after_s: time in the drive from which it is decided; infinite if it is not.
        needs: what would decide it where this drive adds nothing.
        longer_s: time for all manoeuvres alike in which it is decided, of round times; infinite for none.
    """

    question: str
    effects: tuple[str, ...]
    kind: Literal["separation", "presence", "interval"]
    goal: float
    now: float = 0.0
    unit: str = "1"
    value: float = math.nan
    rows: tuple[tuple[int, ...], ...] = field(default=(), repr=False)
    expected: float = math.nan
    at_most: float = 0.0
    decided_after_s: float = math.inf
    needs: str = ""
    longer_s: float = math.inf

    @property
    def informs(self) -> bool:
        """Whether the drive decides it, or narrows its interval."""
        narrows = self.kind == "interval" and self.expected < _NARROWER * self.now
        return narrows or math.isfinite(self.decided_after_s)

    @property
    def name(self) -> str:
        """The question in words."""
        if self.kind == "interval":
            return name_number(self.effects[0], self.question.partition(" ")[0].rpartition(".")[2])
        return " or ".join(name_term(name) for name in self.effects)


@dataclass(frozen=True)
class Plan:
    """Commands and what they are expected to tell.

    Attributes:
        vehicle: id of the vehicle.
        runs: names of the runs that the plan is based on.
        manoeuvres: names and start times [s].
        commands: all of them, zero commands first.
        limits, area: limits that it satisfies.
        questions: all that is open; what is decided first stands first.
        topic, type_name: topic on which the commands are played, and its type.
        steered: whether a turn is a steering angle.
        ways: paths of the known model, first, and of those with one effect more, positions x + iy [m] at
            20 Hz, shape (models, n).
        roomier: how many questions the best drive at the largest speed decides, and the length and width of
            the area that it takes [m], where that is larger; else None.
    """

    vehicle: str
    runs: tuple[str, ...]
    manoeuvres: tuple[tuple[str, float], ...]
    commands: Commands = field(repr=False)
    limits: Limits
    area: Area
    questions: tuple[Question, ...]
    topic: str
    type_name: str
    steered: bool
    ways: Complex = field(repr=False)
    roomier: tuple[int, float, float] | None = None

    @property
    def informative(self) -> tuple[Question, ...]:
        """Questions of which the drive tells something."""
        return tuple(one for one in self.questions if one.informs)

    @property
    def decided(self) -> tuple[Question, ...]:
        """Questions that the drive decides."""
        return tuple(one for one in self.questions if math.isfinite(one.decided_after_s))

    @property
    def home_m(self) -> float:
        """Largest distance of any model's end from the start."""
        return float(np.abs(self.ways[:, -1]).max())

    def summarize(self) -> str:
        """What the drive decides of all that is open."""
        decided = self.decided
        parts = [f"decides {len(decided)} of {len(self.questions)} open questions"]
        if decided:
            parts[0] += f" in {format_duration(self.commands.duration_s)}: " + name_first(
                dict.fromkeys(one.name for one in decided)
            )
        if narrowed := len(self.informative) - len(decided):
            parts.append(f"narrows {narrowed}")
        late = [one.longer_s for one in self.questions if not one.informs and one.longer_s < math.inf]
        if late:
            parts.append(f"--time {_format_minutes(max(late))} would decide {len(late)} more")
        if self.roomier is not None and self.roomier[0] > len(decided):
            count, length, width = self.roomier
            parts.append(f"--area {length:.0f}x{width:.0f}m would decide {count}")
        return "; ".join(parts)

    def list_rows(self) -> list[Row]:
        """The open questions: those that the drive decides, in their order, then the others."""
        rows = []
        for one in self.informative:
            is_decided = math.isfinite(one.decided_after_s)
            after = f"after {format_duration(one.decided_after_s)}" if is_decided else ""
            if one.kind == "separation":
                rows.append((one.name, "undecided", f"decided {after}"))
            elif one.kind == "interval":
                unit = suffix_unit(one.unit)
                text = f"±{format_digits(one.expected)}{unit}"
                text += f"; ±{format_digits(one.goal)} {after}" if after else ""
                rows.append((one.name, f"{one.value:.3g} ±{format_digits(one.now)}{unit}", text))
        seen = [one for one in self.informative if one.kind == "presence"]
        if seen:
            after = f"would show after {format_duration(seen[-1].decided_after_s)}"
            rows.append((name_first([one.name for one in seen]), "not seen", after))
        rest = [one for one in self.questions if not one.informs]
        for needs in dict.fromkeys(one.needs for one in rest):
            names = name_first(dict.fromkeys(one.name for one in rest if one.needs == needs))
            rows.append((names, "not by this drive", needs))
        return rows

    def to_json(self) -> dict[str, object]:
        """The documented keys of `slip plan --json`, and others."""
        return {
            "duration_s": self.commands.duration_s if self.manoeuvres else 0.0,
            **pick(self, "vehicle", "home_m", "topic"),
            "type": self.type_name,
            "runs": list(self.runs),
            "limits": asdict(self.limits) | {"yaw_rate_radps": finite_or_none(self.limits.yaw_rate_radps)},
            "area": asdict(self.area),
            "safety": list(SAFETY),
            "manoeuvres": [{"name": name, "start_s": start} for name, start in self.manoeuvres],
            "promises": [
                {
                    **pick(one, "question", "kind", "goal", "now", "unit"),
                    "effects": list(one.effects),
                    "decided_after_s": finite_or_none(one.decided_after_s),
                    ("interval_after_s" if one.kind == "interval" else "expected_t"): one.expected,
                }
                for one in self.informative
            ],
            "impossible": [
                {"question": one.question, "effects": list(one.effects), "because": one.needs}
                for one in self.questions
                if not one.informs
            ],
        }


class Assessment:
    """What a drive of manoeuvres is expected to tell of questions.

    Args:
        prior: information before the drive, shape (q, q).
        blocks: information of each block of the manoeuvres, one after the other, shape (k, q, q).
        owner: number of the manoeuvre of each block, shape (k,).
        before_s: length of the runs so far [s].
    """

    def __init__(self, prior: Floats, blocks: Floats, owner: Ints, before_s: float) -> None:
        self.prior, self._blocks, self._owner = prior, blocks, owner
        self._before = before_s / _BLOCK_S

    def expect(self, one: Question, counts: Floats) -> tuple[Question, float]:
        """A question with what is expected, and the share of its goal that is reached, 1 if it is decided.

        Args:
            one: the question.
            counts: how often each manoeuvre is driven, shape (manoeuvres,).
        """
        weight = counts[self._owner]
        strength = find_strength(self.prior + np.tensordot(weight, self._blocks, 1), one.rows)
        known, number = find_strength(self.prior, one.rows), one.rows[0][-1]
        carrying = self._count_blocks(number, weight)
        if one.kind != "interval":
            t = 0.5 * math.sqrt(max(strength - known, 0.0))
            share = min((t / one.goal) ** 2, 1.0) * min(carrying / FEWEST_OF_SPREAD, 1.0)
            return replace(one, expected=t), share
        freedom = max(carrying - 1.0, 1.0)
        half = stdtrit(freedom, 0.975) / math.sqrt(strength)
        if self._before:
            # What the diagnosis states may be wider than noise alone explains.
            before = max(self._count_blocks(number, 0.0 * weight) - 1.0, 1.0)
            half *= max(one.now * math.sqrt(known) / stdtrit(before, 0.975), 1.0)
        most = half * math.sqrt(chdtri(freedom, 0.05) / freedom)
        return replace(one, expected=float(half), at_most=float(most)), min((one.goal / most) ** 2, 1.0)

    def _count_blocks(self, number: int, weight: Floats) -> float:
        """Blocks of the runs and of the drive that carry the information on a number."""
        shown, known = self._blocks[:, number, number], self.prior[number, number] if self._before else 0.0
        squares = weight @ shown**2 + known**2 / (self._before or 1.0)
        return float((weight @ shown + known) ** 2 / squares) if squares > 0.0 else 1.0


def find_strength(information: Floats, rows: Sequence[Sequence[int]]) -> float:
    """Least information on the last of each of these rows that remains beside the others."""
    return min(1.0 / float(np.linalg.inv(information[np.ix_(one, one)])[-1, -1]) for one in rows)


def make_plan(
    studied: Studied,
    limits: Limits,
    area: Area,
    time_s: float,
    played: tuple[str, str],
    notify: Callable[[str], object] = str,
) -> Plan:
    """Choose the shortest list of manoeuvres that decides most of what is open, repeated where that helps.

    Args:
        studied: what is known of the vehicle.
        limits: that no command exceeds.
        area: that no model leaves.
        time_s: longest duration, including the zero commands at the start.
        played: topic and message type of the commands.
        notify: called with what is being done.

    Raises:
        PlanError: ``no_room``, no manoeuvre fits into the area.
    """
    best: Plan | None = None
    roomier: tuple[int, float, float] | None = None
    for scale in _SCALES:
        notify(f"manoeuvres at {format_share(scale)} of the largest speed")
        library = list_manoeuvres(studied.vehicle, limits, scale)
        names, seconds = [*library], np.array([one.duration_s for one in library.values()])
        ends = np.cumsum(seconds)
        rehearsal = Rehearsal(join([*library.values()]), studied, ends - seconds)
        cuts = [
            np.append(np.arange(end - length + _BLOCK_S, end - 0.5 * _BLOCK_S, _BLOCK_S), end)
            for length, end in zip(seconds, ends, strict=True)
        ]
        owner = np.repeat(np.arange(seconds.size), [cut.size for cut in cuts])
        others = list_others(studied, rehearsal, time_s)
        known = rehearsal.recall(len(others))
        blocks = rehearsal.inform([*others.values()], np.concatenate(cuts))
        assessment = Assessment(known, blocks, owner, studied.driven_s)
        questions = ask(studied, rehearsal, [*others], known)
        base = ModelState(studied.effects, (Timing(),))
        with_one = [base.add(one).weaken([one.id], size) for one in others.values() for size in _SIZES]
        models = [one.effects for one in (base, *with_one)]
        whole = chosen = _choose(assessment, questions, seconds, time_s - LEAD_S - _TAIL_S)
        while True:
            answers = _foretell(assessment, questions, seconds, chosen)
            if not any(one.informs for one in answers):
                # What tells nothing is not driven, wherever it fits.
                whole, chosen = () if chosen == whole else whole, ()
            commands = join([wait(LEAD_S), *(library[names[one]] for one in chosen), wait(_TAIL_S)])
            starts = LEAD_S + np.cumsum([0.0, *seconds[[*chosen]]])
            driven = Rehearsal(commands, studied, starts)
            ways = np.array([driven.trace(effects)[0] for effects in models])
            if roomier is None:
                sides = [
                    2.0 * float(np.ceil(area.margin_m + np.abs(one).max())) for one in (ways.real, ways.imag)
                ]
                roomier = (sum(one.decided_after_s < math.inf for one in answers), sides[0], sides[1])
            if not chosen or area.holds(ways):
                break
            chosen = chosen[:-1]
        made = Plan(
            studied.vehicle.id,
            tuple(run.name for run in studied.runs),
            tuple(zip((names[one] for one in chosen), starts[:-1].round(3).tolist(), strict=True)),
            commands,
            limits,
            area,
            tuple(answers),
            *played,
            is_steered(studied.vehicle),
            ways,
            None if area.length_m >= roomier[1] and area.width_m >= roomier[2] else roomier,
        )
        if best is None or len(made.decided) > len(best.decided):
            best = made
        if chosen == whole:
            return best
    if best is None or not best.manoeuvres:
        what, where = "no drive fits into the area", f"{area.length_m:g} x {area.width_m:g} m"
        raise PlanError("no_room", what, where=where, hint="Give a larger --area, or a lower --max-speed.")
    return best


def list_others(studied: Studied, rehearsal: Rehearsal, time_s: float) -> dict[str, Effect]:
    """Effects that may act beside the known ones: undecided ones as fitted, others at their usual sizes.

    Args:
        studied: what is known; without runs, every effect of the vehicle's kind may act.
        rehearsal: commands, to whose largest the usual sizes of limits are relative.
        time_s: length of a plan, in which a usual change happens.
    """
    largest = replace(rehearsal.data.largest, turns=None)
    largest = replace(largest, moments=np.linspace(0.0, time_s, largest.moments.size))
    known = {effect.id for effect in studied.effects}
    others: dict[str, Effect] = {}
    for group in () if studied.diagnosis is None else studied.diagnosis.undecided:
        for name in group.candidates:
            fitted = {key: one.value for key, one in group.parameters.get(name, {}).items()}
            others.setdefault(name, find_effect(name)().make_usual(largest).change_within(**fitted))
    kinds = [effect for effect in list_effects() if studied.vehicle.kind in effect.kinds]
    hidden = {one.id for one in kinds} if studied.diagnosis is None else studied.diagnosis.unobservable_why
    for effect in kinds:
        if effect.id in hidden and effect.id not in known and effect.acts_in(known):
            others.setdefault(effect.id, effect().make_usual(largest))
    return others


def ask(studied: Studied, rehearsal: Rehearsal, others: Sequence[str], known: Floats) -> list[Question]:
    """What the runs leave open: undecided effects, wide intervals, and effects that they could not show.

    Args:
        studied: what is known.
        rehearsal: commands; its numbers, and then the other effects, are the rows of the information.
        others: ids of the other effects.
        known: information before the drive.
    """
    numbers = rehearsal.numbers
    base, row_of = tuple(range(len(numbers))), {name: len(numbers) + at for at, name in enumerate(others)}
    diagnosis = studied.diagnosis
    groups = () if diagnosis is None else tuple(group.candidates for group in diagnosis.undecided)
    questions = [
        Question(
            " or ".join(group), group, "separation", DECIDED_T,
            rows=tuple((*base, row_of[b], row_of[a]) for a, b in itertools.permutations(group, 2)),
        )
        for group in groups
    ]  # fmt: skip
    stated = {
        f"{effect.id}.{name}": value.half
        for effect in (() if diagnosis is None else diagnosis.effects)
        for name, value in effect.parameters.items()
        if math.isfinite(value.half)
    }
    values = {effect.id: effect.values for effect in studied.effects}
    for row, number in enumerate(numbers):
        rows = ((*base[:row], *base[row + 1 :], row),)
        value = values[number.effect][number.name]
        goal = find_goal(number.effect, number.name, value)
        now = stated.get(number.label, NORMAL_95 / math.sqrt(find_strength(known, rows)))
        if now > goal:
            text = f"{number.label} within {goal:.2g}{suffix_unit(number.unit)}"
            questions.append(
                Question(text, (number.effect,), "interval", goal, now, number.unit, value, rows)
            )
    for name, row in row_of.items():
        if not any(name in group for group in groups):
            # It is seen where none of those that resemble it can take its place.
            rivals = (row_of[one] for one in find_effect(name).confused_with if one in row_of and one != name)
            rows = ((*base, *rivals, row),)
            questions.append(Question(f"whether {name} acts", (name,), "presence", DECIDED_T, rows=rows))
    return questions


def _choose(
    assessment: Assessment, questions: Sequence[Question], seconds: Floats, time_s: float
) -> tuple[int, ...]:
    """Manoeuvres of the shortest drive that decides most, by number; none where the time is too short."""
    best, chosen = (0, 0.0, 0.0), tuple[int, ...]()
    sizes = range(1, seconds.size + 1)
    for one in itertools.chain.from_iterable(itertools.combinations(range(seconds.size), n) for n in sizes):
        length = float(seconds[[*one]].sum())
        for rounds in range(1, min(int(time_s / length), _MOST_ROUNDS) + 1):
            counts = np.bincount(one * rounds, minlength=seconds.size).astype(np.float64)
            shares = [assessment.expect(question, counts)[1] for question in questions]
            decided = sum(share >= 1.0 for share in shares)
            rank = (decided, round(sum(shares), 1), -length * rounds)
            if rank > best:
                best, chosen = rank, one * rounds
            if decided == len(questions):
                break
    return chosen


def _format_minutes(seconds: float) -> str:
    return f"{seconds / 60.0:g}min"


def _foretell(
    assessment: Assessment, questions: Sequence[Question], seconds: Floats, chosen: Sequence[int]
) -> list[Question]:
    """The questions with what these manoeuvres, one after the other, are expected to tell of each."""
    answers = []
    every = np.full(seconds.size, LONGEST_S / float(seconds.sum()))
    for one in questions:
        after = math.inf
        for count in range(1, len(chosen) + 1):
            counts = np.bincount(chosen[:count], minlength=seconds.size).astype(np.float64)
            if assessment.expect(one, counts)[1] >= 1.0:
                after = round(LEAD_S + float(seconds[[*chosen[:count]]].sum()), 3)
                break
        counts = np.bincount(np.array(chosen, np.int64), minlength=seconds.size).astype(np.float64)
        enough = (time for time in _TIMES_S if assessment.expect(one, every * (time / LONGEST_S))[1] >= 1.0)
        longer = next(enough, math.inf)
        is_late = longer < math.inf
        needs = f"give --time {_format_minutes(longer)}" if is_late else suggest_drive(*one.effects)
        expected = assessment.expect(one, counts)[0]
        answers.append(replace(expected, decided_after_s=after, needs=needs, longer_s=longer))
    return sorted(answers, key=lambda one: one.decided_after_s)
