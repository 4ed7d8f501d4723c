"""What damage did to a log is told as damage, not as something the vehicle or its clocks did."""

import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from stage_logs import FIELD, record, take

from pipeline.core import SlipError
from pipeline.logs import Loss, open_log, read_topics
from pipeline.logs.reader import Wanted
from pipeline.logs.writer import LogWriter
from pipeline.recording import blame_damage
from pipeline.recording.topic_values import find_spans_of_state, forget_states
from pipeline.simulate import Recording
from pipeline.sources import IntervalSection

CHUNK, DATA_END = 6, 15
ABSURD = (np.inf, -np.inf, np.nan, 1e308, -1e308, 5e-324, 1e200)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A log of about thirty chunks."""
    folder = tmp_path_factory.mktemp("whole")
    record(replace(FIELD, recording=Recording(hand_driven_s=10.0)), folder / "long.mcap")
    index = open_log(folder / "long.mcap")
    data = read_topics(index, [Wanted(topic) for topic in index.topics()])
    with LogWriter(folder / "log.mcap", chunk_size=60_000) as log:
        for name, values in index.metadata.items():
            log.metadata(name, values)
        for columns in data.topics:
            fields = {
                name: column for name, column in columns.fields.items() if not name.startswith("header.stamp")
            }
            log.write_columns(
                columns.topic, columns.type_name, columns.log_time, fields, header_time=columns.header_time
            )
    return (folder / "log.mcap").read_bytes()


def record_places(content: bytes, opcode: int) -> list[tuple[int, int]]:
    starts = [8]
    while starts[-1] < len(content) - 8:
        starts.append(starts[-1] + 9 + struct.unpack_from("<Q", content, starts[-1] + 1)[0])
    return [(a, b) for a, b in pairwise(starts) if content[a] == opcode]


@pytest.mark.parametrize("where", ["behind", "between"])
def test_doubled_chunks_change_nothing_and_no_clock_is_put_back(
    tmp_path: Path, whole: bytes, where: str
) -> None:
    chunks = record_places(whole, CHUNK)
    copied = whole[chunks[5][0] : chunks[12][0]]
    place = record_places(whole, DATA_END)[0][0] if where == "behind" else chunks[20][0]
    path, doubled = tmp_path / "log.mcap", tmp_path / "doubled.mcap"
    path.write_bytes(whole)
    doubled.write_bytes(whole[:place] + copied + whole[place:])
    expected, found = take(path), take(doubled)
    assert "clock_jump" not in found.ids()
    assert found.ids() == expected.ids()
    for name, table in expected.extracted.tables.items():
        assert found.extracted.tables[name].equals(table), name


def test_what_damage_took_is_not_said_to_be_the_logs_silence(tmp_path: Path, whole: bytes) -> None:
    content = bytearray(whole)
    for start, end in record_places(whole, CHUNK):
        content[(start + end) // 2] ^= 0xFF
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(SlipError) as caught:
        take(path, {"interval": [{"topic": "/drive/calib_state", "equals": "calib"}]})
    assert "the log is damaged: chunk of" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_state_that_damage_took_is_not_said_never_to_be_said(tmp_path: Path, whole: bytes) -> None:
    content = bytearray(whole)
    start, end = record_places(whole, CHUNK)[9]
    content[(start + end) // 2] ^= 0xFF
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    state = {"topic": "/drive/calib_state", "equals": "gone"}
    with pytest.raises(SlipError, match="what can be read of /drive/calib_state does not say") as caught:
        take(path, {"interval": [state]})
    assert "the log is damaged" in str(caught.value)
    assert "never says" not in str(caught.value)


@pytest.mark.parametrize(
    ("losses", "spans"),
    [
        ([], [(1.0, np.inf)]),
        ([(4.0, 6.0)], [(1.0, 4.0), (9.0, np.inf)]),
        ([(4.0, None)], [(1.0, 4.0), (9.0, np.inf)]),
        ([(4.0, 8.5)], [(1.0, 4.0), (9.0, np.inf)]),
        ([(0.2, 0.5), (4.0, 6.0), (9.5, 12.0)], [(1.0, 4.0), (9.0, 9.5)]),
        # What concerns other messages of the whole log is no hole.
        ([(-1.0, 20.0), (None, None)], [(1.0, 20.0)]),
    ],
)
def test_a_state_is_unknown_from_a_loss_until_its_next_message(
    losses: list[tuple[float | None, float | None]], spans: list[tuple[float, float]]
) -> None:
    def stamp(time: float | None) -> int | None:
        return None if time is None else 10**18 + round(time * 1e9)

    holes = [Loss("chunk_crc", "lost", start_ns=stamp(first), end_ns=stamp(last)) for first, last in losses]
    times = np.array([0.0, 1.0, 9.0])
    recorded = np.array([stamp(time) for time in times.tolist()])
    known = forget_states(times, ["idle", "calib", "calib"], recorded, holes)
    found = find_spans_of_state(*known, IntervalSection(topic="/state", equals="calib"))
    assert np.array(found).ravel() == pytest.approx(np.array(spans).ravel(), abs=1e-6)


def test_further_losses_are_counted_in_words() -> None:
    losses = [Loss("damaged_record", "bytes 5 to 9 hold no record", bytes=4)] * 3
    assert blame_damage(losses[:1]) == " (the log is damaged: bytes 5 to 9 hold no record)"
    assert blame_damage(losses[:2]).endswith("hold no record; 1 further loss)")
    assert blame_damage(losses).endswith("hold no record; 2 further losses)")


def test_a_file_that_ends_early_is_not_called_damaged() -> None:
    """`slip watch` said so of every recording that was being written."""
    cut = Loss("truncated", "its last 1350 bytes are no complete record", bytes=1350)
    assert blame_damage([cut]) == (
        " (the file ends early, or is still being written: its last 1350 bytes are no complete record)"
    )
    broken = Loss("damaged_record", "bytes 5 to 9 hold no record", bytes=4)
    assert blame_damage([cut, broken]).startswith(" (the log is damaged: ")


@pytest.mark.parametrize("step", [3, 101])
def test_absurd_numbers_are_said_and_warn_nobody(tmp_path: Path, whole: bytes, step: int) -> None:
    """Tests turn every warning of numpy into an error."""
    path, hostile = tmp_path / "log.mcap", tmp_path / "hostile.mcap"
    path.write_bytes(whole)
    index = open_log(path)
    with LogWriter(hostile) as log:
        for name, values in index.metadata.items():
            log.metadata(name, values)
        for columns in read_topics(index, [Wanted(topic) for topic in index.topics()]).topics:
            fields = {}
            for name, column in columns.fields.items():
                if isinstance(column, np.ndarray) and column.dtype.kind == "f":
                    column = column.copy()  # noqa: PLW2901
                    column[::step] = np.resize(ABSURD, column[::step].shape)
                if not name.startswith("header.stamp"):
                    fields[name] = column
            log.write_columns(
                columns.topic, columns.type_name, columns.log_time, fields, header_time=columns.header_time
            )
    found = take(hostile)
    assert "absurd_values" in found.ids()
    told = [finding for finding in found.findings if finding.id == "absurd_values"]
    assert {finding.where for finding in told} >= {"/mapping/icp_odom"}
    assert np.isfinite(found.slip("command")["g_x"].drop_nulls().to_numpy()).all()
