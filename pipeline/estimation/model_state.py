"""A model being fitted: its numbers, their derivative columns, and what is known of them before."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pipeline.core import Floats
from pipeline.models import Effect, Search, Timing

_LEAST_INVERSE = 1e-3
"""Share of its inverse that a limit keeps at least in one step."""

# Derivative columns of many residuals, one after the other in memory: so they are made, picked and summed.
#
# All arrays are of shape (n, 3, p): n windows, three channels, p numbers.


def make_columns(windows: int, numbers: int) -> Floats:
    """Zeros, shape (n, 3, p)."""
    return np.zeros((numbers, windows, 3)).transpose(1, 2, 0)


def stack_columns(columns: Sequence[Floats]) -> Floats:
    """Columns of shape (n, 3) side by side, shape (n, 3, p)."""
    return np.array(columns).transpose(1, 2, 0)


def pick_columns(columns: Floats, places: Sequence[int]) -> Floats:
    """The columns at these places; the same array where it is all of them."""
    if list(places) == list(range(columns.shape[2])):
        return columns
    return columns.transpose(2, 0, 1)[list(places)].transpose(1, 2, 0)


def flatten(columns: Floats) -> Floats:
    """Columns as those of a matrix, shape (3 n, p)."""
    windows, channels, numbers = columns.shape
    return columns.transpose(2, 0, 1).reshape(numbers, windows * channels).T


def combine_columns(columns: Floats, step: Floats) -> Floats:
    """Sum of the columns, each times its part of a step of shape (p,), shape (n, 3)."""
    return (flatten(columns) @ step).reshape(columns.shape[:2])


DelayName = Literal["wheel_delay_s", "encoder_delay_s"]
FreeKey = tuple[str, str, tuple[int, ...]]
"""Effect, name and runs of a number."""
Own = Mapping[int, Mapping[tuple[str, str], float]]

DELAY_STEP = 5e-3
"""Step of derivatives by a delay [s]: a quarter of a cell."""
_LARGEST_DELAY = 0.6
"""Largest delay of encoders that is fitted [s]: the largest that `trust.estimate_delay` looks for."""


_NARROW, _WIDE = 0.01, 0.2
"""Least width of a derivative in steps of the number, and the largest beside a step, as a share of its
value."""


@dataclass(frozen=True)
class Free:
    """A number that is fitted.

    Attributes:
        effect: id of the effect; empty for a delay of a run.
        name: of the parameter or of the delay.
        runs: numbers of the runs that share it; empty where all do.
        bounds: smallest and largest value.
        step: for numerical derivatives.
        unit: SI, `1` for a plain number.
        search: how it is estimated.
    """

    effect: str
    name: str
    runs: tuple[int, ...]
    bounds: tuple[float, float]
    step: float
    unit: str = "s"
    search: Search = Search.DIRECT

    @property
    def label(self) -> str:
        """``effect.name``, or ``timing.name``."""
        return f"{self.effect or 'timing'}.{self.name}"

    @property
    def key(self) -> FreeKey:
        """Its effect, name and runs, the same at other bounds."""
        return self.effect, self.name, self.runs

    def acts_in(self, run: int) -> bool:
        """Whether it is one of the numbers of a run."""
        return not self.runs or run in self.runs

    @property
    def is_smooth(self) -> bool:
        """Whether derivatives find it; else a grid does."""
        return self.search is not Search.GRID

    def hold(self, value: float) -> float:
        """A value held to the bounds."""
        return min(max(value, self.bounds[0]), self.bounds[1])

    def list_ends(self, value: float, width: float = math.nan) -> tuple[float, ...]:
        """Values beside one between which its derivative is taken: on either side, or on one at a bound.

        The cost has a kink wherever a limit or friction begins to act. A derivative over what the data
        resolve sees through them; one over a small step sees but one side, and fits end anywhere.

        Args:
            value: where.
            width: standard error of the number if all others were known; NaN where it is not known yet.
        """
        (low, high), narrow = self.bounds, _NARROW * self.step
        if not self.is_smooth:
            width = narrow
        width = self.step if math.isnan(width) else min(max(width, narrow), _WIDE * abs(value) + self.step)
        below, above = value - width, value + width
        if low <= below and above <= high:
            return below, above
        # At a bound, the influence of a parameter may grow with its square.
        width = max(width, self.step)
        return (min(value + width, high),) if high - value >= value - low else (max(value - width, low),)


@dataclass(frozen=True)
class ModelState:
    """A model with its values, run by run.

    Attributes:
        effects: with the values that runs share, in the order of the command path.
        timing: delays of each run.
        own: values that belong to one run: by run number, then ``(effect, name)``.
    """

    effects: tuple[Effect, ...]
    timing: tuple[Timing, ...]
    own: Own = field(default_factory=dict)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(effect.id for effect in self.effects)

    def find(self, name: str) -> Effect | None:
        """The effect of that id, None without."""
        return next((effect for effect in self.effects if effect.id == name), None)

    @property
    def centred(self) -> ModelState:
        """The state with the mean over the runs as the shared value of what belongs to each run alone."""
        labels = {label for own in self.own.values() for label in own}
        means = {
            label: sum(self.own[run][label] for run in self.own) / len(self.own)
            for label in labels
            if all(label in own for own in self.own.values())
        }
        changed = (
            effect.change(**{name: value for (owner, name), value in means.items() if owner == effect.id})
            for effect in self.effects
        )
        return replace(self, effects=tuple(changed)) if means else self

    def has_own(self, name: str) -> bool:
        """Whether an effect has a number of each run's own."""
        return any(owner == name for own in self.own.values() for owner, _ in own)

    def list_as_it_acts(self, effect: Effect) -> list[Effect]:
        """One of the effects, once, or as it acts in each run where it has numbers of each run's own."""
        if not self.has_own(effect.id):
            return [effect]
        acting = (replace(self, effects=(effect,)).effects_of(run) for run in range(len(self.timing)))
        return [effects for (effects,) in acting]

    def effects_of(self, run: int) -> tuple[Effect, ...]:
        """The effects as they act in one run."""
        own = self.own.get(run)
        if not own:
            return self.effects
        return tuple(
            effect.change(**{name: value for (owner, name), value in own.items() if owner == effect.id})
            for effect in self.effects
        )

    def add(self, *effects: Effect) -> ModelState:
        """The state with effects added, or put in the place of those with their ids."""
        new = {effect.id for effect in effects}
        others = [effect for effect in self.effects if effect.id not in new]
        ordered = sorted([*others, *effects], key=lambda effect: (effect.place, effect.rank, effect.id))
        return replace(self, effects=tuple(ordered))

    def drop(self, names: Iterable[str]) -> ModelState:
        """The state without some effects."""
        gone = set(names)
        return self.hold([effect for effect in self.effects if effect.id not in gone])

    def hold(self, effects: Sequence[Effect]) -> ModelState:
        """These effects and no others, with the numbers of each run's own that the state has of them."""
        ids = {effect.id for effect in effects}
        own = {
            run: {label: value for label, value in numbers.items() if label[0] in ids}
            for run, numbers in self.own.items()
        }
        return replace(self, effects=(), own=own).add(*effects)

    def list_free(
        self,
        delays: Sequence[DelayName],
        per_run: Sequence[str] = (),
        grounds: Sequence[tuple[int, ...]] = ((),),
    ) -> tuple[Free, ...]:
        """Free numbers: parameters that are not fixed and say how much, then the delays of every run.

        Args:
            delays: which delays of a run are free.
            per_run: labels ``effect.name``, or ids of effects, whose values belong to each run alone.
            grounds: runs on each ground, which has its own values of `Effect.ground_labels`.
        """
        runs = [(run,) for run in range(len(self.timing))]
        free: list[Free] = []
        for effect in self.effects:
            for p in effect.parameters:
                is_given = math.isfinite(effect.values[p.name]) and effect.is_used(p)
                if p.name in effect.fixed or not is_given:
                    continue
                label = f"{effect.id}.{p.name}"
                alone = label in per_run or effect.id in per_run
                sharing = runs if alone else grounds if label in effect.ground_labels else [()]
                free += [Free(effect.id, p.name, one, p.bounds, p.step, p.unit, p.search) for one in sharing]
        # Encoders report nothing that has yet to happen: a body that moves after its wheels is itself late.
        bounds = (0.0, _LARGEST_DELAY)
        free += [Free("", name, one, bounds, DELAY_STEP) for one in runs for name in delays]
        return tuple(free)

    def find_bounds(self, number: Free) -> tuple[float, float]:
        """What a number can be at all: that measured wheels bound a search tells where a limit is."""
        effect = self.find(number.effect)
        return number.bounds if effect is None else effect.parameter(number.name).bounds

    def get(self, free: Free) -> float:
        """Value of a free number; NaN where its effect is gone."""
        if not free.effect:
            return float(getattr(self.timing[free.runs[0]], free.name))
        if free.runs and (free.effect, free.name) in self.own.get(free.runs[0], {}):
            return self.own[free.runs[0]][free.effect, free.name]
        effect = self.find(free.effect)
        return math.nan if effect is None else effect.values[free.name]

    def neutral_of(self, free: Free) -> float:
        """Value at which a free number does nothing; zero for a delay, NaN where it only says where."""
        effect = self.find(free.effect)
        return 0.0 if effect is None else effect.parameter(free.name).neutral

    def find_room(self, free: Free) -> tuple[float, float]:
        """Least and largest step of a number, as `move` takes it, that keeps it within its bounds."""
        value, (least, most) = self.get(free), free.bounds
        if not math.isinf(self.neutral_of(free)):
            return min(least - value, 0.0), max(most - value, 0.0)
        # A limit acts by its inverse, which is what is linear.
        low = value - value**2 / least if least > 0.0 else -math.inf
        return low, min((1.0 - _LEAST_INVERSE) * value, value - value**2 / most if most > value else math.inf)

    def set(self, free: Free, value: float) -> ModelState:
        """The state with another value of a free number, held to its bounds."""
        value = free.hold(value)
        if not free.effect:
            timing = list(self.timing)
            timing[free.runs[0]] = replace(timing[free.runs[0]], **{free.name: value})
            return replace(self, timing=tuple(timing))
        if free.runs:
            own = {run: {**self.own.get(run, {}), (free.effect, free.name): value} for run in free.runs}
            return replace(self, own={**self.own, **own})
        changed = (
            effect.change(**{free.name: value}) if effect.id == free.effect else effect
            for effect in self.effects
        )
        return replace(self, effects=tuple(changed))

    def set_clocks(self, effect: Effect, delays: Sequence[float]) -> ModelState:
        """The state with a delay of each run's own of an effect of it that makes something late."""
        (name,) = effect.values
        own = {run: {**self.own.get(run, {}), (effect.id, name): late} for run, late in enumerate(delays)}
        return replace(self, own=own)

    def take_over(self, other: ModelState, free: Iterable[Free]) -> ModelState:
        """The state with the values that another one has of some numbers."""
        state = self
        for number in free:
            state = state.set(number, other.get(number))
        return state

    def weaken(self, names: Collection[str], share: float) -> ModelState:
        """The state with a share of what effects do by one number that is not linear: a limit by its inverse.

        Those of several numbers stay: the way from none to all of them leads through other vehicles.
        """
        acting = {effect.id: effect.list_acting() for effect in self.effects if effect.id in names}
        weak = {
            name: numbers[0]
            for name, numbers in acting.items()
            if len(numbers) == 1 and numbers[0].search is Search.STARTS
        }

        def scale(name: str, value: float) -> float:
            neutral, (low, high) = weak[name].neutral, weak[name].bounds
            weaker = value / share if math.isinf(neutral) else neutral + share * (value - neutral)
            return min(max(weaker, low), high)

        if not weak:
            return self
        own = {
            run: {
                (name, of): scale(name, value) if name in weak and of == weak[name].name else value
                for (name, of), value in numbers.items()
            }
            for run, numbers in self.own.items()
        }
        changed = [
            effect.change(**{weak[effect.id].name: scale(effect.id, effect.values[weak[effect.id].name])})
            for effect in self.effects
            if effect.id in weak
        ]
        return replace(self, own=own).add(*changed)

    def move(self, free: Sequence[Free], step: Sequence[float]) -> ModelState:
        """The state with free numbers changed by a step."""
        state, shared = self, dict[str, dict[str, float]]()
        for number, change in zip(free, step, strict=True):
            value = self.get(number)
            if math.isinf(self.neutral_of(number)):
                # A limit acts by its inverse, which is what is linear.
                value /= max(1.0 - change / value, _LEAST_INVERSE)
            else:
                value += change
            if number.effect and not number.runs:
                shared.setdefault(number.effect, {})[number.name] = number.hold(value)
            else:
                state = state.set(number, value)
        # Each effect is made once: a fit moves all of its numbers thousands of times.
        changed = (one.change(**shared[one.id]) if one.id in shared else one for one in state.effects)
        return replace(state, effects=tuple(changed))


# What is known of a model's numbers before a run is seen: observations of the numbers themselves.
#
# p numbers, each z standard deviations from its mean, add (f + p) log(1 + sum z^2 / f) to the cost of a fit,
# as one more observation (maximum a posteriori): that of a multivariate t distribution with few degrees of
# freedom f (Lange, Little and Taylor, JASA 84, 1989). Where the run contradicts what was known of one number,
# all of them are held less: a run with an effect that no other run had is unlike them in several.

# Degrees of freedom: what was known is forgotten where a run lies several deviations off.
_FREEDOM = 4.0


@dataclass(frozen=True)
class Prior:
    """Distributions of numbers that all runs share.

    Attributes:
        numbers: mean and standard deviation by label ``effect.name``, deviations positive.
    """

    numbers: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def cost(self, state: ModelState, free: Sequence[Free]) -> float:
        """Cost of a state's free numbers, in units of chi-square."""
        if not self.numbers:
            return 0.0
        away, known = self._compare(state, free)
        count = np.count_nonzero(known)
        return (_FREEDOM + int(count)) * float(np.log1p(known @ away**2 / _FREEDOM))

    def weigh(self, state: ModelState, free: Sequence[Free]) -> Floats:
        """Information on each of all free numbers, zero where nothing is known, shape (p,)."""
        if not self.numbers:
            return np.zeros(len(free))
        away, known = self._compare(state, free)
        held = (_FREEDOM + np.count_nonzero(known)) / (_FREEDOM + known @ away**2)
        weighed: Floats = held * known
        return weighed

    def pull(self, state: ModelState, free: Sequence[Free]) -> Floats:
        """Half the fall of the cost with each of all free numbers, shape (p,)."""
        return self.weigh(state, free) * self._compare(state, free)[0]

    def _compare(self, state: ModelState, free: Sequence[Free]) -> tuple[Floats, Floats]:
        """Way from each number to its mean, and one over its variance; zeros where nothing is known."""
        pairs = [self._find(number) for number in free]
        away = [0.0 if one is None else one[0] - state.get(n) for one, n in zip(pairs, free, strict=True)]
        known = [0.0 if one is None else 1.0 / one[1] ** 2 for one in pairs]
        return np.array(away), np.array(known)

    def _find(self, number: Free) -> tuple[float, float] | None:
        return None if number.runs else self.numbers.get(number.label)


NO_PRIOR = Prior()
"""Nothing is known before."""
