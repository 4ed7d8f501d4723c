"""The commands of handbook and README: run as a reader would, what they print compared or renewed.

A fenced block of the language `console` holds commands, each behind `$ `, and below each what it prints on
stdout. Nothing below a command means that only its exit code counts: 0, or 3 for losses. A block of the
language `pycon` holds Python behind `>>> ` and `... `; all those of a page are one session.

    python docs/tools/blocks.py            runs all pages and says where they differ
    python docs/tools/blocks.py --write PAGE...    puts what is printed into these pages
"""

import argparse
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from pipeline.simulate import simulate_case

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "pages"
PATIENCE_S = 1800.0
LOSSY = 3

_BLOCK = re.compile(r"^```(console|pycon)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_PROMPTS = {"console": ("$ ", ()), "pycon": (">>> ", ("... ", "...\n"))}
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
_HASH = re.compile(r"\b[0-9a-f]{12,}\b")
_NEAR = 0.01
"""Share by which numbers may differ, beside one unit of the last digit shown: other versions of the libraries
that fits stand on change no more."""
_LINKED = (
    "Makefile",
    "pyproject.toml",
    "requirements.txt",
    "requirements-dev.txt",
    "benchmarks",
    "examples",
)


@dataclass(frozen=True)
class Command:
    """One command of a page and the lines shown below it.

    Attributes:
        text: what is typed.
        shown: lines below it.
        start, end: where those lines stand in the page's text.
        is_python: whether it is Python, not of the shell.
    """

    text: str
    shown: tuple[str, ...]
    start: int
    end: int
    is_python: bool = False


def list_pages() -> list[Path]:
    """The README and every page of the handbook that is written by hand."""
    return [ROOT / "README.md", *sorted(PAGES.rglob("*.md"))]


def read_commands(text: str) -> list[Command]:
    """Commands of a page in their order.

    Raises:
        ValueError: a block begins with something else than a command.
    """
    found = []
    for block in _BLOCK.finditer(text):
        place = block.start(2)
        first, more = _PROMPTS[block[1]]
        typed, start = "", place
        shown: list[str] = []
        for line in block[2].splitlines(keepends=True):
            place += len(line)
            if line.startswith(first):
                if typed:
                    found.append(Command(typed, tuple(shown), start, place - len(line), block[1] == "pycon"))
                typed, shown, start = line.removeprefix(first).rstrip(), [], place
            elif typed and not shown and line.startswith(more):
                typed, start = f"{typed}\n{line[4:].rstrip()}", place
            elif typed:
                shown.append(line.rstrip("\n"))
            else:
                raise ValueError(f"a {block[1]} block begins with {line!r}, not with a command")
        found.append(Command(typed, tuple(shown), start, place, block[1] == "pycon"))
    return found


def furnish(folder: Path) -> Path:
    """A folder as a reader has it after `make`: samples to read, and `run.mcap`, a log of one's own."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copytree(ROOT / "data_samples", folder / "data_samples")
    simulate_case("husky_tile", out=folder / "run.mcap", seed=3, duration_s=90.0)
    for name in _LINKED:
        (folder / name).symlink_to(ROOT / name)
    # Ready as it is: `make` must not install the program anew from this folder.
    (folder / ".venv").mkdir()
    for path in Path(sys.prefix).iterdir():
        if not path.name.startswith(".ready"):
            (folder / ".venv" / path.name).symlink_to(path)
    for name in (".ready", ".ready-dev"):
        (folder / ".venv" / name).touch()
    return folder


def run_command(text: str, folder: Path) -> str:
    """What a command prints on stdout.

    Raises:
        RuntimeError: it fails.
    """
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    programs = os.pathsep.join((str(Path(sys.executable).parent), kept["PATH"]))
    around = {**kept, "PATH": programs, "HOME": str(folder / ".home"), "COLUMNS": "100"}
    if text.startswith(("slip serve", "make serve")):
        return _run_server(text, folder, around)
    done = subprocess.run(  # noqa: S603 - a page of this repository
        ["bash", "-o", "pipefail", "-c", text],  # noqa: S607 - as a reader types it
        cwd=folder,
        env=around,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    if done.returncode not in (0, LOSSY):
        raise RuntimeError(f"{text}\nexit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def _run_server(text: str, folder: Path, around: dict[str, str]) -> str:
    """A server is right when it says its address; it is ended then."""
    text += ' ARGS="--port 0"' if text.startswith("make") else " --port 0"
    server = subprocess.Popen(  # noqa: S603 - a page of this repository
        ["bash", "-c", text],  # noqa: S607 - as a reader types it
        cwd=folder,
        env=around,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    with server:
        line = server.stdout.readline() if server.stdout else ""
        os.killpg(server.pid, signal.SIGTERM)
    if "?token=" not in line:
        raise RuntimeError(f"{text}\nno address: {line!r}")
    return ""


def find_difference(shown: tuple[str, ...], printed: str) -> str:
    """The first line that is printed otherwise than shown; empty without one.

    Words must be the same; numbers may differ by 1 % or in the last digit; hashes by all.
    """
    lines = [line.rstrip() for line in printed.rstrip("\n").splitlines()]
    for one, other in zip_longest(shown, lines, fillvalue=""):
        if not _is_alike(one, other):
            return f"shown:   {one}\nprinted: {other}"
    return ""


def _is_alike(one: str, other: str) -> bool:
    one, other = (" ".join(_HASH.sub("HASH", text).split()) for text in (one, other))
    if _NUMBER.sub("#", one) != _NUMBER.sub("#", other):
        return False
    pairs = zip(_NUMBER.findall(one), _NUMBER.findall(other), strict=True)
    return all(
        math.isclose(float(a), float(b), rel_tol=_NEAR, abs_tol=1.001 * max(_find_unit(a), _find_unit(b)))
        for a, b in pairs
    )


def _find_unit(number: str) -> float:
    """One unit of the last digit of a number as it is written."""
    digits, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))


_DRIVER = """
import contextlib, io, json, sys
names = {"__name__": "__main__"}
for line in sys.stdin:
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(json.loads(line) + "\\n", "<page>", "single"), names)
    print(json.dumps(printed.getvalue()), flush=True)
"""


@contextmanager
def open_session(folder: Path) -> Iterator[Callable[[Command], str]]:
    """A shell and one Python for the commands of a page, each asked for what it prints on stdout.

    Raises:
        RuntimeError: a command fails.
    """
    with subprocess.Popen(  # noqa: S603 - a page of this repository
        [sys.executable, "-c", _DRIVER],
        cwd=folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as python:

        def run(command: Command) -> str:
            if not command.is_python:
                return run_command(command.text, folder)
            print(json.dumps(command.text), file=python.stdin, flush=True)
            line = python.stdout.readline() if python.stdout else ""
            if not line:
                raise RuntimeError(f"{command.text}\nfails, see above")
            return str(json.loads(line))

        yield run


def check_page(page: Path, folder: Path) -> list[str]:
    """Run a page's commands in their order; where they differ from what is shown."""
    wrong = []
    with open_session(furnish(folder)) as run:
        for command in read_commands(page.read_text(encoding="utf-8")):
            printed = run(command)
            difference = find_difference(command.shown, printed) if command.shown else ""
            if difference:
                wrong.append(f"{page.name}: {command.text}\n{difference}")
    return wrong


def write_page(page: Path, folder: Path) -> None:
    """Run a page's commands and put what they print below those that show something."""
    text = page.read_text(encoding="utf-8")
    parts, end = [], 0
    with open_session(furnish(folder)) as run:
        for command in read_commands(text):
            printed = run(command)
            parts.append(text[end : command.start])
            if command.shown:
                lines = (line.rstrip() for line in printed.rstrip("\n").splitlines())
                parts.append("".join(f"{line}\n" for line in lines))
            end = command.end
    page.write_text("".join((*parts, text[end:])), encoding="utf-8")


def main() -> int:
    """Run pages; 1 where something is printed otherwise than shown."""
    reader = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    reader.add_argument("pages", nargs="*", type=Path)
    reader.add_argument("--write", action="store_true")
    asked = reader.parse_args()
    wrong = []
    for page in asked.pages or list_pages():
        if not read_commands(page.read_text(encoding="utf-8")):
            continue
        print(page.name, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            if asked.write:
                write_page(page, Path(folder) / "slip")
            else:
                wrong += check_page(page, Path(folder) / "slip")
    print("\n\n".join(wrong))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
