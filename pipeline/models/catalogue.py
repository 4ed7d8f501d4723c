"""Catalogue of effects: those of the folder `effects`, and those of files that a user names and trusts."""

import functools
import hashlib
import importlib
import inspect
import os
import pkgutil
import re
import stat
import sys
import tempfile
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path, PurePosixPath
from types import ModuleType

from pipeline.core import guess_names, suffix_unit
from pipeline.models.effect import Effect, Excitation, Late, Parameter, Search, find_late
from pipeline.models.families import check_formula
from pipeline.models.formula import FormulaEffect
from pipeline.models.learned_term import ResidualTerm
from pipeline.models.parameter import is_of_one_run
from pipeline.models.words import find_words
from pipeline.run import MotionError

# The user's own Python code is read once, and run only if exactly this content is trusted.
#
# Trust is a list of SHA-256 hashes in the user's configuration folder. The hashed bytes are run: they
# are read once, and cached bytecode beside a file (`__pycache__`) is ignored.

_LONGEST = 1_000_000
"""Largest size of a file of effects [bytes]: a hundred times the longest of the catalogue."""
_LINE = re.compile(r"([0-9a-f]{64})  (.*)")
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def read_code(folder: Path, name: str) -> bytes:
    """Content of a Python file that a model file names.

    Args:
        folder: folder of the model file.
        name: file name as written there.

    Raises:
        MotionError: ``effects_file``, it is in another folder, missing, not a regular file, or too long.
    """
    relative = PurePosixPath(name)
    if relative.is_absolute() or not relative.name or ".." in relative.parts or "\\" in name or "\0" in name:
        raise _bad_file(name, "a file of effects must lie beside the model file", "Write its name alone.")
    try:
        descriptor = os.open(folder / relative, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError):
        raise _bad_file(name, "there is no such file of effects", "Check the path.") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _bad_file(name, "the file of effects is not a regular file", "Check the path.")
    with os.fdopen(descriptor, "rb") as file:
        content = file.read(_LONGEST + 1)
    if len(content) > _LONGEST:
        raise _bad_file(name, f"the file of effects is longer than {_LONGEST} bytes", "Split it.")
    return content


def hash_code(content: bytes) -> str:
    """SHA-256 of code, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def list_trusted() -> dict[str, str]:
    """Trusted hashes with the names of their files; empty without a list.

    Raises:
        MotionError: ``trust_unsafe``, other users can write the list.
    """
    path = _list_path()
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            content = file.read()
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except OSError as error:
        raise _bad_list(path, f"cannot be read: {error.strerror}") from None
    if status.st_uid != os.geteuid() or status.st_mode & _OTHERS_WRITE:
        raise _bad_list(path, "is not yours alone to write, so nothing in it counts")
    matches = map(_LINE.fullmatch, content.decode("utf-8", "replace").split("\n"))
    return {match[1]: match[2] for match in matches if match}


def trust(codes: dict[str, str]) -> None:
    """Add code to the trusted code.

    Args:
        codes: names by hash.

    Raises:
        MotionError: ``trust_unsafe``.
    """
    _write({**list_trusted(), **codes})


def distrust(hashes: set[str]) -> None:
    """Remove code from the trusted code.

    Raises:
        MotionError: ``trust_unsafe``.
    """
    _write({code: name for code, name in list_trusted().items() if code not in hashes})


def _write(codes: dict[str, str]) -> None:
    path = _list_path()
    plain = {code: "".join(c if c.isprintable() else "?" for c in name) for code, name in codes.items()}
    text = "".join(f"{code}  {name}\n" for code, name in sorted(plain.items()))
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        # The owner alone can access a temporary file, and this mode remains when it is renamed.
        descriptor, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(text.encode())
        Path(temporary).replace(path)
    except OSError as error:
        raise _bad_list(path, f"cannot be written: {error.strerror}") from None


def _list_path() -> Path:
    """Path of the list in the user's configuration folder; a relative XDG_CONFIG_HOME is ignored."""
    given = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    try:
        base = given if given.is_absolute() else Path.home() / ".config"
    except RuntimeError:
        raise _bad_list(Path("~/.config"), "cannot be found: there is no home folder") from None
    return base / "slip" / "trusted_code"


def _bad_file(name: str, what: str, hint: str) -> MotionError:
    return MotionError("effects_file", what, where=repr(name), hint=hint)


def _bad_list(path: Path, what: str) -> MotionError:
    hint = "Make it yours and writable by you alone (chmod 600), or set XDG_CONFIG_HOME to a folder of yours."
    return MotionError("trust_unsafe", f"the list of trusted code {what}", where=str(path), hint=hint)


EffectClass = type[Effect]

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")

_OWN = "slip_effects_"


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


def find_effect(name: str, own: Mapping[str, EffectClass] | None = None) -> EffectClass:
    """The effect of that id.

    Args:
        name: id of the effect.
        own: effects of the user's own, by id; they take precedence.

    Raises:
        MotionError: ``unknown_effect``, with the nearest ids.
    """
    # A learned term is not in the folder, as it is never reported as a cause.
    every: tuple[EffectClass, ...] = (*list_effects(), ResidualTerm)
    known = {effect.id: effect for effect in every} | dict(own or {})
    if name in known:
        return known[name]
    hint = f"{guess_names(name, known)}`slip effects` lists them all."
    if name.endswith(".py"):
        hint = f'Name its file above [vehicle] of the model file, effects = ["{name}"], and its id here.'
    raise MotionError("unknown_effect", f"no effect is called {name!r}", where=name, hint=hint)


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


@functools.lru_cache(maxsize=64)
def run_effects(code: bytes, path: Path) -> Mapping[str, EffectClass]:
    """Effects of the user's own Python code, by id. The code is run: the caller checks that it is trusted.

    Args:
        code: the code; the file itself is not read again.
        path: path of the file.

    Raises:
        MotionError: ``effects_file``, the code fails or defines no effect.
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
            hint="Correct it; it must be importable Python.",
        ) from error
    effects = {effect.id: effect for effect in _effects_of(module)}
    for effect in effects.values():
        check_formula(effect)
    if not effects:
        hint = "Derive a class from one of pipeline.models's effect classes and give it an id."
        raise MotionError("effects_file", "the file defines no effect", where=str(path), hint=hint)
    return effects


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


def explain_idle(effect: Effect | EffectClass, ids: Collection[str]) -> str:
    """Why it does not act in a model of these effects: `acts only beside wheel_servo`; empty if it acts."""
    return "" if effect.acts_in(ids) else f"acts only beside {' or '.join(effect.acts_with)}"


def format_effect(effect: type[Effect] | Effect) -> str:
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
