"""One bad entry never stops a season."""

import contextlib
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from few import few
from store_samples import read_current
from verbs import ask_verb, run_slip

from pipeline.batch import recordings
from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, open_log, spell_location, to_location
from pipeline.store import Store

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
        lambda folder, _: (folder / "x.mcap").symlink_to("x.mcap"), "left_out", "itself", 3
    ),
    "a link to nothing": Kind(
        lambda folder, _: (folder / "x.mcap").symlink_to("gone"), "left_out", "nothing", 3
    ),
    "a link to a folder that is gone": Kind(
        lambda folder, _: (folder / "old").symlink_to("/gone/folder"), "left_out", "nothing", 3
    ),
    "a pipe": Kind(lambda folder, _: os.mkfifo(folder / "x.mcap"), "left_out", "a pipe", 3),
    "a link to a device": Kind(
        lambda folder, _: (folder / "x.mcap").symlink_to("/dev/zero"), "left_out", "a device", 3
    ),
    "a socket": Kind(make_socket, "left_out", "a socket", 3),
    "a pipe that nobody calls a log": Kind(lambda folder, _: os.mkfifo(folder / "pipe")),
    "a split recording with a pipe in it": Kind(split_with_pipe, "lossy left_out", "a pipe", 3),
    "a folder that may not be read": Kind(
        lambda folder, _: (folder / "forbidden").mkdir(), "left_out", "Permission", 3
    ),
    "a mount that does not answer": Kind(
        lambda folder, _: (folder / "dead").mkdir(), "left_out", "not answer", 3
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


def run_batch(logs: Path, out: Path) -> tuple[int, dict[str, Any], str]:
    """Exit code, JSON and errors of a batch."""
    words = ("batch", logs, "--results", out, "--executor", "inline", "--settle", "600", "--json")
    with (
        odd_folders(),
        mock.patch.dict(recordings.find_recordings.__kwdefaults__, {"patience_s": 0.3}),
        mock.patch.object(recordings, "_LONGEST_LOOK_S", 1.0),
    ):
        code, said, errors = run_slip(*words)
    return code, json.loads(said), errors


@pytest.fixture
def mess(season: Path, tmp_path: Path) -> Path:
    """A folder for every kind of entry, beside one good log."""
    top = tmp_path / "mess"
    for number, kind in enumerate(KINDS.values()):
        folder = top / str(number)
        folder.mkdir(parents=True)
        kind.make(folder, season / "a.mcap")
    shutil.copy(season / "b.mcap", top / "good.mcap")
    os.utime(top / "good.mcap", (1e9, 1e9))
    return top


def test_everything_at_once_costs_itself_and_nothing_else(mess: Path, tmp_path: Path) -> None:
    started = time.monotonic()
    code, found, errors = run_batch(mess, tmp_path / "out")
    assert time.monotonic() - started < 30.0
    assert (code, errors.count("\n")) == (1, 1), "one line says what is wrong"
    states: dict[str, list[str]] = {}
    for line in found["logs"]:
        inside = line["path"].removeprefix(f"{mess}/").partition("/")[0]
        states.setdefault(inside, []).append(line["state"])
    assert states.pop("good.mcap") == ["done"]
    # Logs of the same content count once, under one of them.
    expected = {str(number): kind.state for number, kind in enumerate(KINDS.values()) if kind.state}
    assert states.keys() == expected.keys()
    for number, words in expected.items():
        assert len(states[number]) == len(words.split())
        for state in states[number]:
            assert any(state in {word, "copy"} for word in words.split()), (
                list(KINDS)[int(number)],
                state,
            )
    assert found["left_out"] == sum("left_out" in kind.state for kind in KINDS.values())


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_each_alone_costs_itself_and_nothing_else(kind: Kind, season: Path, tmp_path: Path) -> None:
    folder = tmp_path / "field"
    folder.mkdir()
    kind.make(folder, season / "b.mcap")
    shutil.copy(season / "a.mcap", folder / "good.mcap")
    os.utime(folder / "good.mcap", (1e9, 1e9))
    code, found, _ = run_batch(folder, tmp_path / "out")
    lines = {Path(line["path"]).name: line for line in found["logs"]}
    assert (lines.pop("good.mcap")["state"], code) == ("done", kind.code)
    assert " ".join(line["state"] for line in lines.values()) == kind.state
    assert kind.words in " ".join(line["reason"] for line in lines.values())


@pytest.mark.parametrize("name", few(["a pipe", "a link to a device", "a socket"], 3))
def test_nothing_but_files_is_opened(name: str, season: Path, tmp_path: Path) -> None:
    KINDS[name].make(tmp_path, season / "a.mcap")
    with pytest.raises(LogError, match=r"pipe, a socket or a device|cannot be opened"):
        open_log(tmp_path / "x.mcap")
    code, found, _ = run_batch(tmp_path / "x.mcap", tmp_path / "out")
    assert (code, found["left_out"]) == (3, 1)


def test_a_log_of_the_future_is_growing_while_it_grows(season: Path, tmp_path: Path) -> None:
    cut_in_future(tmp_path, season / "a.mcap")
    log = tmp_path / "x.mcap"
    ahead = log.stat().st_mtime

    class Growing:
        """A clock of which every wait makes the log longer."""

        time = staticmethod(time.time)

        @staticmethod
        def sleep(seconds: float) -> None:
            assert 0.0 < seconds <= 5.0
            log.write_bytes(log.read_bytes() + b"x")
            os.utime(log, (ahead, ahead))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.batch.recordings.time", Growing)
        assert find_recordings([str(log)], settle_s=120.0).growing == (log,)
        Growing.sleep = staticmethod(lambda _seconds: None)  # type: ignore[method-assign, assignment]
        assert find_recordings([str(log)], settle_s=120.0).recordings == (log,)


@pytest.fixture
def odd(season: Path, tmp_path: Path) -> Path:
    """A log whose folder and name are no UTF-8."""
    folder = tmp_path / NO_TEXT
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes no such names")
    return Path(shutil.copy(season / "a.mcap", folder / f"{NO_TEXT}.mcap"))


def test_a_name_that_is_no_text_passes_through_everything(odd: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    code, found, _ = run_batch(odd.parent, out)
    assert (code, [line["path"] for line in found["logs"]]) == (0, [str(odd)])
    run = r"caf\xe9/caf\xe9"
    rows = Store(out).query(
        "SELECT r.run, r.log, count(*) AS n FROM runs r JOIN slip s ON r.run = s.run GROUP BY ALL"
    )
    assert rows["run"].to_list() == [run]
    assert to_location(rows["log"][0]) == odd
    assert read_current(Store(out), run, "slip")["run"].unique().to_list() == [run]

    # It is known again: by the ledger, and without it by the results.
    assert run_batch(odd.parent, out)[1]["unchanged"] == 1
    shutil.rmtree(out / "batch")
    assert run_batch(odd.parent, out)[1]["unchanged"] == 1

    for arguments in (
        ["results", "status"],
        ["results", "status", "--json"],
        ["results", "query", "SELECT * FROM runs"],
        ["results", "status", run],
        ["results", "status", str(odd)],
        ["batch", str(odd)],
    ):
        code, said, told = run_slip(*arguments, "--results", out)
        assert code == 0, told
        (said + told).encode()
    assert ask_verb("inspect", odd)["path"] == str(odd)


def test_a_path_of_any_bytes_is_a_text_that_leads_back() -> None:
    path = Path(os.fsdecode(b"/logs/caf\xe9 % \xff\x01.mcap"))
    assert spell_location(path) == "file:///logs/caf%E9%20%25%20%FF%01.mcap"
    assert to_location(spell_location(path)) == path
    assert spell_location(Path("/logs/café.mcap")) == "/logs/café.mcap"
