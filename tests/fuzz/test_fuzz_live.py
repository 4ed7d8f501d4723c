"""A short run of the fuzz target of live servers, and that it notices what it looks for."""

from pathlib import Path

import pytest
from fuzz_live import PATCHES, prepare, run_case
from live_servers import Played

from pipeline.live import receiver as live_receiver
from pipeline.live.receiver import LiveReceiver
from pipeline.live.watch import Watch


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Played]:
    return prepare(tmp_path_factory.mktemp("source"))


@pytest.fixture(autouse=True)
def _quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in PATCHES.items():
        monkeypatch.setattr(live_receiver, name, value)


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_an_odd_server_costs_no_message_and_breaks_no_look(
    messages: list[Played], tmp_path: Path, seed: int
) -> None:
    case = run_case(messages, seed, tmp_path)
    assert case.find is None
    assert case.sent > 1000
    assert sum(case.faults.values()) > 0


def test_a_lost_message_and_a_broken_look_are_finds(
    messages: list[Played], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Watch, "_read_end", lambda _: 1 // 0)
    case = run_case(messages[:300], 3, tmp_path)
    assert case.find is not None
    assert "ZeroDivisionError" in case.find.what
    monkeypatch.setattr(LiveReceiver, "_find_time", lambda *_: 1 // 0)
    (tmp_path / "second").mkdir()
    case = run_case(messages[:300], 3, tmp_path / "second")
    assert case.find is not None
    assert "the receiver broke" in case.find.what
