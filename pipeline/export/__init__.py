"""Export of models to targets; the targets are discovered in the folder `targets`."""

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
    """Format or program to which a model can be exported.

    Attributes:
        name: name on the command line.
        about: what is written.
        source: reference for the names, units and meanings of its parameters, with the version.
        write: makes the text from a model file and the current parameters of the robot, by name.
        corrects: names of the current parameters it reads; empty if all its values are absolute.
        read_current: reads them from the text of the robot's file.
        has_errors: whether it writes held-out errors, for which a log may be given.
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
    """All targets of the folder, by name."""
    folder = importlib.import_module("pipeline.export.targets")
    modules = (
        importlib.import_module(f"{folder.__name__}.{m.name}") for m in pkgutil.iter_modules(folder.__path__)
    )
    targets = (value for module in modules for value in vars(module).values() if isinstance(value, Target))
    return tuple(sorted(targets, key=lambda target: target.name))


def find_target(name: str) -> Target:
    """Target of the given name.

    Raises:
        MotionError: ``unknown_target``, with a list of all targets.
    """
    for target in list_targets():
        if target.name == name:
            return target
    names = [target.name for target in list_targets()]
    hint = f"{guess_names(name, names)}There are: {', '.join(names)}."
    raise MotionError("unknown_target", f"no export is called {name!r}", where=name, hint=hint)


def read_current(path: Path, name: str) -> Current:
    """Current parameters of the robot, which a target corrects.

    Args:
        path: the robot's parameter file.
        name: name of the target.

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
    """Check that a target writes held-out errors, for which a log may be given.

    Raises:
        MotionError: ``unknown_target``; ``no_errors_written``.
    """
    if not find_target(name).has_errors:
        what = f"{name} contains no held-out errors: it is written from the model alone"
        hint = "Omit --on; to fit the model to a log first: slip model fit MODEL --on LOG."
        raise MotionError("no_errors_written", what, where="--on", hint=hint)


def export_model(file: ModelFile, name: str, current: Current | None = None) -> str:
    """Text of a target's file.

    Args:
        file: a fitted model.
        name: name of the target.
        current: current parameters of the robot, by name; see `read_current`.

    Raises:
        MotionError: ``unknown_target``; ``wrong_vehicle``, the target has no parameters for its kind;
            others, see the target.
    """
    return find_target(name).write(file, current or {})
