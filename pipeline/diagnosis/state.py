"""A model being tried: effects with values, delays of each run, and its free numbers in order."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from pipeline.models.effect import Search

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pipeline.models.effect import Effect
    from pipeline.models.forward import Timing

_DELAY_STEP = 5e-3
_LARGEST_DELAY = 0.6


@dataclass(frozen=True)
class Slot:
    """One free number of a state.

    Attributes:
        effect: id of the effect; empty for a delay of a run.
        name: parameter, or `pose_delay_s` or `wheel_delay_s`.
        run: which run a delay is of.
        bounds: smallest and largest value.
        step: change for numerical derivatives.
        search: how it is found.
    """

    effect: str
    name: str
    run: int
    bounds: tuple[float, float]
    step: float
    search: Search


DelayName = Literal["pose_delay_s", "wheel_delay_s"]


@dataclass(frozen=True)
class State:
    """Effects in the order of a command's way, and the timing of each run."""

    effects: tuple[Effect, ...]
    timing: tuple[Timing, ...]

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(effect.id for effect in self.effects)

    def find(self, name: str) -> Effect | None:
        """The effect of that id, None without."""
        return next((effect for effect in self.effects if effect.id == name), None)

    def add(self, *effects: Effect) -> State:
        """The state with effects added, or put in the place of those with their ids."""
        new = {effect.id for effect in effects}
        kept = [effect for effect in self.effects if effect.id not in new]
        ordered = sorted([*kept, *effects], key=lambda effect: (effect.place, effect.rank, effect.id))
        return replace(self, effects=tuple(ordered))

    def drop(self, names: Iterable[str]) -> State:
        """The state without some effects."""
        gone = set(names)
        return replace(self, effects=tuple(effect for effect in self.effects if effect.id not in gone))

    def list_slots(self, delays: tuple[DelayName, ...]) -> tuple[Slot, ...]:
        """Free numbers: parameters that are not fixed and say how much, then the delays of every run."""
        slots = [
            Slot(effect.id, p.name, 0, p.bounds, p.step, p.search)
            for effect in self.effects
            for p in effect.parameters
            if p.name not in effect.fixed and math.isfinite(effect.values[p.name])
        ]
        bounds = (-_LARGEST_DELAY, _LARGEST_DELAY)
        slots += [
            Slot("", name, run, bounds, _DELAY_STEP, Search.DIRECT)
            for run in range(len(self.timing))
            for name in delays
        ]
        return tuple(slots)

    def read(self, slot: Slot) -> float:
        """Value of a free number."""
        if not slot.effect:
            return float(getattr(self.timing[slot.run], slot.name))
        effect = self.find(slot.effect)
        return math.nan if effect is None else effect.values[slot.name]

    def neutral_of(self, slot: Slot) -> float:
        """Value at which a free number does nothing; zero for a delay, NaN where it only says where."""
        effect = self.find(slot.effect)
        return 0.0 if effect is None else effect.parameter(slot.name).neutral

    def write(self, slot: Slot, value: float) -> State:
        """The state with another value of a free number, held to its bounds."""
        value = min(max(value, slot.bounds[0]), slot.bounds[1])
        if slot.effect:
            return replace(
                self,
                effects=tuple(
                    effect.change(**{slot.name: value}) if effect.id == slot.effect else effect
                    for effect in self.effects
                ),
            )
        timing = list(self.timing)
        timing[slot.run] = replace(timing[slot.run], **{slot.name: value})
        return replace(self, timing=tuple(timing))
