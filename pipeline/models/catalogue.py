"""Finding effects: those of the folder `effects`, and those of files that a user names."""

import functools
import importlib
import inspect
import pkgutil
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from pipeline.models.effect import Effect, Late, find_late
from pipeline.models.trust import hash_code
from pipeline.runs.errors import MotionError

EffectClass = type[Effect]

_OWN = "slip_effects_"


@functools.cache
def list_effects() -> tuple[EffectClass, ...]:
    """Every effect of the folder, in the order of a command's way."""
    folder = importlib.import_module("pipeline.models.effects")
    found: list[EffectClass] = []
    for module in pkgutil.iter_modules(folder.__path__):
        found += _effects_of(importlib.import_module(f"pipeline.models.effects.{module.name}"))
    return tuple(sorted(found, key=lambda effect: (effect.place, effect.rank, effect.id)))


def find_effect(name: str, own: Mapping[str, EffectClass] | None = None) -> EffectClass:
    """The effect of that id.

    Args:
        name: id of the effect.
        own: effects of the user's own, by id; they win.

    Raises:
        MotionError: ``unknown_effect``, with the nearest ids.
    """
    known = {effect.id: effect for effect in list_effects()} | dict(own or {})
    if name in known:
        return known[name]
    import difflib  # noqa: PLC0415 - only for the error

    near = difflib.get_close_matches(name, known, n=3)
    guess = f"Did you mean {' or '.join(near)}? " if near else ""
    hint = f"{guess}`slip effects` lists them all."
    raise MotionError("unknown_effect", f"no effect is called {name!r}", where=name, hint=hint)


def find_late_effect(late: Late) -> EffectClass:
    """The effect of the folder that makes this late.

    Raises:
        MotionError: ``unknown_effect``, there is none.
    """
    found = find_late(list_effects(), late)
    if found is None:
        hint = "Give one of the folder `effects` that `late`."
        raise MotionError("unknown_effect", f"no effect says that {late.value}", where=late.name, hint=hint)
    return found


@functools.lru_cache(maxsize=64)
def run_effects(code: bytes, path: Path) -> Mapping[str, EffectClass]:
    """Effects of a user's own Python, by id. It is run: see `trust` for whether it may be.

    Args:
        code: what is run; the file itself is not read again.
        path: where it stands.

    Raises:
        MotionError: ``effects_file``, it does not run, or defines no effect.
    """
    module = ModuleType(f"{_OWN}{hash_code(code)}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module
    try:
        exec(compile(code, str(path), "exec", dont_inherit=True), vars(module))  # noqa: S102 - it is trusted
    except Exception as error:
        del sys.modules[module.__name__]
        raise MotionError(
            "effects_file",
            f"the file of effects does not run: {type(error).__name__}: {' '.join(str(error).split())}",
            where=str(path),
            hint="Mend it; it must be importable Python.",
        ) from error
    found = {effect.id: effect for effect in _effects_of(module)}
    if not found:
        hint = "Derive a class from one of pipeline.models's effect classes and give it an id."
        raise MotionError("effects_file", "the file defines no effect", where=str(path), hint=hint)
    return found


def is_own(kind: EffectClass) -> bool:
    """Whether an effect comes from Python of the user's own."""
    return kind.__module__.startswith(_OWN)


def _effects_of(module: ModuleType) -> list[EffectClass]:
    return [
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and issubclass(value, Effect)
        and not inspect.isabstract(value)
        and value.__module__ == module.__name__
    ]
