"""Catalogue of effects: those of the folder `effects`, and those of the user's own Python.

Own effects come from files that the user names, and from installed packages, as entry points of the group
`slip.effects`. A model file names effects, never code.
"""

import functools
import hashlib
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata, resources
from pathlib import Path
from types import ModuleType

from pipeline.core import guess_names, naming_os_errors, read_bounded, suffix_unit
from pipeline.models.effect import Effect, Excitation, Late, Parameter, Search, find_late
from pipeline.models.families import check_formula
from pipeline.models.formula import FormulaEffect
from pipeline.models.parameter import is_of_one_run
from pipeline.models.words import find_words
from pipeline.run import MotionError

EffectClass = type[Effect]

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")

_GROUP = "slip.effects"
"""Entry points by which an installed package brings effects: classes, or modules that hold them."""

_own: dict[str, EffectClass] = {}
"""Own effects of files that the user named, by id."""


@functools.cache
def list_effects() -> tuple[EffectClass, ...]:
    """All effects of the folder, in the order of the command path."""
    folder = importlib.import_module("pipeline.models.effects")
    effects: list[EffectClass] = []
    for module in pkgutil.iter_modules(folder.__path__):
        effects += _effects_of(importlib.import_module(f"pipeline.models.effects.{module.name}"))
    by_id: dict[str, EffectClass] = {}
    for effect in effects:
        if (other := by_id.setdefault(effect.id, effect)) is not effect:
            what = f"{other.__module__} and {effect.__module__} have one id, {effect.id}"
            raise MotionError("same_id", what, where=effect.id, hint="Give each effect an id of its own.")
    return tuple(sorted(effects, key=lambda effect: (effect.place, effect.rank, effect.id)))


def find_effect(name: str) -> EffectClass:
    """The effect of that id, of the catalogue or the user's own.

    Raises:
        MotionError: ``unknown_effect``, with the nearest ids.
    """
    known = {effect.id: effect for effect in list_effects()}
    effect = known.get(name) or list_own_effects().get(name)
    if effect is None:
        near = guess_names(name, known)
        hint = f"{near}`slip effects` lists them all; --effects FILE.py loads one of your own."
        raise MotionError("unknown_effect", f"no effect is called {name!r}", where=name, hint=hint)
    return effect


def name_effect(effect: str) -> str:
    """Name of an effect in words, as `Yaw rate limit` for `body_turn_limit`."""
    return find_words(effect).name or effect.replace("_", " ").capitalize()


def name_number(effect: str, parameter: str) -> str:
    """Name of a parameter within a sentence: `wheel servo: time constant straight ahead`."""
    return f"{name_term(effect)}{_name_among(effect, parameter)}"


def _name_among(effect: str, parameter: str) -> str:
    kind = find_effect(effect)
    if len(kind.parameters) == 1:
        return ""
    return f": {kind().parameter(parameter).about.partition(' (')[0].partition(', ')[0]}"


def refuse_taken(name: str, where: str = "effect") -> None:
    """Refuse a formula that is called like an effect of the catalogue.

    Raises:
        MotionError: ``bad_name``.
    """
    if name in {effect.id for effect in list_effects()}:
        what = f"an effect of the catalogue is called {name!r}"
        raise MotionError("bad_name", what, where=where, hint="Choose another name.")


def find_late_effect(late: Late) -> EffectClass:
    """The effect of the folder with this delay.

    Raises:
        MotionError: ``unknown_effect``, there is none.
    """
    effect = find_late(list_effects(), late)
    if effect is None:
        hint = "Give one of the folder `effects` that `late`."
        raise MotionError("unknown_effect", f"no effect says that {late.value}", where=late.name, hint=hint)
    return effect


def load_effects(paths: Iterable[Path]) -> None:
    """Run the user's own Python files, whose effects models may have from now on.

    Args:
        paths: Python files; one with an id of an earlier file takes its place.

    Raises:
        MotionError: ``effects_file``, a file cannot be read, fails, or defines no effect; ``same_id``, one of
            its effects has the id of one of the catalogue.
    """
    for path in paths:
        hint = "Check the path."
        with naming_os_errors(MotionError, "effects_file", "cannot be read", where=path, hint=hint):
            code = read_bounded(path)
        module = ModuleType(f"slip_effects_{hashlib.sha256(code).hexdigest()}")
        module.__file__ = str(path)
        sys.modules[module.__name__] = module
        with _naming_errors(str(path)):
            exec(compile(code, str(path), "exec", dont_inherit=True), vars(module))  # noqa: S102 - the user's own
        _own.update(_check_own(_effects_of(module), str(path)))


@contextmanager
def _naming_errors(where: str) -> Iterator[None]:
    """Raise whatever the user's own Python raises as one line that says where."""
    try:
        yield
    except Exception as error:
        what = f"the effects cannot be loaded: {type(error).__name__}: {' '.join(str(error).split())}"
        hint = "Correct it; it must be importable Python."
        raise MotionError("effects_file", what, where=where, hint=hint) from error


def list_own_effects() -> dict[str, EffectClass]:
    """The user's own effects by id: of installed packages, and of files that were loaded."""
    return _list_installed() | _own


@functools.cache
def _list_installed() -> dict[str, EffectClass]:
    effects: dict[str, EffectClass] = {}
    for entry in metadata.entry_points(group=_GROUP):
        with _naming_errors(f"{_GROUP}: {entry.name}"):
            loaded = entry.load()
        classes = _effects_of(loaded) if inspect.ismodule(loaded) else [loaded]
        effects |= _check_own(classes, f"{_GROUP}: {entry.name}")
    return effects


def _check_own(effects: list[EffectClass], where: str) -> dict[str, EffectClass]:
    if not effects:
        hint = "Derive a class from one of pipeline.models's effect classes and give it an id."
        raise MotionError("effects_file", "it defines no effect", where=where, hint=hint)
    for effect in effects:
        if any(known.id == effect.id for known in list_effects()):
            what, hint = f"an effect of the catalogue is called {effect.id!r}", "Choose another id."
            raise MotionError("same_id", what, where=where, hint=hint)
        check_formula(effect)
    return {effect.id: effect for effect in effects}


def draft_effect(path: Path) -> str:
    """Template of a file for the user's own effect, with the name of the file as its id.

    Raises:
        MotionError: ``bad_effect_name``, the name is not valid for an effect, or exists in the folder.
    """
    name = path.stem
    is_taken = any(effect.id == name for effect in list_effects())
    if path.suffix != ".py" or not _NAME.fullmatch(name) or is_taken:
        what = "an effect is called so already" if is_taken else "it cannot be the file of an effect"
        hint = "Name it in small letters, digits and _, for example side_wind.py."
        if not path.suffix and _NAME.fullmatch(name):
            hint = f"Name it {name}.py."
        raise MotionError("bad_effect_name", what, where=str(path), hint=hint)
    template = resources.files("pipeline.models").joinpath("own_effect.py.in").read_text("utf-8")
    title = "".join(part.capitalize() for part in name.split("_"))
    return template.replace("my_effect", name).replace("MyEffect", title)


def is_own(kind: EffectClass) -> bool:
    """Whether an effect comes from the user's own Python code."""
    return not kind.__module__.startswith(f"{__package__}.")


def _effects_of(module: ModuleType) -> list[EffectClass]:
    return [
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and issubclass(value, Effect)
        and not inspect.isabstract(value)
        and value.__module__ == module.__name__
    ]


def explain_idle(effect: Effect | EffectClass, ids: Collection[str]) -> str:
    """Why it does not act in a model of these effects: `acts only beside wheel_servo`; empty if it acts."""
    return "" if effect.acts_in(ids) else f"acts only beside {' or '.join(effect.acts_with)}"


def format_page(effect: type[Effect] | Effect) -> str:
    """An effect's page: docstring, parameters, required excitation, and easily confused effects."""
    if isinstance(effect, FormulaEffect):
        page = effect.describe()
    else:
        # A paragraph is one line; the display wraps it.
        page = re.sub(r"(?m)^(\S.*)\n(?=\S)", r"\1 ", effect.find_page())
    lines = [page, "", f"id            {effect.id}", f"acts on       {effect.place.name.lower()}"]
    lines += [f"acts beside   {name}, which a model must contain" for name in effect.acts_with]
    lines.append(f"vehicles      {', '.join(effect.kinds)}")
    for parameter in effect.parameters:
        low, high = parameter.bounds
        how = " (searched on a grid)" if parameter.search is Search.GRID else ""
        lines.append(
            f"parameter     {parameter.name} [{parameter.unit}]: {parameter.about}; {low:g} to {high:g}, "
            f"neutral {parameter.neutral:g}, typical {parameter.typical:g}{how}"
        )
        texts = _format_sizes(parameter)
        if not is_of_one_run(effect.parameters):
            spread, unit = parameter.spread, suffix_unit(parameter.unit)
            texts.append(
                f"standard deviation between runs on one terrain {spread.size:.2g}{unit}: {spread.source}"
            )
        lines += [f"{'':<14}{text}" for text in texts]
    lines.append(f"observed by   {', '.join(need.value for need in effect.needs)}")
    if effect.equivalent_to:
        lines.append(f"same as       {', '.join(effect.equivalent_to)} ({effect.equivalent_when})")
    if effect.contains:
        lines.append(f"contains      {', '.join(effect.contains)}")
    if effect.parts:
        lines.append(f"searched as   {', '.join(part.effect for part in effect.parts)}")
    lines += [
        f"{'' if number else 'by level':<14}{one.level.value}: {one.name}, {one.text}"
        for number, one in enumerate(effect.readings)
    ]
    if effect.confused_with:
        lines.append(f"similar to    {', '.join(effect.confused_with)}")
    return "\n".join(lines)


def _format_sizes(parameter: Parameter) -> list[str]:
    """Detection threshold, exported quantities, observed range and sign of a parameter."""
    unit = suffix_unit(parameter.unit)
    lines = []
    if parameter.least is not None:
        least = parameter.least
        lines.append(f"detection threshold {least.size:g}{unit} from neutral: {least.reason}")
    if parameter.quantities:
        lines.append(f"exported as {' and '.join(quantity.about for quantity in parameter.quantities)}")
    if parameter.plausible is not None:
        range_ = parameter.plausible
        lines.append(f"observed range {range_.low:g} to {range_.high:g}{unit}: {range_.source}")
    if parameter.one_sign:
        lines.append("must be positive: the other sign has no physical meaning")
    return lines


def list_pages(effects: Sequence[type[Effect]]) -> list[str]:
    """The catalogue: one line per effect."""
    lines = []
    for effect in effects:
        title = effect.find_page().splitlines()[0]
        lines.append(f"{effect.id:<24}{effect.place.name.lower():<13}{title.split(': ', 1)[-1]}")
    return lines


MANOEUVRES: Mapping[Excitation, str] = {
    Excitation.DRIVING: "drive for a few minutes",
    Excitation.TURNING: "turn both ways, on the spot and while driving",
    Excitation.SPEED_SPREAD: "drive at several speeds, forward and backward",
    Excitation.BOTH_SIGNS: "drive forward and backward, straight and in curves of both signs",
    Excitation.CHANGES: "change speed and turning in steps, every few seconds",
    Excitation.SLOPE: "drive on a slope in several directions (by hand: `slip plan` is for level ground)",
    Excitation.LARGE: "command the largest speeds and yaw rates",
    Excitation.SMALL: "command very small speeds, and very small yaw rates while driving",
    Excitation.LONG: "drive for ten minutes, the same manoeuvres at the start and at the end",
    Excitation.STEERING: "steer to both sides at several speeds",
    Excitation.SIDEWAYS: "drive sideways both ways, at several speeds",
}


def name_term(name: str) -> str:
    """An effect by its term in place of its id: `lateral centre of rotation`."""
    term = name_effect(name)
    return f"{term[:1].lower()}{term[1:]}"


def suggest_manoeuvre(*effects: Effect) -> str:
    """Manoeuvres that excite effects."""
    needs = dict.fromkeys(need for effect in effects for need in effect.needs)
    return "; ".join(MANOEUVRES[need] for need in [*needs][:3])
