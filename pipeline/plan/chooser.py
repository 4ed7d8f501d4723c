"""Choice of the sequence of manoeuvres that answers the open questions."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core import Complex, Floats
from pipeline.models import Excitation, find_effect, suggest_manoeuvre
from pipeline.plan.manoeuvres import LEAD_S, LONGEST_S, TAIL_S, Area
from pipeline.plan.questions import Answerable, Impossible, Question

_ROUNDS = 2


_NOTHING = 1e-4


# Every model must end within this fraction of the area's shorter side from its start.
_HOME_SHARE = 0.25


@dataclass(frozen=True)
class Shape:
    """Path of a manoeuvre from the origin, by model.

    Attributes:
        path: positions x + iy [m], shape (models, n).
        heading: at the end [rad], shape (models,).
    """

    path: Complex
    heading: Floats


class Chooser:
    """Chooses sequences of manoeuvres.

    Args:
        questions: with one group of windows per manoeuvre.
        durations: of the manoeuvres [s], shape (k,).
        shapes: paths of the manoeuvres, all of the same models.
        area: area that no path may leave.
        time_s: longest sequence.
    """

    def __init__(
        self,
        questions: Sequence[Answerable],
        durations: Floats,
        shapes: Sequence[Shape],
        area: Area,
        time_s: float,
    ) -> None:
        self.questions = questions
        self.durations = durations
        self.shapes = shapes
        self.area = area
        self.time_s = time_s
        self.reserve = 1.0
        self._answers: dict[tuple[int, ...], float] = {}

    def choose(self, reserve: float = 1.0) -> list[int]:
        """Manoeuvres in the order of their gain; empty if none adds information.

        Args:
            reserve: factor on the goals: gains of manoeuvres do not add up exactly, and stretches of driving
                do not begin with manoeuvres.
        """
        chosen = self.extend([], reserve)
        for _ in range(_ROUNDS):
            if not self._exchange(chosen):
                break
        return chosen

    def extend(self, chosen: Sequence[int], reserve: float) -> list[int]:
        """Append manoeuvres while they contribute to an answer and time remains.

        Args:
            chosen: fixed beginning of the sequence.
            reserve: as of `choose`.
        """
        self.reserve = reserve
        self._answers.clear()
        longer = list(chosen)
        while (best := self._find_next(longer)) is not None:
            longer.append(best)
        return longer

    def add_up(self, trials: Sequence[Sequence[int]]) -> list[float]:
        """For each trial, the sum over all questions of the fraction of the goal that it reaches."""
        keys = [tuple(sorted(chosen)) for chosen in trials]
        new = [key for key in dict.fromkeys(keys) if key not in self._answers]
        if new:
            weight = np.array(
                [np.bincount(np.array(key, np.int64), minlength=self.durations.size) for key in new]
            )
            shares = sum(
                question.answer(weight.astype(np.float64), self.reserve) for question in self.questions
            )
            self._answers |= zip(new, np.broadcast_to(shares, len(new)).tolist(), strict=True)
        return [self._answers[key] for key in keys]

    def _find_next(self, chosen: list[int]) -> int | None:
        (now,) = self.add_up([chosen])
        remaining = self.time_s - float(self.durations[chosen].sum())
        extended = self.add_up([[*chosen, one] for one in range(self.durations.size)])
        rates = (np.array(extended) - now) / self.durations
        for one in np.argsort(rates)[::-1].tolist():
            if rates[one] < _NOTHING:
                return None
            if self.durations[one] <= remaining and self.fits([*chosen, one]):
                return int(one)
        return None

    def _exchange(self, chosen: list[int]) -> bool:
        """Replace or drop single manoeuvres if that answers more, or as much in less time."""
        changed = False
        for index in reversed(range(len(chosen))):
            rest = chosen[:index] + chosen[index + 1 :]
            spent = float(self.durations[rest].sum())
            short = np.flatnonzero(spent + self.durations <= self.time_s).tolist()
            trials = [chosen, rest, *([*chosen[:index], one, *chosen[index + 1 :]] for one in short)]
            (best, *ranks), trial = self._rank(trials), chosen
            for rank, other in zip(ranks, trials[1:], strict=True):
                if rank > best and self.fits(other):
                    best, trial = rank, other
            if trial is not chosen:
                chosen[:] = trial
                changed = True
        return changed

    def _rank(self, trials: Sequence[Sequence[int]]) -> list[tuple[float, float]]:
        return [
            (round(answered, 3), -float(self.durations[list(chosen)].sum()))
            for chosen, answered in zip(trials, self.add_up(trials), strict=True)
        ]

    def fits(self, chosen: Sequence[int]) -> bool:
        """Whether all models stay inside the area and end near their start."""
        at = np.zeros(self.shapes[0].heading.size, dtype=np.complex128)
        heading = np.zeros(at.size)
        for one in chosen:
            shape = self.shapes[one]
            path = at[:, None] + np.exp(1j * heading)[:, None] * shape.path
            if not self.area.holds(path):
                return False
            at, heading = path[:, -1], heading + shape.heading
        home = _HOME_SHARE * min(self.area.length_m, self.area.width_m)
        return bool((np.abs(at) <= home).all())


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
            return replace(question, because=advice.format(seconds=seconds))
        best = weight if _is_better(one, weight, best) else best
    if float(one.answer(library)) >= 1.0 and float(chooser.durations.sum()) <= LONGEST_S - LEAD_S - TAIL_S:
        seconds = math.ceil(LEAD_S + float(chooser.durations.sum()) + TAIL_S)
        return replace(question, because=f"give a larger --area, and up to --time {seconds}s")
    because, needs_slope = _advise(one.question, longest_s)
    # What a drive on level ground reaches of a slope says nothing.
    at_best = "" if needs_slope else f"expected {one.format_reached(best)}"
    return replace(question, because=because, reached=at_best, needs_limits=not needs_slope)


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
    """Whether a drive reaches more than another."""
    return bool(weight.any()) and one.rate(weight) > one.rate(than)


_RESERVES = (1.4, 2.0, 2.8, 4.0)
"""Factors on the goals of a suggested drive: gains of manoeuvres do not add up exactly. They are raised until
the drive is longer than the given time, in which the question stays open."""


_MOST_TIMES = 10
"""Longest suggested drive, in multiples of the given time: beyond it, another drive is better."""


_EVERYWHERE = Area(math.inf, math.inf)


def _advise(question: Question, longest_s: float) -> tuple[str, bool]:
    """Why no drive answers a question and what shows it, and whether that is a slope."""
    effects = [find_effect(name)() for name in question.effects]
    on_slope = any(Excitation.SLOPE in effect.needs for effect in effects)
    tried = f"no drive of up to {LEAD_S + longest_s + TAIL_S:.0f} s that was tried decides it"
    why = "no drive on level ground decides it" if on_slope else tried
    return f"{why}; to observe it: {suggest_manoeuvre(*effects)}", on_slope
