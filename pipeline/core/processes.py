"""The program and its processes: version, warnings, how Python is started."""

import os
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

from pipeline.core.text import SlipError


def silence_warnings() -> None:
    """Hide warnings in this process unless requested (``python -W``, ``PYTHONWARNINGS``).

    Users are informed by findings, losses and errors. Filters are unchanged: warnings that are errors, as in
    the tests, remain errors.
    """
    if not sys.warnoptions:
        warnings.showwarning = _ignore


def _ignore(*_: object, **__: object) -> None:
    return None


PACKAGE = "slip-pipeline"


def read_version() -> str:
    """Version of the installed package; in a checkout that is not installed, the declared one."""
    # Every call of the program imports this module, and few need the version.
    import importlib.metadata  # noqa: PLC0415
    import tomllib  # noqa: PLC0415

    try:
        return importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        declared = Path(__file__).parents[2] / "pyproject.toml"
        content = tomllib.loads(declared.read_text(encoding="utf-8"))
        return str(content["project"]["version"])


def name_install(extra: str = "") -> str:
    """The command that installs what an extra needs, or what comes without one."""
    return f"pip install '{PACKAGE}[{extra}]'" if extra else f"pip install {PACKAGE}"


def find_cache_folder() -> Path:
    """Folder of what is kept for the next call: compiled loops of an installation, scripts of pages."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "slip"


def require_package(name: str, extra: str, purpose: str, *, otherwise: str = "") -> None:
    """Refuse what needs a package of an extra that is not installed.

    Args:
        name: the package, as it is imported.
        extra: the extra of `slip-pipeline` that installs it; empty for what comes without one.
        purpose: what needs it, the beginning of a sentence.
        otherwise: how to do without it.

    Raises:
        SlipError: ``no_`` and the name.
    """
    if find_spec(name) is None:
        what = f"{purpose} needs {name}, which is not installed"
        hint = f"Install it: {name_install(extra)}"
        raise SlipError(f"no_{name}", what, hint=f"{hint}, or {otherwise}" if otherwise else hint)


_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS")
"""Environment variables with the number of threads of numerical libraries."""


def python_command(*words: str) -> list[str]:
    """Command line of this interpreter, by its absolute path, without the current folder in its import path.

    Args:
        words: arguments, such as ``-m pipeline analyze``.
    """
    return [os.path.abspath(sys.executable), "-P", *words]  # noqa: PTH100 - a link into an environment stays


def keep_current_folder_out() -> None:
    """Exclude the current folder from the import path of Python processes started by libraries."""
    os.environ["PYTHONSAFEPATH"] = "1"


def prepare_workers() -> None:
    """Give processes started from here one thread each, and no current folder in their import path."""
    # They inherit the environment; more threads than cores slow each other down.
    for variable in _THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    keep_current_folder_out()
