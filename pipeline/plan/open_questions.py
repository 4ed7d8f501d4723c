"""Open questions of a plan: what keeps a drive from answering them, found by driving without it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import FEWEST_OF_SPREAD
from pipeline.core.arrays import Floats
from pipeline.models import Excitation, find_effect
from pipeline.models.catalogue import suggest_manoeuvre
from pipeline.plan import LEAD_S, LONGEST_S, TAIL_S, Area, Chooser
from pipeline.plan.questions import DECIDED_T, Answerable, Question, Separation

_RESERVES = (1.4, 2.0, 2.8, 4.0)
"""Factors on the goals of a suggested drive: gains of manoeuvres do not add up exactly. They are raised until
the drive is longer than the given time, in which the question stays open."""
_MOST_TIMES = 10
"""Longest suggested drive, in multiples of the given time: beyond it, another drive is better."""
_EVERYWHERE = Area(math.inf, math.inf)


@dataclass(frozen=True)
class Impossible:
    """A question that the plan leaves open.

    Attributes:
        question: as text.
        effects: ids of the effects concerned.
        because: the reason.
        reached: block t or interval that the plan reaches; where no drive decides it, that of the best one.
    """

    question: str
    effects: tuple[str, ...]
    because: str
    reached: str = ""


def list_reasons(questions: Sequence[Impossible]) -> list[str]:
    """Open questions, one text per reason."""
    asked: dict[frozenset[str], tuple[str, list[str]]] = {}
    for one in questions:
        _, same = asked.setdefault(frozenset(one.because.split("; ")), (one.because, []))
        same.append(f"{one.question} ({one.reached})" if one.reached else one.question)
    return [f"{'; '.join(same)}: {reason}" for reason, same in asked.values()]


def leave_open(one: Answerable, weight: Floats) -> Impossible:
    """An open question with what a drive reaches; `explain_open` gives the reason.

    Args:
        one: the question.
        weight: how often each of its groups is driven, shape (k,); all zero: nothing is driven.
    """
    reached = _format_reached(one, weight) if weight.any() else ""
    return Impossible(one.question.text, one.question.effects, "", reached)


def explain_open(question: Impossible, chooser: Chooser, order: Sequence[int]) -> Impossible:
    """An open question with the reason.

    The drive is continued for this question alone: for a longer time, in an unlimited area, and both. The
    first that answers it shows what is in its way; if none does, the limits of the commands are.

    Args:
        question: the question, as `leave_open` gives it.
        chooser: the manoeuvres within the limits, and their information on all questions.
        order: manoeuvres of the plan.
    """
    one = next(known for known in chooser.questions if known.question.text == question.question)
    library = np.ones(chooser.durations.size)
    best, longest_s = library, min(_MOST_TIMES * chooser.time_s, LONGEST_S - LEAD_S - TAIL_S)
    for advice, drive in _continue(one, chooser, order, longest_s):
        weight = np.bincount(np.array(drive, np.int64), minlength=library.size).astype(np.float64)
        if float(one.answer(weight, _RESERVES[0])) >= 1.0:
            seconds = math.ceil(LEAD_S + float(chooser.durations[list(drive)].sum()) + TAIL_S)
            return _because(question, advice.format(seconds=seconds), question.reached)
        best = weight if _is_better(one, weight, best) else best
    if float(one.answer(library)) >= 1.0 and float(chooser.durations.sum()) <= LONGEST_S - LEAD_S - TAIL_S:
        seconds = math.ceil(LEAD_S + float(chooser.durations.sum()) + TAIL_S)
        return _because(question, f"give a larger --area, and up to --time {seconds}s", question.reached)
    return _because(question, _advise(one.question, longest_s), f"at best {_format_reached(one, best)}")


def _because(question: Impossible, because: str, reached: str) -> Impossible:
    return Impossible(question.question, question.effects, because, reached)


def _continue(
    one: Answerable, chooser: Chooser, order: Sequence[int], longest_s: float
) -> Iterator[tuple[str, list[int]]]:
    """The plan continued for one question without one of its limits after the other, and what that takes."""
    for area, time_s, advice in (
        (chooser.area, longest_s, "give --time {seconds}s"),
        (_EVERYWHERE, chooser.time_s, "give a larger --area"),
        (_EVERYWHERE, longest_s, "give a larger --area, and --time {seconds}s"),
    ):
        alone = Chooser([one], chooser.durations, chooser.shapes, area, time_s)
        for reserve in _RESERVES:
            drive = alone.extend(order, reserve)
            spent = float(chooser.durations[drive].sum())
            if time_s == chooser.time_s or spent > chooser.time_s:
                yield advice, drive
                break


def _is_better(one: Answerable, weight: Floats, than: Floats) -> bool:
    """Whether a drive reaches more than another: a larger t, or a narrower interval."""
    if not weight.any():
        return False
    these = float(one.measure(weight)), float(one.measure(than))
    return these[0] > these[1] if isinstance(one.question, Separation) else these[0] < these[1]


def _format_reached(one: Answerable, weight: Floats) -> str:
    measured = float(one.measure(weight))
    if isinstance(one.question, Separation):
        enough, what = measured >= DECIDED_T, f"t = {measured:.1f} of {DECIDED_T:g}"
    else:
        bound = float(one.bound(weight))
        enough = bound <= one.question.goal
        what = f"+- {measured:.2g}, or up to {bound:.2g}"
    return f"{what}, in fewer than {FEWEST_OF_SPREAD:g} stretches" if enough else what


def _advise(question: Question, longest_s: float) -> str:
    """Why no drive answers a question, and what shows it."""
    effects = [find_effect(name)() for name in question.effects]
    on_slope = any(Excitation.SLOPE in effect.needs for effect in effects)
    tried = f"none of the drives that were tried, of up to {LEAD_S + longest_s + TAIL_S:.0f} s, decides it"
    why = "no drive on level ground decides it" if on_slope else tried
    return f"{why}; what shows it: {suggest_manoeuvre(*effects)}"
