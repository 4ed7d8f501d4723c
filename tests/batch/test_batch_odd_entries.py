"""One bad entry never stops a season."""

import os
import shutil
import time
from pathlib import Path

import damage_season
import pytest
from damage_season import KINDS, NO_TEXT, cut_in_future, run_batch
from few import few
from store_samples import read_current
from verbs import ask_verb, run_slip

from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, open_log, spell_location, to_location
from pipeline.store import Store


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
    assert (code, errors) == (1, "")
    states: dict[str, list[str]] = {}
    for line in found["logs"]:  # type: ignore[attr-defined]
        inside = line["path"].removeprefix(f"{mess}/").partition("/")[0]
        states.setdefault(inside, []).append(line["state"])
    assert states.pop("good.mcap") == ["done"]
    # Logs of the same content count once, under one of them.
    expected = {str(number): kind.state for number, kind in enumerate(KINDS.values()) if kind.state}
    same = {"done": {"done", "unchanged"}, "lossy": {"lossy", "unchanged"}}
    assert states.keys() == expected.keys()
    for number, words in expected.items():
        assert len(states[number]) == len(words.split())
        for state in states[number]:
            assert any(state in same.get(word, {word}) for word in words.split()), (
                list(KINDS)[int(number)],
                state,
            )
    assert found["skipped"] == sum("skipped" in kind.state for kind in KINDS.values())


@pytest.mark.long
def test_each_alone_costs_itself_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert damage_season.main() == 0, capsys.readouterr().out


@pytest.mark.parametrize("name", few(["a pipe", "a link to a device", "a socket"], 3))
def test_nothing_but_files_is_opened(name: str, season: Path, tmp_path: Path) -> None:
    KINDS[name].make(tmp_path, season / "a.mcap")
    with pytest.raises(LogError, match=r"pipe, a socket or a device|cannot be opened"):
        open_log(tmp_path / "x.mcap")
    code, found, _ = run_batch(tmp_path / "x.mcap", tmp_path / "out")
    assert (code, found["skipped"]) == (3, 1)


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
    assert (code, [line["path"] for line in found["logs"]]) == (0, [str(odd)])  # type: ignore[attr-defined]
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
