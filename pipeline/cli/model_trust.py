"""Python that a model file names: trusted once by its content, else left out and said."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.output import print_result, say

if TYPE_CHECKING:
    from pipeline.models.model_file import ModelFile

TrustCode = Annotated[
    bool,
    Parameter(
        name="--trust-code", negative="", help="trust the Python that the model file names, now and later"
    ),
]


def trust_named(path: Path | None, *, wanted: bool) -> None:
    """Trust the Python that a model file names, if that is wanted.

    Raises:
        MotionError: a file is missing, or the list of what is trusted cannot be written.
    """
    if path is None or not wanted:
        return
    from pipeline.models.model_file import list_code  # noqa: PLC0415 - heavy
    from pipeline.models.trust import trust as trust_hashes  # noqa: PLC0415

    trust_hashes(list_code(path))


def open_model(path: Path, *, trust_code: bool) -> ModelFile:
    """Read a model file, and say on the screen what of it is left out.

    Raises:
        MotionError: the file is wrong.
    """
    from pipeline.models.model_file import read_model  # noqa: PLC0415 - heavy

    trust_named(path, wanted=trust_code)
    file = read_model(path)
    for warning in file.warnings:
        say(f"slip: {warning}")
    return file


def trust(files: Annotated[list[Path], Parameter(negative=())], /, *, json: bool = False) -> int:
    """Trust the Python that model files name, by its content: it is run from now on, wherever it lies.

    Read it first: it can do whatever you can. A changed file must be trusted anew.

    Args:
        files: model files, or Python files.
        json: print one JSON object.
    """
    from pipeline.models.model_file import list_code  # noqa: PLC0415 - heavy
    from pipeline.models.trust import trust as trust_hashes  # noqa: PLC0415

    found = {code: name for path in files for code, name in list_code(path).items()}
    trust_hashes(found)
    return _print(found, "names no Python", json=json)


def untrust(codes: Annotated[list[str], Parameter(negative=())], /, *, json: bool = False) -> int:
    """Trust Python no longer.

    Args:
        codes: model files, Python files, or hashes (or how they begin) as `slip model trusted` lists them.
        json: print one JSON object.
    """
    from pipeline.models.model_file import list_code  # noqa: PLC0415 - heavy
    from pipeline.models.trust import distrust, list_trusted  # noqa: PLC0415

    gone: dict[str, str] = {}
    known = list_trusted()
    for word in codes:
        meant = (
            list_code(Path(word))
            if Path(word).exists()
            else [code for code in known if code.startswith(word)]
        )
        gone |= {code: known[code] for code in meant if code in known}
    distrust(set(gone))
    return _print(gone, "none of it was trusted", json=json)


def trusted(*, json: bool = False) -> int:
    """List the Python that is trusted.

    Args:
        json: print one JSON object.
    """
    from pipeline.models.trust import list_trusted  # noqa: PLC0415 - heavy

    return _print(list_trusted(), "no Python is trusted", json=json)


def _print(codes: dict[str, str], otherwise: str, *, json: bool) -> int:
    content = {"code": [{"sha256": code, "name": name} for code, name in codes.items()]}
    return print_result(
        content, lambda: [f"{code}  {name}" for code, name in codes.items()] or [otherwise], json=json
    )
