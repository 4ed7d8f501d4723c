"""Bags of ROS 1 and ROS 2 give what the same recording gives as MCAP; what is wrong with them is said."""

import hashlib
import sqlite3
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from bag_files import STORE_1, write_bag, write_db3
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_files import FLOAT, SHARED, START, Truth, value_of, write_small
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode

from pipeline.logs import (
    LogError,
    Wanted,
    bags,
    hash_log,
    is_finished,
    open_log,
    open_store,
    read_topics,
    ros1,
    to_location,
)
from pipeline.logs import chunks as inflate_module


def read_all(path: Path) -> Truth:
    index = open_log(path)
    data = read_topics(index, [Wanted(topic) for topic in index.topics()])
    assert not data.losses
    assert "no checksum" in data.unchecked
    assert sum(len(columns) for columns in data.topics) == index.message_count
    return {
        (columns.topic, time): value_of(columns.fields, row)
        for columns in data.topics
        for row, time in enumerate(columns.log_time.tolist())
    }


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE])
def test_a_folder_of_rosbag2_and_its_file_hold_what_the_mcap_holds(
    tmp_path: Path, mode: CompressionMode
) -> None:
    truth = write_small(tmp_path / "log.mcap")
    folder = write_db3(tmp_path / "run", mode=mode)
    (file,) = folder.glob("*.db3")
    for path in (folder, file):
        assert read_all(path) == truth
        assert hash_log(path) == hashlib.sha256(file.read_bytes()).hexdigest()
    bag, log = open_log(file), open_log(tmp_path / "log.mcap")
    assert (bag.start_ns, bag.end_ns, bag.topics()) == (log.start_ns, log.end_ns, log.topics())
    assert {each.type_name for each in bag.channels} == {each.type_name for each in log.channels}
    assert bag.notes[0] == "it is a rosbag2 SQLite file"


@pytest.mark.parametrize(
    "form", [None, BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4], ids=str
)
def test_a_bag_of_ros_1_holds_what_the_mcap_holds(
    tmp_path: Path, form: BagWriter.CompressionFormat | None
) -> None:
    truth = write_small(tmp_path / "log.mcap")
    assert read_all(write_bag(tmp_path / "run.bag", form)) == truth
    bag = open_log(tmp_path / "run.bag")
    with BagReader(tmp_path / "run.bag") as reader:
        assert (bag.profile, bag.chunk_count) == ("ros1", len(reader.chunk_infos))


def test_what_a_file_is_is_told_by_its_content(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.bag").rename(tmp_path / "run.mcap")
    assert len(read_all(bag)) == 180


def test_a_recording_split_over_several_files_is_one(tmp_path: Path) -> None:
    first, second = (next(write_db3(tmp_path / name).glob("*.db3")) for name in ("a", "b"))
    folder = tmp_path / "run"
    folder.mkdir()
    first.rename(folder / "run_0.db3")
    with sqlite3.connect(second) as database:
        database.execute("UPDATE messages SET timestamp = timestamp + 1000000000")
    database.close()
    second.rename(folder / "run_1.db3")
    data = read_topics(folder, [Wanted("/speed")])
    (speed,) = data.of("/speed")
    assert len(speed) == 120
    assert np.diff(speed.log_time).min() > 0


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.99])
@pytest.mark.parametrize("kind", ["bag", "db3"])
def test_a_bag_that_is_cut_says_so(tmp_path: Path, kind: str, share: float) -> None:
    path = tmp_path / f"cut.{kind}"
    whole = (
        write_bag(tmp_path / "run.bag") if kind == "bag" else next(write_db3(tmp_path / "r").glob("*.db3"))
    )
    content = whole.read_bytes()
    path.write_bytes(content[: max(20, int(share * len(content)))])
    assert is_finished(whole)
    # A bag does not tell how long the index at its end is.
    assert is_finished(path) == (kind == "bag" and share == 0.99)
    if kind == "db3" and share == 0.99:
        assert [loss.kind for loss in open_log(path).losses] == ["truncated"]
        return
    with pytest.raises(LogError) as caught:
        open_log(path)
    assert caught.value.code == "log_unreadable"
    assert "\n" not in str(caught.value)
    assert "Copy it" in caught.value.hint


def write_counter(path: Path, rows: int, form: BagWriter.CompressionFormat | None = None) -> list[float]:
    """A bag of many small chunks, whose messages count in steps of a quarter; the values."""
    values = [0.25 * row for row in range(rows)]
    writer = BagWriter(path)
    writer.chunk_threshold = 2_000
    if form is not None:
        writer.set_compression(form)
    with writer:
        connection = writer.add_connection("/x", FLOAT, typestore=STORE_1)
        for row, value in enumerate(values):
            message = STORE_1.types[FLOAT](value)
            writer.write(connection, START + row, STORE_1.serialize_ros1(message, FLOAT))
    return values


def test_around_damage_in_a_bag_everything_is_read_and_the_lost_told(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    values = write_counter(path, 4000)
    content = bytearray(path.read_bytes())
    # The length of a record in the middle points beyond its chunk.
    place = content.index(b"op=\x02", len(content) // 2) - 8
    content[place : place + 4] = b"\xff\xff\xff\x7f"
    path.write_bytes(content)
    data = read_topics(path, [Wanted("/x")])
    (columns,) = data.of("/x")
    (missing,) = set(values) - set(np.asarray(columns.fields["data"]).tolist())
    assert len(columns) == len(values) - 1
    (loss,) = data.losses
    assert loss.text.startswith("1 message in the chunk at byte ")
    assert loss.start_ns == loss.end_ns == START + int(4 * missing)


def test_a_message_that_the_index_of_a_bag_names_many_times_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "run.bag"
    values = write_counter(path, 400)
    content = bytearray(path.read_bytes())
    with BagReader(path) as reader:
        place = reader.chunk_infos[0].pos
    _, _, place = ros1._split(content, place)
    _, start, end = ros1._split(content, place)
    count = (end - start) // 12
    content[start:end] = content[start : start + 12] * count
    path.write_bytes(content)
    data = read_topics(path, [Wanted("/x")])
    assert len(data.of("/x")[0]) == len(values) - count + 1
    (loss,) = data.losses
    assert loss.text.startswith(f"{count - 1} messages in the chunk at byte ")


def test_a_bag_of_ros_1_is_read_from_an_object_store_and_a_database_is_not(tmp_path: Path) -> None:
    store = open_store("memory://bags")
    bag, (file,) = write_bag(tmp_path / "run.bag"), write_db3(tmp_path / "run").glob("*.db3")
    for name, path in (("run.bag", bag), ("run.db3", file)):
        store.pipe(f"/bags/{name}", path.read_bytes())
    assert read_all(to_location("memory://bags/run.bag")) == read_all(bag)
    with pytest.raises(LogError, match="SQLite file is not read from an object store"):
        open_log("memory://bags/run.db3")


@given(data=st.data())
@settings(max_examples=60, deadline=None)
@pytest.mark.parametrize(
    "form", [None, BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4], ids=str
)
def test_a_flipped_bit_costs_a_chunk_of_a_bag_at_most(
    tmp_path_factory: pytest.TempPathFactory, form: BagWriter.CompressionFormat | None, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("flipped") / "run.bag"
    values = write_counter(path, 400, form)
    content = bytearray(path.read_bytes())
    with BagReader(path) as reader:
        first, fewest = (
            reader.chunk_infos[0].pos,
            max(sum(c.connection_counts.values()) for c in reader.chunk_infos),
        )
    told = content.index(b"index_pos=") + len(b"index_pos=")
    end = int.from_bytes(content[told : told + 8], "little")
    bit = data.draw(st.integers(8 * first, 8 * end - 1))
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)
    seen = read_topics(path, [Wanted("/x")])
    there = [np.asarray(columns.fields["data"]).tolist() for columns in seen.of("/x")]
    read = set(there[0]) if there else set()
    assert len(set(values) - read) <= fewest
    if sum(map(len, there)) < len(values):
        assert seen.losses


def test_what_no_recorder_puts_into_a_table_is_left_out_and_said(tmp_path: Path) -> None:
    (file,) = write_db3(tmp_path / "run").glob("*.db3")
    with sqlite3.connect(file) as database:
        for time, content in ((-5, b"x"), ("now", b"x"), (START, "text"), (START, 3.5)):
            database.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (time, content)
            )
        bomb = b"\x28\xb5\x2f\xfd" + b"\xe0" + (1 << 40).to_bytes(8, "little") + bytes(20)
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (START, bomb))
    database.close()
    data = read_topics(file, [Wanted("/speed")])
    assert len(data.of("/speed")[0]) == 60
    assert [loss.text.split()[0] for loss in data.losses] == ["5"]


@pytest.mark.parametrize("change", ["name = NULL", "type = NULL", "name = x'00ff'"])
def test_a_topic_without_name_or_type_is_refused(tmp_path: Path, change: str) -> None:
    (file,) = write_db3(tmp_path / "run").glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("CREATE TABLE odd AS SELECT * FROM topics")
        database.execute(f"UPDATE odd SET {change}")  # noqa: S608 - our own words
        database.executescript("DROP TABLE topics; ALTER TABLE odd RENAME TO topics")
    database.close()
    with pytest.raises(LogError, match="no name or no type"):
        open_log(file)


@pytest.mark.parametrize("form", [BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4], ids=str)
def test_a_chunk_that_grows_beyond_what_is_plausible_is_refused(
    tmp_path: Path, form: BagWriter.CompressionFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inflate_module, "_PLAUSIBLE", 1000)
    monkeypatch.setattr(inflate_module, "_PLAUSIBLE_RATIO", 2)
    data = read_topics(write_bag(tmp_path / "run.bag", form), [Wanted("/speed")])
    assert len(data.of("/speed")[0]) == 0
    assert "as no recording does" in data.losses[0].text


@pytest.mark.parametrize("form", [BagWriter.CompressionFormat.BZ2, BagWriter.CompressionFormat.LZ4])
def test_all_chunks_of_a_bag_together_inflate_to_no_more_than_their_budget(
    tmp_path: Path, form: BagWriter.CompressionFormat
) -> None:
    path = tmp_path / "run.bag"
    values = write_counter(path, 400, form)
    some = read_topics(open_log(path, max_inflated=10_000), [Wanted("/x")])
    (loss,) = some.losses
    assert loss.kind == "max_inflated"
    assert "at most 10.0 kB are read" in loss.text
    assert 0 < len(some.of("/x")[0]) < len(values)
    assert not read_topics(path, [Wanted("/x")]).losses


def test_a_database_of_something_else_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "notes.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE notes(text TEXT)")
    database.close()
    with pytest.raises(LogError, match="tables are missing") as caught:
        open_log(path)
    assert caught.value.code == "log_unreadable"


def test_the_foreign_bags_hold_what_their_readers_say() -> None:
    folder = SHARED / "foreign"
    if not folder.is_dir():
        pytest.skip("../shared/foreign is not here: the logs of others are not part of the repository")
    bag = open_log(folder / "fuse_turtlebot3.bag")
    assert {each.topic: each.message_count for each in bag.channels}["/odom"] == 2741
    (odometry,) = read_topics(bag, [Wanted("/odom", ("pose.pose.position.x",))]).of("/odom")
    assert odometry.header_time is not None
    assert np.isfinite(odometry.fields["pose.pose.position.x"]).all()
    database = open_log(folder / "nvnmangla_roomba.db3")
    (joints,) = read_topics(database, [Wanted("/joint_states")]).of("/joint_states")
    assert len(joints) == 672
    assert joints.fields["name"].row(0) == ["wheel_left_joint", "wheel_right_joint"]


def test_a_damaged_length_asks_for_no_memory(tmp_path: Path) -> None:
    content = bytearray(write_bag(tmp_path / "run.bag").read_bytes())
    told = content.index(b"index_pos=") + len(b"index_pos=")
    place = int.from_bytes(content[told : told + 8], "little")
    content[place : place + 4] = b"\xff\xff\xff\xff"
    (tmp_path / "run.bag").write_bytes(content)
    tracemalloc.start()
    with pytest.raises(LogError, match="cannot be opened"):
        open_log(tmp_path / "run.bag")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50_000_000


COMPUTED = ["zeroblob(500000000)", "zeroblob(60000)", "cast(printf('%d', id) as blob)"]
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
ENDLESS = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"


@pytest.mark.parametrize("value", COMPUTED)
@pytest.mark.parametrize("kind", ["VIRTUAL", "STORED"])
def test_a_database_that_computes_its_messages_is_refused(tmp_path: Path, value: str, kind: str) -> None:
    path = tmp_path / "run.db3"
    with sqlite3.connect(path) as database:
        database.executescript(
            f"{TOPICS} CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            f"data BLOB GENERATED ALWAYS AS ({value}) {kind});"
        )
        if kind == "VIRTUAL":
            database.execute("INSERT INTO messages(topic_id, timestamp) VALUES (1, 1)")
    database.close()
    with pytest.raises(LogError, match="computed columns, which no recorder writes"):
        open_log(path)


def test_a_query_that_runs_on_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bags, "_CPU_S", 0.2)
    path = tmp_path / "run.db3"
    with sqlite3.connect(path) as database:
        rows = f"{ENDLESS} SELECT id, 1 AS topic_id, id AS timestamp, '' AS data FROM n"  # noqa: S608 - likewise
        table = "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data, content=endless, "
        try:
            database.executescript(f"{TOPICS} CREATE VIEW endless AS {rows}; {table} content_rowid=id);")
        except sqlite3.OperationalError:
            pytest.skip("SQLite is here without fts5, which can read a view as if it were a table")
    database.close()
    begin = time.process_time()
    with pytest.raises(LogError, match="takes more than 0 s of CPU time"):
        open_log(path)
    assert time.process_time() - begin < 3.0


def test_what_a_database_yields_is_charged_however_it_is_stored(tmp_path: Path) -> None:
    (file,) = write_db3(tmp_path / "run").glob("*.db3")
    some = read_topics(open_log(file, max_inflated=500), [Wanted("/speed")])
    (loss,) = some.losses
    assert (loss.kind, len(some.of("/speed")[0])) == ("max_inflated", 500 // 12)
    assert "more than 500 B" in loss.text


@pytest.mark.parametrize("table", ["messages", "topics", "message_definitions"])
def test_a_view_in_place_of_a_table_is_not_asked(tmp_path: Path, table: str) -> None:
    (file,) = write_db3(tmp_path / "run").glob("*.db3")
    with sqlite3.connect(file) as database:
        database.executescript(f"DROP TABLE {table}; CREATE VIEW {table} AS {ENDLESS} SELECT id FROM n;")  # noqa: S608 - likewise
    database.close()
    if table == "message_definitions":
        assert len(read_topics(file, [Wanted("/joints", ())]).of("/joints")[0]) > 0
        return
    with pytest.raises(LogError, match="tables are missing"):
        open_log(file)
