"""A season in which anything may stand: what becomes of each kind of entry, and of the log beside it.

    python tests/batch/damage_season.py

Every kind of entry is put beside one good log; the batch must do the good one, name the bad one, and end.
"""

import contextlib
import io
import json
import os
import shutil
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

FUTURE_S = 10 * 365 * 86400.0
NO_TEXT = os.fsdecode(b"caf\xe9")
_SCANDIR = os.scandir


@dataclass(frozen=True)
class Kind:
    """An entry of a season.

    Attributes:
        make: puts it into a folder, given a whole log that is not the good one: the same content counts once.
        state: of its line; empty where it gets none.
        words: what its line says.
        code: exit code of the batch.
    """

    make: Callable[[Path, Path], object]
    state: str = ""
    words: str = ""
    code: int = 0


def cut(log: Path, place: Path) -> None:
    content = log.read_bytes()
    place.write_bytes(content[: len(content) // 2])


def cut_in_future(folder: Path, log: Path) -> None:
    cut(log, folder / "x.mcap")
    set_future(folder / "x.mcap")


def whole_in_future(folder: Path, log: Path) -> None:
    copy(log, folder / "x.mcap")
    set_future(folder / "x.mcap")


def set_future(path: Path) -> None:
    os.utime(path, (time.time() + FUTURE_S,) * 2)


def copy(log: Path, place: Path) -> None:
    """The whole log under another name."""
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(log.read_bytes())


def split_with_pipe(folder: Path, log: Path) -> None:
    copy(log, folder / "bag" / "bag_0.mcap")
    os.mkfifo(folder / "bag" / "bag_1.mcap")
    (folder / "bag" / "metadata.yaml").write_text("relative_file_paths:\n  - bag_0.mcap\n  - bag_1.mcap\n")


def make_socket(folder: Path, log: Path) -> None:
    del log
    with socket.socket(socket.AF_UNIX) as place, contextlib.chdir(folder):
        place.bind("x.mcap")


def link_around(folder: Path, log: Path) -> None:
    del log
    for name, target in (("one", "two"), ("two", "one")):
        (folder / name).mkdir()
        (folder / name / "other").symlink_to(folder / target)
        (folder / name / "top").symlink_to(folder)


KINDS: dict[str, Kind] = {
    "a link to the folder above": Kind(lambda folder, _: (folder / "up").symlink_to(".")),
    "folders that link to each other": Kind(link_around),
    "a link to itself": Kind(
        lambda folder, _: (folder / "x.mcap").symlink_to("x.mcap"), "skipped", "itself", 3
    ),
    "a link to nothing": Kind(
        lambda folder, _: (folder / "x.mcap").symlink_to("gone"), "skipped", "nothing", 3
    ),
    "a link to a folder that is gone": Kind(
        lambda folder, _: (folder / "old").symlink_to("/gone/folder"), "skipped", "nothing", 3
    ),
    "a pipe": Kind(lambda folder, _: os.mkfifo(folder / "x.mcap"), "skipped", "a pipe", 3),
    "a link to a device": Kind(
        lambda folder, _: (folder / "x.mcap").symlink_to("/dev/zero"), "skipped", "a device", 3
    ),
    "a socket": Kind(make_socket, "skipped", "a socket", 3),
    "a pipe that nobody calls a log": Kind(lambda folder, _: os.mkfifo(folder / "pipe")),
    "a split recording with a pipe in it": Kind(split_with_pipe, "lossy skipped", "a pipe", 3),
    "a folder that may not be read": Kind(
        lambda folder, _: (folder / "forbidden").mkdir(), "skipped", "Permission", 3
    ),
    "a mount that does not answer": Kind(
        lambda folder, _: (folder / "dead").mkdir(), "skipped", "not answer", 3
    ),
    "a folder called x.mcap": Kind(lambda folder, _: (folder / "x.mcap").mkdir()),
    "a name that is not UTF-8": Kind(lambda folder, log: copy(log, folder / f"{NO_TEXT}.mcap"), "done", ""),
    "a folder whose name is not UTF-8": Kind(
        lambda folder, log: copy(log, folder / NO_TEXT / "x.mcap"), "done", ""
    ),
    "a log of the future": Kind(whole_in_future, "done", ""),
    "a cut log of the future": Kind(cut_in_future, "lossy", "", 3),
    "a cut log": Kind(lambda folder, log: cut(log, folder / "x.mcap"), "growing", "still being written"),
    "an empty file": Kind(lambda folder, _: (folder / "x.mcap").touch(), "growing", "still being written"),
    "a text": Kind(
        lambda folder, _: (folder / "x.mcap").write_bytes(b"no log" * 9 + b"\x89MCAP0\r\n"),
        "failed",
        "MCAP",
        1,
    ),
}
"""Files that are not whole have just been written: a batch with --settle takes them for growing."""


@contextlib.contextmanager
def odd_folders() -> Iterator[None]:
    """Folders called ``forbidden`` cannot be listed, those called ``dead`` hang for ever."""
    never = threading.Event()

    def scan(place: str | Path) -> object:
        name = Path(place).name
        if name == "forbidden":
            raise PermissionError(13, "Permission denied", str(place))
        if name == "dead":
            never.wait()
        return _SCANDIR(place)

    with mock.patch("os.scandir", scan):
        yield
    never.set()


def run_batch(logs: Path, out: Path) -> tuple[int, dict[str, object], str]:
    """Exit code, JSON and errors of a batch."""
    from pipeline.batch import recordings  # noqa: PLC0415 - the repository is put on the path first
    from pipeline.cli import main as slip  # noqa: PLC0415

    arguments = [
        "batch",
        str(logs),
        "--results",
        str(out),
        "--executor",
        "inline",
        "--settle",
        "600",
        "--json",
    ]
    said, errors = io.StringIO(), io.StringIO()
    defaults = recordings.find_recordings.__kwdefaults__
    with (
        odd_folders(),
        mock.patch.dict(defaults, {"patience_s": 0.3}),
        mock.patch.object(recordings, "_LONGEST_LOOK_S", 1.0),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(errors),
    ):
        try:
            slip(arguments)
        except SystemExit as end:
            return int(end.code or 0), json.loads(said.getvalue()), errors.getvalue()
    raise AssertionError("it did not end")


def notify(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> int:
    """Print the table; 1 where something is not as promised."""
    from pipeline.simulate import simulate_case  # noqa: PLC0415

    wrong = 0
    notify(f"{'beside a good log stands':<40}{'good log':<10}{'entry':<10}{'exit':<6}{'[s]':<6}said")
    with tempfile.TemporaryDirectory() as temporary:
        top = Path(temporary)
        for seed, log in enumerate(("good.mcap", "other.mcap")):
            simulate_case("husky_tile", out=top / log, duration_s=12.0, seed=seed)
        for name, kind in KINDS.items():
            folder = top / "season"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.rmtree(top / "out", ignore_errors=True)
            folder.mkdir()
            shutil.copy2(top / "good.mcap", folder / "good.mcap")
            os.utime(folder / "good.mcap", (1e9, 1e9))
            kind.make(folder, top / "other.mcap")
            started = time.monotonic()
            code, found, _ = run_batch(folder, top / "out")
            lines = {line["path"].rpartition("/")[2]: line for line in found["logs"]}  # type: ignore[attr-defined]
            good = lines.pop("good.mcap")["state"]
            state = " ".join(line["state"] for line in lines.values())
            said = " ".join(line["reason"] for line in lines.values())
            fine = (good, state, code) == ("done", kind.state, kind.code) and kind.words in said
            wrong += not fine
            mark = "" if fine else f"   <- {kind.state or 'nothing'} and exit {kind.code} were promised"
            seconds = time.monotonic() - started
            notify(f"{name:<40}{good:<10}{state or '-':<10}{code:<6}{seconds:<6.1f}{said[:70]}{mark}")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
