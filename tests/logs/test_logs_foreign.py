"""A file that is no recording is called what it is, with what to do about it."""

import gzip
import io
import tarfile
import zipfile
from pathlib import Path

import pytest
import zstandard
from mcap_files import write_small

from pipeline.logs import LogError, open_log


def pack_zip(data: bytes) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("run_0.db3", data)
    return target.getvalue()


def pack_tar(data: bytes) -> bytes:
    target = io.BytesIO()
    with tarfile.open(fileobj=target, mode="w") as archive:
        entry = tarfile.TarInfo("run.mcap")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    return target.getvalue()


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0f" * 32 + b"\nsize 4053364\n"


@pytest.mark.parametrize(
    ("name", "content", "what", "hint"),
    [
        ("run.mcap", POINTER, "Git LFS", "git lfs pull"),
        ("run.bag", POINTER, "Git LFS", "git lfs pull"),
        ("run_0.db3", POINTER.replace(b"\n", b"\r\n"), "Git LFS", "git lfs pull"),
        ("run.mcap", b"\n<!DOCTYPE html>\n<html><body>Sign in</body></html>", "web page", "Download"),
        ("run.bag", b"<HTML><HEAD><TITLE>Quota exceeded", "web page", "Download"),
        ("run.ulg", b"ULog\x01\x12\x35\x01" + bytes(40), "ULog", "ulog2rosbag"),
        ("run.db3.zip", pack_zip(b"SQLite format 3\0"), "zip", "unzip"),
        ("run.mcap.gz", gzip.compress(b"\x89MCAP0\r\n"), "gzip", "gunzip"),
        ("run.tar", pack_tar(b"\x89MCAP0\r\n"), "tar archive", "tar -xf"),
        ("run.mcap", zstandard.compress(b"\x89MCAP0\r\n" * 99), "Zstandard", ".zstd"),
        ("run.csv", b"t,v,w\n0.0,0.1,0.2\n0.1,0.1,0.3\n", "CSV", ".mcap"),
        ("odometry.txt", b"t\tx\ty\n0\t1\t2\n", "CSV", ".mcap"),
        ("run.json", b'{"topics": []}', "JSON", ".mcap"),
        ("metadata.yaml", b"rosbag2_bagfile_information:\n  version: 5\n", "list of files", "folder"),
        ("run.mcap", bytes(4096), "zero", "again"),
    ],
)
def test_what_is_no_recording_is_named(
    tmp_path: Path, name: str, content: bytes, what: str, hint: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError) as raised:
        open_log(path)
    assert raised.value.code == "not_mcap"
    assert what in raised.value.what
    assert hint in (raised.value.hint or "")
    assert "bag convert" not in str(raised.value)


def test_bytes_that_tell_nothing_are_not_named(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(bytes(range(200, 256)) * 20)
    with pytest.raises(LogError, match="not an MCAP file or a ROS bag"):
        open_log(path)


def test_a_recording_that_its_recorder_has_not_finished_is_read(tmp_path: Path) -> None:
    write_small(tmp_path / "log.mcap")
    path = tmp_path / "log.mcap.active"
    path.write_bytes((tmp_path / "log.mcap").read_bytes()[:-200])
    assert open_log(path).message_count
