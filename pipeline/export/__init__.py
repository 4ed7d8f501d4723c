"""Models as what people run: targets, which are found in the folder `targets`, and the export to them."""

import functools
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.program import guess_names
from pipeline.models.model_file import ModelFile
from pipeline.run.recording import MotionError

Current = Mapping[str, float]


@dataclass(frozen=True)
class Target:
    """Something that people run.

    Attributes:
        name: as the command line has it.
        about: what is written.
        source: where its parameters' names, units and meanings were read, with the version.
        write: makes the text of a model file and of parameters that the robot has now, by name.
        corrects: names of those it reads; none where all its numbers are absolute.
        read_current: reads them out of the text of the robot's file.
        has_errors: whether it writes held-out errors, which a log may be named for.
    """

    name: str
    about: str
    source: str
    write: Callable[[ModelFile, Current], str]
    corrects: tuple[str, ...] = ()
    read_current: Callable[[str], Current] | None = None
    has_errors: bool = False


@functools.cache
def list_targets() -> tuple[Target, ...]:
    """Every target of the folder, by name."""
    folder = importlib.import_module("pipeline.export.targets")
    modules = (
        importlib.import_module(f"{folder.__name__}.{m.name}") for m in pkgutil.iter_modules(folder.__path__)
    )
    targets = (value for module in modules for value in vars(module).values() if isinstance(value, Target))
    return tuple(sorted(targets, key=lambda target: target.name))


def find_target(name: str) -> Target:
    """The target of that name.

    Raises:
        MotionError: ``unknown_target``, with all there are.
    """
    for target in list_targets():
        if target.name == name:
            return target
    names = [target.name for target in list_targets()]
    hint = f"{guess_names(name, names)}There are: {', '.join(names)}."
    raise MotionError("unknown_target", f"no export is called {name!r}", where=name, hint=hint)


def read_current(path: Path, name: str) -> Current:
    """Parameters that the robot has now, which a target corrects.

    Args:
        path: the robot's file of them.
        name: of the target.

    Raises:
        MotionError: ``unknown_target``; ``no_current_parameters``, the target corrects none;
            ``parameters_unreadable``.
    """
    target = find_target(name)
    if target.read_current is None:
        correcting = [other.name for other in list_targets() if other.read_current]
        what = f"{name} is written without the parameters that the robot has now"
        hint = f"Omit --current; it is for {' and '.join(correcting)}."
        raise MotionError("no_current_parameters", what, where=str(path), hint=hint)
    try:
        return target.read_current(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(
            "parameters_unreadable", f"cannot be read: {error}", where=str(path), hint="Check the file."
        ) from None
    except MotionError as error:
        raise MotionError(error.code, error.what, where=str(path), hint=error.hint) from None


def require_errors(name: str) -> None:
    """Make sure that a target writes held-out errors, for which a log may be named.

    Raises:
        MotionError: ``unknown_target``; ``no_errors_written``.
    """
    if not find_target(name).has_errors:
        what = f"{name} contains no held-out errors: it is written from the model alone"
        hint = "Omit --on; to fit the model to a log first: slip model fit MODEL --on LOG."
        raise MotionError("no_errors_written", what, where="--on", hint=hint)


def export_model(file: ModelFile, name: str, current: Current | None = None) -> str:
    """The text of a target's file.

    Args:
        file: a fitted model.
        name: of the target.
        current: parameters that the robot has now, by name; see `read_current`.

    Raises:
        MotionError: ``unknown_target``; ``wrong_vehicle``, the target has no parameters for its kind;
            others, see the target.
    """
    return find_target(name).write(file, current or {})
