"""Commands about this machine: serve, and doctor, which says whether all that slip needs is there."""

import atexit
import importlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlencode

from cyclopts import Parameter
from cyclopts.types import PositiveFloat

from pipeline import core, models, store
from pipeline.cli.conventions import (
    CLEAN,
    FAILED,
    Asked,
    OwnEffects,
    Results,
    print_json,
    print_note,
    print_result,
)
from pipeline.core import PACKAGE, measure_memory, name_install, read_version, require_package


def serve(  # noqa: D417 - the results folder documents itself
    run: str | None = None,
    *,
    results: Results = Path("results"),
    port: int = 8321,
    host: str = "127.0.0.1",
    diagnosis: Annotated[bool, Parameter(negative="--no-diagnosis")] = True,
    effects: OwnEffects = None,
    timeout: PositiveFloat = 1800.0,
    asked: Asked,
    open_browser: Annotated[bool, Parameter(name="--open")] = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Serve the workbench: add an effect, watch the error fall.

    The page needs the token of the printed address; a script sends it as the header
    `Authorization: Bearer TOKEN`.

    Args:
        run: run that it opens with, by its name or its log, in place of the one analyzed last; or the results
            folder.
        port: port to listen on; 0 takes any that is free.
        host: address to listen on; anything but this machine's own opens it to the network.
        diagnosis: diagnose logs that are dropped on the page.
        timeout: longest time for an analysis or a diagnosis [s].
        open_browser: open the page in the browser.
        json: print address, token and the page with both as one JSON object.
        quiet: print nothing.
    """
    for package in ("uvicorn", "starlette", "numba", "vl_convert"):
        require_package(package, "serve", "the workbench")
    from pipeline.logs import SUFFIXES  # noqa: PLC0415 - heavy
    from pipeline.web import LOOPBACK, Limits  # noqa: PLC0415 - heavy
    from pipeline.web.server import serve as serve_workbench  # noqa: PLC0415 - heavy

    models.load_effects(effects or ())

    def notify(address: str, token: str) -> None:
        whole = f"{address}?token={token}{opened}"
        if json:
            print_json({"address": address, "token": token, "page": whole})
        elif not quiet:
            print(f"workbench  {whole}    (Ctrl-C ends it)")
        sys.stdout.flush()
        if open_browser:
            _open_browser(whole)

    if host not in LOOPBACK:
        print_note(
            f"slip: {host} can be reached from the network: whoever has the token, or reads it on its way, "
            "can read these results and change models. Leave --host out to serve this machine only."
        )
    limits = Limits(
        timeout_s=timeout,
        memory_bytes=measure_memory() // 2 if asked.memory is None else asked.limit_bytes,
    )
    opened = ""
    # A folder that is not there yet is filled by dropped logs.
    is_new = run is not None and not (
        Path(run).exists() or run.endswith(SUFFIXES) or store.Store(results).runs()
    )
    if run is not None and (Path(run).is_dir() or is_new):
        results = Path(run)
    elif run is not None:
        opened = f"#{urlencode({'a': store.find_run(run, store.Store(results)).run})}"
    serve_workbench(results, host=host, port=port, notify=notify, limits=limits, diagnosis=diagnosis)
    return CLEAN


def _open_browser(address: str) -> None:
    """Open a secret address, which must not be a command-line argument: all users can read these."""
    import webbrowser  # noqa: PLC0415 - likewise

    with tempfile.NamedTemporaryFile("w", prefix="slip-", suffix=".html", delete=False) as file:
        file.write(f'<meta http-equiv="refresh" content="0; url={address}">')
    atexit.register(Path(file.name).unlink, missing_ok=True)
    webbrowser.open(Path(file.name).as_uri())


_PYTHON = (3, 11)
_LEAST_FREE_BYTES = 3_000_000_000
"""Smallest free space for a season of logs [bytes]: four minutes of the samples produce 2.2 MB of tables
(`du` of their runs), so 100 hours need 3 GB."""
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_EXTRA = re.compile(r"extra == ['\"](\w+)['\"]")
_NOT_FOR_USERS = {"all", "build", "dev", "docs"}
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\[[^\]]*\])?>=([\d.]+)")


@dataclass(frozen=True)
class MachineCheck:
    """Result of one check.

    Attributes:
        name: what was looked at.
        state: `optional` where only something that few need is missing.
        text: what is there.
        hint: what to do; empty where nothing is to be done.
    """

    name: str
    state: Literal["ok", "optional", "problem"]
    text: str
    hint: str = ""


def doctor(  # noqa: D417 - the results folder documents itself
    results: Results = Path("results"), *, json: bool = False, quiet: bool = False
) -> int:
    """Check the installation, the disk and the folder of results.

    Looks at Python, packages, compiled loops, Chromium, free space, permissions, locale and time zone.

    Args:
        json: print one JSON object.
        quiet: print nothing; the exit code is 1 where there is a problem.
    """
    checks = list(_look(results))
    is_well = all(check.state != "problem" for check in checks)
    content = {"ok": is_well, "checks": [asdict(check) for check in checks]}
    print_result(content, lambda: map(_format_check, checks), json=json, quiet=quiet)
    return CLEAN if is_well else FAILED


def _format_check(check: MachineCheck) -> str:
    return f"{check.state:<10}{check.name:<16}{'. '.join(filter(None, (check.text, check.hint)))}"


def _look(results: Path) -> Iterator[MachineCheck]:
    yield _judge(
        "Python",
        f"{sys.version.split()[0]}, {sys.executable}",
        "" if sys.version_info >= _PYTHON else "Install slip with Python 3.11 or newer",
    )
    yield _look_at_packages()
    yield _look_at_extras()
    yield _look_at_loops()
    path = next(filter(None, map(shutil.which, _BROWSERS)), None)
    lacking = "not found; reports and figures do without it"
    hint = "" if path else "For pictures of pages and their tests: make browser"
    yield MachineCheck("Chromium", "ok" if path else "optional", path or lacking, hint)
    # A missing folder is created in its nearest existing parent.
    parent = next(folder for folder in (results.absolute(), *results.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(parent).free
    hint = "" if free >= _LEAST_FREE_BYTES else "Free some, or name another disk with --results"
    yield _judge("disk", f"{free / 1e9:.1f} GB free at {parent}", hint)
    yield _look_at_permission(parent)
    names, screen = sys.getfilesystemencoding(), sys.stdout.encoding
    hint = "" if {names.lower(), screen.lower()} == {"utf-8"} else "Set LC_ALL=C.UTF-8, or PYTHONUTF8=1"
    yield _judge("locale", f"file names in {names}, screen in {screen}", hint)
    yield _look_at_clock()


def _judge(name: str, text: str, hint: str) -> MachineCheck:
    return MachineCheck(name, "problem" if hint else "ok", text, hint)


def _look_at_packages() -> MachineCheck:
    needed = [
        match.groups()
        for text in metadata.requires(PACKAGE) or ()
        if "extra ==" not in text and (match := _REQUIREMENT.match(text))
    ]
    wrong = []
    for name, least in needed:
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            wrong.append(f"{name} is missing")
            continue
        if _read_numbers(version) < _read_numbers(least):
            wrong.append(f"{name} is {version}, older than {least}")
    what = ": ".join(filter(None, (f"slip {read_version()}, {len(needed)} packages", ", ".join(wrong))))
    return _judge("packages", what, "Install slip again, as its handbook says" if wrong else "")


def _look_at_extras() -> MachineCheck:
    lacking: dict[str, str] = {}
    for text in metadata.requires(PACKAGE) or ():
        extra, name = _EXTRA.search(text), _REQUIREMENT.match(text)
        if extra is None or name is None or extra[1] in _NOT_FOR_USERS:
            continue
        try:
            metadata.version(name[1])
        except metadata.PackageNotFoundError:
            lacking.setdefault(extra[1], name[1])
    if not lacking:
        return MachineCheck("extras", "ok", "all are installed")
    what = f"not installed: {', '.join(f'{extra} ({name})' for extra, name in sorted(lacking.items()))}"
    return MachineCheck("extras", "optional", what, f"For one of them: {name_install(min(lacking))}")


def _read_numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version.partition("+")[0])]


def compile_every_loop() -> int:
    """Compile the loops of all files; the number of loops compiled."""
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        if "\n@compiled" in path.read_text(encoding="utf-8"):
            importlib.import_module(".".join(("pipeline", *path.relative_to(root).with_suffix("").parts)))
    return core.compile_loops()


def _look_at_loops() -> MachineCheck:
    name = "compiled loops"
    count = compile_every_loop()
    caches = core.list_caches()
    if find_spec("numba") is None:
        hint = f"For diagnoses: {name_install()}"
        return MachineCheck(name, "optional", "Numba is not installed; slip tables do without it", hint)
    if not caches:
        what = f"{count} loops run as Python, 100 times slower"
        return MachineCheck(name, "problem", what, "Unset NUMBA_DISABLE_JIT")
    if None in caches:
        where = "beside the installation or in the user's cache"
        hint = "Set NUMBA_CACHE_DIR to a folder that you may write to"
        return MachineCheck(
            name, "problem", f"every process compiles {count} loops: none can be kept {where}", hint
        )
    return MachineCheck(
        name, "ok", f"{count} kept in {os.path.commonpath([str(folder) for folder in caches])}"
    )


def _look_at_permission(folder: Path) -> MachineCheck:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        hint = "Give your user the right to write there, or name another folder with --results"
        return MachineCheck("permission", "problem", f"{folder} cannot be written to: {error.strerror}", hint)
    return MachineCheck("permission", "ok", f"{folder} can be written to")


def _look_at_clock() -> MachineCheck:
    from zoneinfo import ZoneInfo  # noqa: PLC0415 - only here

    named = os.environ.get("TZ", "").removeprefix(":")
    zone = time.strftime("%Z, UTC%z")
    if named:
        try:
            ZoneInfo(named)
        except (OSError, ValueError, LookupError):
            hint = "Set TZ to a name such as Europe/Berlin, or unset it"
            return MachineCheck(
                "time zone", "problem", f"TZ={named} is not known, times are shown in UTC", hint
            )
    return MachineCheck("time zone", "ok", f"{zone}; results are in UTC")
