"""Files that rosbag2 compresses as a whole: read as they are, refused with a reason where damaged."""

from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap_files import Truth, read_small, write_small

from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, compressed, hash_log, open_log
from pipeline.logs.index import list_files
from pipeline.sources import list_configuration_files
from pipeline.store.stored_runs import name_plainly


def compress(path: Path, end: str = ".zstd", frames: int = 1) -> Path:
    """The file compressed as a whole, in its place."""
    content = path.read_bytes()
    size = -(-len(content) // frames)
    parts = [content[start : start + size] for start in range(0, len(content), size)]
    target = path.with_name(path.name + end)
    target.write_bytes(b"".join(zstandard.ZstdCompressor().compress(part) for part in parts))
    path.unlink()
    return target


def write_compressed(path: Path, end: str = ".zstd", frames: int = 1) -> tuple[Path, Truth]:
    truth = write_small(path, compression="")
    return compress(path, end, frames), truth


@pytest.mark.parametrize(("end", "frames"), [(".zstd", 1), (".zst", 1), (".zstd", 3)])
def test_a_compressed_file_is_read_as_its_content(end: str, frames: int, tmp_path: Path) -> None:
    log, truth = write_compressed(tmp_path / "run.mcap", end, frames)
    data, found = read_small(log)
    assert found == truth
    assert not data.losses
    write_small(tmp_path / "plain.mcap", compression="")
    assert hash_log(log) == hash_log(tmp_path / "plain.mcap")
    assert [path.name for path in tmp_path.iterdir() if "slip-" in path.name] == []


def test_the_name_of_the_run_and_of_its_configuration_lack_both_suffixes(tmp_path: Path) -> None:
    log, _ = write_compressed(tmp_path / "run_a.mcap")
    (tmp_path / "run_a.toml").write_text('[run]\nterrain = "grass"\n', encoding="utf-8")
    assert name_plainly(log) == f"{tmp_path.name}/run_a"
    assert tmp_path / "run_a.toml" in list_configuration_files(log)


@pytest.mark.parametrize("listed", ["bag_{}.mcap.zstd", "bag_{}.mcap"])
def test_a_folder_of_compressed_parts_is_one_recording(listed: str, tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for number in range(2):
        write_compressed(folder / f"bag_{number}.mcap")
    names = "".join(f"    - {listed.format(number)}\n" for number in range(2))
    text = f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}"
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")
    index = open_log(folder)
    assert [part.path.name for part in index.parts] == ["bag_0.mcap.zstd", "bag_1.mcap.zstd"]
    assert not index.losses
    assert find_recordings([str(tmp_path)], settle_s=0.0).recordings == (folder,)
    assert [file.name for file in list_files(folder)] == ["bag_0.mcap.zstd", "bag_1.mcap.zstd"]


def cut_off(content: bytes) -> bytes:
    return content[: len(content) // 2]


def turn_a_bit(content: bytes) -> bytes:
    at = len(content) // 2
    return content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut_off, "cut off, after"),
        (turn_a_bit, "damaged"),
        (lambda _: b"no archive at all", "damaged"),
        (lambda _: b"", "the file is empty"),
    ],
    ids=["cut off", "a byte", "other content", "empty"],
)
def test_a_damaged_compressed_file_is_refused(
    damage: Callable[[bytes], bytes], said: str, tmp_path: Path
) -> None:
    log, _ = write_compressed(tmp_path / "run.mcap")
    # The checksum of the frame tells any damage.
    content = zstandard.ZstdDecompressor().decompress(log.read_bytes())
    log.write_bytes(damage(zstandard.ZstdCompressor(write_checksum=True).compress(content)))
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(LogError, match=said) as caught:
        open_log(log)
    assert str(log) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_a_small_file_does_not_fill_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compressed, "limit_inflated", lambda _size, _most: 1 << 20)
    log = tmp_path / "zeros.mcap.zstd"
    log.write_bytes(zstandard.ZstdCompressor().compress(bytes(200 << 20)))
    with pytest.raises(LogError, match=r"inflates to more than 1\.0 MB"):
        open_log(log)
