"""A diagnosis must not change with where the map lies, or with when recording began."""

import math
from functools import cache
from pathlib import Path

import pytest
from inject import STANDING, Answer, ask, judge
from injections import Injection, list_injections
from measuring import RECORDINGS

pytestmark = pytest.mark.long

_SAMPLES = Path(__file__).parents[2] / "data_samples"
_BY_NAME = {injection.name: injection for injection in list_injections()}
_NOTHING = Injection("nothing", lambda tables, _: tables)
_EXACT = ("map turned and moved", "recorder started 12.8 s earlier")
_NOISY = ("poses at 5 Hz", "1 cm of noise")
_DRIVEN = [log.stem for log in sorted(RECORDINGS.glob("*.mcap")) if not log.stem.startswith(STANDING)]
# A fit ends where its loss no longer falls by a millionth: its numbers are as exact as that.
_ROUNDING = 0.02


@cache
def _ask_as_recorded(log: Path) -> Answer:
    return ask(log, _NOTHING, both=True)


def _assert_same(before: Answer, after: Answer) -> None:
    assert after.names == before.names
    assert after.undecided == before.undecided
    assert after.unobservable == before.unobservable
    for label, (value, half) in before.numbers.items():
        # A number that the log leaves open has no width.
        room = 0.0 if math.isnan(half) else _ROUNDING * half
        assert after.numbers[label][0] == pytest.approx(value, rel=1e-4, abs=room)


def test_neither_the_map_nor_the_recorder_s_start_changes_an_answer() -> None:
    turned, earlier = (_BY_NAME[name].change for name in _EXACT)
    both = Injection("both", lambda tables, drive: earlier(turned(tables, drive), drive))
    log = _SAMPLES / "warthog_ice.mcap"
    _assert_same(ask(log, _NOTHING, both=False), ask(log, both, both=False))


@pytest.mark.skipif(not _DRIVEN, reason="the recordings are not there")
@pytest.mark.parametrize("change", _EXACT)
@pytest.mark.parametrize("name", _DRIVEN)
def test_recordings_keep_their_answer_wherever_the_map_lies(name: str, change: str) -> None:
    log = RECORDINGS / f"{name}.mcap"
    _assert_same(_ask_as_recorded(log), ask(log, _BY_NAME[change], both=True))


@pytest.mark.skipif(not _DRIVEN, reason="the recordings are not there")
def test_fewer_or_noisier_poses_give_hardly_any_other_name() -> None:
    """Names may be lost or become undecided; of those that are given, three in a hundred may be others."""
    named, others = 0, list[str]()
    for name in _DRIVEN:
        log = RECORDINGS / f"{name}.mcap"
        before = _ask_as_recorded(log)
        for change in _NOISY:
            after = ask(log, _BY_NAME[change], both=True)
            named += len(after.names)
            others += [f"{name}, {change}: {one}" for one in after.names - before.names - {*before.undecided}]
    assert len(others) <= 0.03 * named, others


@pytest.mark.skipif(not _DRIVEN, reason="the recordings are not there")
def test_a_break_in_a_recording_is_told_where_it_is() -> None:
    """Where it stands for the track on the ladder's lower rungs, the last one has it in its place again."""
    (log,) = (RECORDINGS / f"{one}.mcap" for one in _DRIVEN if "grass_2024_7" in one)
    change = _BY_NAME["gains .8 and .7 half-way"]
    after = ask(log, change, both=False)
    assert judge(change, ask(log, _NOTHING, both=False), after)[0] == "recovered", after
    assert after.numbers["terrain_change.at_s"][1] < 60.0
