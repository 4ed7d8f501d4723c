"""A model: a vehicle and the effects that make its motion differ from the ideal one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from pipeline.models.effect import Effect
from pipeline.runs.errors import MotionError
from pipeline.vehicles import Vehicle


@dataclass(frozen=True)
class Model:
    """A vehicle and its effects, in the order of a command's way.

    ``model + effect`` and ``model - "id"`` make other models; without effects it is the ideal model.

    Attributes:
        vehicle: geometry.
        effects: sorted by place and rank, no id twice.
    """

    vehicle: Vehicle
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for effect in self.effects:
            if effect.id in seen:
                what = f"the model has {effect.id} twice"
                hint = "Drop one of them, or change its parameters."
                raise MotionError("effect_twice", what, where=effect.id, hint=hint)
            seen.add(effect.id)
            if self.vehicle.kind not in effect.kinds:
                raise MotionError(
                    "wrong_vehicle",
                    f"{effect.id} exists on {' or '.join(effect.kinds)} vehicles only; {self.vehicle.id} is "
                    f"{self.vehicle.kind}",
                    where=effect.id,
                    hint="Choose another effect.",
                )
        ordered = sorted(self.effects, key=lambda effect: (effect.place, effect.rank))
        object.__setattr__(self, "effects", tuple(ordered))

    def __add__(self, effect: Effect) -> Model:
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, effect: str | Effect) -> Model:
        name = effect if isinstance(effect, str) else effect.id
        self.effect(name)
        return replace(self, effects=tuple(e for e in self.effects if e.id != name))

    def __contains__(self, name: str) -> bool:
        return name in self.ids

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the effects in order."""
        return tuple(effect.id for effect in self.effects)

    @property
    def ideal(self) -> Model:
        """The same vehicle without effects."""
        return Model(self.vehicle)

    def effect(self, name: str) -> Effect:
        """The effect of that id.

        Raises:
            MotionError: ``no_such_effect``, the model does not have it.
        """
        for effect in self.effects:
            if effect.id == name:
                return effect
        hint = f"It has: {', '.join(self.ids) or 'none'}."
        raise MotionError("no_such_effect", f"the model has no effect {name!r}", where=name, hint=hint)

    def change(self, name: str, **values: float) -> Model:
        """The model with other values of one effect's parameters.

        Raises:
            MotionError: no such effect or parameter, or a value out of bounds.
        """
        return self.swap(self.effect(name).change(**values))

    def swap(self, *effects: Effect) -> Model:
        """The model with effects of the same ids put in the place of those it has."""
        new = {effect.id: effect for effect in effects}
        return replace(self, effects=tuple(new.get(e.id, e) for e in self.effects))

    def keep(self, names: Iterable[str]) -> Model:
        """The model with only these effects."""
        wanted = set(names)
        return replace(self, effects=tuple(e for e in self.effects if e.id in wanted))
