"""Motion models of the literature by name: sets of effects, and formulas for terms that are not effects.

A model is one file of the folder `literature`, which the screen, model files and comparisons use.
"""

import functools
import tomllib
from importlib import resources

import msgspec

from pipeline.core import guess_names
from pipeline.models.catalogue import find_effect
from pipeline.models.effect import Effect
from pipeline.models.formula import FormulaEffect, make_parameter
from pipeline.models.model import Model
from pipeline.run import MotionError
from pipeline.sources import Vehicle


class Constant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A parameter or constant of a formula.

    Attributes:
        unit: its unit.
        bounds: bounds of a fit.
        start: start value of a fit.
        is_fixed: whether it is a constant that a fit does not change.
        neutral: value at which the formula vanishes; for a constant, the constant itself by default.
        taken_from: attribute of the vehicle that gives its value.
    """

    unit: str
    bounds: tuple[float, float]
    start: float = 0.0
    is_fixed: bool = False
    neutral: float | None = None
    taken_from: str = ""


class LiteratureModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A published motion model.

    Attributes:
        title: description in one line.
        formula: as published, with the signs and axes of this program.
        source: authors, title and publication.
        link: DOI or arXiv number; empty where there is none.
        kinds: kinds of vehicles it describes.
        effects: ids of its effects.
        terms: formulas by channel, for terms that are not effects.
        numbers: parameters and constants of the formulas.
        needs: required properties of a vehicle beyond its kind, in words; empty for none.
        name: name for selecting it, that of its file.
    """

    title: str
    formula: tuple[str, ...]
    source: str
    link: str = ""
    kinds: tuple[str, ...] = ("differential",)
    effects: tuple[str, ...] = ()
    terms: dict[str, str] = {}
    numbers: dict[str, Constant] = {}
    needs: str = ""
    name: str = ""

    def make(self, vehicle: Vehicle) -> Model:
        """The model of a vehicle with start values of a fit.

        Raises:
            MotionError: ``wrong_vehicle``, it describes other vehicles; ``model_unavailable``, see `needs`.
        """
        hint = f"Choose one of {', '.join(model.name for model in list_models(vehicle))}."
        if vehicle.kind not in self.kinds:
            what = f"it describes {' or '.join(self.kinds)} vehicles; {vehicle.id} is {vehicle.kind}"
            raise MotionError("wrong_vehicle", what, where=self.name, hint=hint)
        if not self.describes(vehicle):
            what = f"it needs {self.needs}, which {vehicle.id} does not say"
            raise MotionError("model_unavailable", what, where=self.name, hint=hint)
        return Model(vehicle, self._make_effects(vehicle))

    def describes(self, vehicle: Vehicle) -> bool:
        """Whether it describes a vehicle, and the vehicle has the properties that it needs."""
        taken = [number.taken_from for number in self.numbers.values() if number.taken_from]
        on_wheels = vehicle.running_gear == "wheels" or not taken
        return vehicle.kind in self.kinds and on_wheels and all(getattr(vehicle, name) for name in taken)

    def count_numbers(self) -> int:
        """Constant of parameters that a fit estimates."""
        return sum(len(effect.values) - len(effect.fixed) for effect in self._make_effects(None))

    def _make_effects(self, vehicle: Vehicle | None) -> tuple[Effect, ...]:
        known: tuple[Effect, ...] = tuple(find_effect(name)() for name in self.effects)
        return (*known, self._make_formula(vehicle)) if self.terms else known

    def _make_formula(self, vehicle: Vehicle | None) -> FormulaEffect:
        starts = {
            name: getattr(vehicle, number.taken_from) if vehicle and number.taken_from else number.start
            for name, number in self.numbers.items()
        }
        neutral = {
            name: number.neutral if number.neutral is not None else (starts[name] if number.is_fixed else 0.0)
            for name, number in self.numbers.items()
        }
        parameters = tuple(
            make_parameter(name, number.unit, number.bounds, neutral=neutral[name])
            for name, number in self.numbers.items()
        )
        fixed = [name for name, number in self.numbers.items() if number.is_fixed]
        effect = FormulaEffect(f"{self.name}_terms", self.terms, parameters, fixed=fixed)
        return effect.change(**starts)


@functools.cache
def list_literature() -> tuple[LiteratureModel, ...]:
    """All published models, the ideal one first, then by name."""
    folder = resources.files("pipeline.models") / "literature"
    texts = {file.name.removesuffix(".toml"): file.read_text("utf-8") for file in folder.iterdir()}
    made = [
        msgspec.convert({**tomllib.loads(text), "name": name}, LiteratureModel)
        for name, text in texts.items()
    ]
    return tuple(sorted(made, key=lambda model: (model.name != "ideal", model.name)))


def list_models(vehicle: Vehicle) -> list[LiteratureModel]:
    """Published models that describe a vehicle."""
    return [model for model in list_literature() if model.describes(vehicle)]


def find_model(name: str) -> LiteratureModel:
    """The model of that name.

    Raises:
        MotionError: ``unknown_model``, with the nearest names.
    """
    known = {model.name: model for model in list_literature()}
    if name in known:
        return known[name]
    hint = f"{guess_names(name, known)}`slip model literature` lists them all."
    raise MotionError(
        "unknown_model", f"no model of the literature is called {name!r}", where=name, hint=hint
    )
