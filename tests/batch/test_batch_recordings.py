"""Which recordings a batch finds."""

import os
import time
from pathlib import Path

import pytest

from pipeline.batch.recordings import find_recordings

MAGIC = b"\x89MCAP0\r\n"
WHOLE = MAGIC + b"records" + MAGIC


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    top = (tmp_path / "logs").resolve()
    for name in (
        "a.mcap",
        "2026/07/b.mcap",
        "2026/08/c é.mcap",
        "notes.txt",
        ".hidden/d.mcap",
        ".e.mcap",
        "run_1/run_1_0.mcap",
        "run_1/run_1_1.mcap",
        "split/x_0.mcap",
        "split/x_1.mcap",
        "split/metadata.yaml",
        "day/run_1.mcap",
        "day/run_2.mcap",
    ):
        path = top / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(WHOLE)
    return top


def names(found: tuple[Path, ...], top: Path) -> list[str]:
    return [path.relative_to(top).as_posix() for path in found]


EVERYTHING = [
    "2026/07/b.mcap",
    "2026/08/c é.mcap",
    "a.mcap",
    "day/run_1.mcap",
    "day/run_2.mcap",
    "run_1",
    "split",
]


def test_a_folder_is_searched_and_a_split_recording_is_one(tree: Path) -> None:
    found = find_recordings([str(tree)], settle_s=0.0)
    assert sorted(names(found.recordings, tree)) == sorted(EVERYTHING)
    assert found.growing == ()


def test_globs_files_and_lists_name_the_same_log_once(tree: Path) -> None:
    listing = tree / "list.txt"
    listing.write_text("# the good ones\na.mcap\n\n2026/**/*.mcap  # all of July and August\nrun_1\n")
    found = find_recordings([f"@{listing}", str(tree / "a.mcap"), str(tree / "2*/0?/*")], settle_s=0.0)
    assert names(found.recordings, tree) == ["2026/07/b.mcap", "2026/08/c é.mcap", "a.mcap", "run_1"]


def test_a_link_and_its_log_are_one(tree: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tree)
    both = find_recordings([str(tree), str(tmp_path / "link")], settle_s=0.0)
    assert both == find_recordings([str(tree)], settle_s=0.0)


def test_logs_still_being_written_are_left(tree: Path) -> None:
    (tree / "a.mcap").write_bytes(MAGIC + b"rec")
    (tree / "split" / "x_1.mcap").write_bytes(MAGIC + b"rec")
    found = find_recordings([str(tree)], settle_s=60.0)
    # run_1 has no metadata.yaml yet: its next part may be about to begin.
    assert names(found.growing, tree) == ["a.mcap", "run_1", "split"]
    long_ago = time.time() - 120.0
    for path in [tree / "a.mcap", *tree.glob("split/*"), *tree.glob("run_1/*")]:
        os.utime(path, (long_ago, long_ago))
    assert find_recordings([str(tree)], settle_s=60.0).growing == ()


def test_a_rotated_or_renamed_recording_is_read_and_a_packed_one_is_named(tmp_path: Path) -> None:
    """What follows the suffix does not hide a recording; what is no recording stays unmentioned."""
    read = ("rot.mcap.1", "plain.MCAP", "run.mcap.active", "old.BAG", "dated.mcap-20260705", "z.mcap.2.zst")
    for name in read:
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\n" if "BAG" in name else WHOLE)
    packed = {
        "rot.mcap.3.gz": b"\x1f\x8b\x08",
        "old.mcap.xz": b"\xfd7zXZ\0",
        "X.MCAP.ZST": b"\x28\xb5\x2f\xfd",
    }
    for name, start in packed.items():
        (tmp_path / name).write_bytes(start + bytes(100))
    for name in ("a.mcap.md5", "a.mcap.txt", "a.db3-wal", "mcap", "a.mcapital", "b.gz"):
        (tmp_path / name).write_bytes(b"\x1f\x8b" if name == "b.gz" else b"1c2f a.mcap\n")
    found = find_recordings([str(tmp_path)], settle_s=0.0)
    assert sorted(names(found.recordings, tmp_path)) == sorted(read)
    assert {each.path.name: each.is_entry for each in found.skipped} == dict.fromkeys(packed, True)
    reasons = {each.path.name: f"{each.reason}: {each.hint}" for each in found.skipped}
    assert "compressed with gzip: Unpack it" in reasons["rot.mcap.3.gz"]
    assert "zstd -d" in reasons["X.MCAP.ZST"]
    assert find_recordings([str(tmp_path / "*")], settle_s=0.0) == found
