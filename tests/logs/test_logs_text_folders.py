"""Folders of text tables, read as the recordings that they stand for."""

import shutil
import time
from pathlib import Path

import pytest
from fomo_session import START_US, write_session

from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogData, LogError, Wanted, hash_log, open_log, other_formats, read_topics

VELOCITY = "/warthog/platform/motor/left/status/velocity"


def read(folder: Path, topic: str = VELOCITY) -> LogData:
    return read_topics(folder, [Wanted(topic)])


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write_session(tmp_path / "red_2025-10-14-11-41", duration_s=5.0)


def test_a_row_is_a_message_at_its_time(session: Path) -> None:
    table = session / "metadata" / "velocity_left.csv"
    table.write_text("timestamp,value\n1760456485757616,0\n1760456486017763,-1.25\n")
    (topic,) = read(session).topics
    assert topic.log_time.tolist() == [1760456485757616000, 1760456486017763000]
    assert topic.fields["data"].tolist() == [0.0, -1.25]  # type: ignore[union-attr]
    assert topic.header_time is None


def test_poses_in_the_format_of_tum_are_poses(session: Path) -> None:
    text = "# t x y z qx qy qz qw\n1760456485.700000000 255855.356510987 5242729.390226772 643.6 0 0 0 1\n"
    (session / "gt.txt").write_text(text)
    (topic,) = read(session, "/ppk_gnss/pose").topics
    assert topic.type_name == "geometry_msgs/msg/PoseStamped"
    assert topic.header_time is not None
    assert topic.header_time.tolist() == topic.log_time.tolist() == [1760456485700000000]
    assert topic.fields["pose.position.y"].tolist() == [5242729.390226772]  # type: ignore[union-attr]


def test_what_cannot_be_read_is_left_out_and_counted(session: Path) -> None:
    table = session / "metadata" / "velocity_left.csv"
    table.write_text("timestamp,value\n1760456485757616,0\nx,1\n1760456486000000\nnan,2\n1760456486500000,3")
    index = open_log(session)
    told = {loss.kind: loss.text for loss in index.losses}
    assert told["damaged_record"] == "3 lines of metadata/velocity_left.csv cannot be read"
    assert "has no end and is left out" in told["truncated"]
    assert read(session).topics[0].fields["data"].tolist() == [0.0]  # type: ignore[union-attr]


def test_the_folder_that_one_stands_in_is_read(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(session)
    assert read(Path()).topics[0].log_time.size == read(session).topics[0].log_time.size > 0


def test_a_table_without_its_columns_is_said(session: Path) -> None:
    (session / "metadata" / "velocity_left.csv").write_text("time,rpm\n1,2\n")
    (loss,) = open_log(session).losses
    assert "has no column timestamp, value" in loss.text


def test_a_table_beyond_the_limit_is_refused(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(other_formats, "_MAX_BYTES", 20)
    with pytest.raises(LogError, match="no more than"):
        open_log(session)


def test_a_table_of_nothing_but_line_ends_is_refused_before_it_is_cut_into_lines(session: Path) -> None:
    table = session / "metadata" / "velocity_left.csv"
    table.write_bytes(b"timestamp,value\n" + b"\n" * 300_000_000)
    begin = time.process_time()
    with pytest.raises(LogError, match="300,000,001 lines, and no more than 12,000,000 are read") as caught:
        open_log(session)
    assert time.process_time() - begin < 10.0
    assert caught.value.code == "too_large"
    assert str(table) in caught.value.where


def test_other_folders_of_tables_are_no_recordings(session: Path) -> None:
    (session / "gt.txt").unlink()
    with pytest.raises(LogError) as caught:
        open_log(session)
    assert caught.value.code == "not_a_recording"


def test_the_hash_is_of_all_tables(session: Path) -> None:
    before = hash_log(session)
    with (session / "metadata" / "current_right.csv").open("a") as table:
        table.write(f"{START_US},1\n")
    assert hash_log(session) != before


def test_a_batch_finds_sessions_in_the_folders_of_a_data_set(session: Path) -> None:
    shutil.copytree(session, session.parent / "blue_2025-10-14-13-00")
    found = find_recordings([str(session.parent)], settle_s=0.0)
    assert [path.name for path in found.recordings] == ["blue_2025-10-14-13-00", session.name]
