"""Choice of the sequence of manoeuvres that answers the open questions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core import Complex, Floats
from pipeline.plan.manoeuvres import Area
from pipeline.plan.questions import Answerable

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
        self.reserve = reserve
        self._answers.clear()
        chosen: list[int] = []
        while (best := self._find_next(chosen)) is not None:
            chosen.append(best)
        for _ in range(_ROUNDS):
            if not self._exchange(chosen):
                break
        return chosen

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
