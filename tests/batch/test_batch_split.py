"""Files with one name and numbers are parts of one recording only if they follow one another in time."""

from pathlib import Path

import pytest
from mcap_files import FLOAT, START, payloads, text_of, write_channels

from pipeline.batch.recordings import find_recordings
from pipeline.logs import LogError, open_log
from pipeline.logs.index import find_parts

SECOND = 1_000_000_000


def write_parts(folder: Path, spans: list[tuple[float, float]], *, listed: bool = False) -> Path:
    """Files called folder_00, folder_02, ... with a message a tenth of a second in each span [s]."""
    folder.mkdir()
    names = []
    for number, (begin, end) in enumerate(spans):
        times = [START + round((begin + 0.1 * step) * SECOND) for step in range(round(10 * (end - begin)))]
        encoded = payloads(FLOAT, len(times), {"data": 1.0})
        names.append(f"{folder.name}_{2 * number:02d}.mcap")
        channel = ("/speed", FLOAT, "ros2msg", text_of(FLOAT), "cdr", encoded)
        write_channels(folder / names[-1], [channel], times=times)
    if listed:
        lines = "".join(f"  - {name}\n" for name in names)
        (folder / "metadata.yaml").write_text(f"relative_file_paths:\n{lines}", encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    "spans", [[(0, 20), (20, 40)], [(0, 20), (19, 40)], [(0, 20), (300, 320), (320, 321)]]
)
def test_files_that_follow_one_another_are_one_recording(
    spans: list[tuple[float, float]], tmp_path: Path
) -> None:
    folder = write_parts(tmp_path / "brown", spans)
    assert len(open_log(folder).parts) == len(spans)
    assert find_recordings([str(tmp_path)], settle_s=0.0).recordings == (folder,)
    assert find_recordings([f"{folder}/*.mcap"], settle_s=0.0).recordings == (folder,)


@pytest.mark.parametrize("spans", [[(0, 20), (5, 25)], [(0, 20), (0, 20)], [(100, 120), (0, 20)]])
def test_files_that_overlap_in_time_are_logs_of_their_own(
    spans: list[tuple[float, float]], tmp_path: Path
) -> None:
    folder = write_parts(tmp_path / "brown", spans)
    with pytest.raises(LogError) as caught:
        open_log(folder)
    said = str(caught.value)
    assert caught.value.code == "not_a_recording"
    assert "holds 2 recordings, not parts of one: brown_02.mcap begins before brown_00.mcap ends" in said
    assert f"slip batch {folder}" in said
    files = tuple(find_parts(folder)[0])
    assert find_recordings([str(tmp_path)], settle_s=0.0).recordings == files
    assert find_recordings([f"{folder}/*.mcap"], settle_s=0.0).recordings == files


def test_the_listing_of_a_recorder_decides(tmp_path: Path) -> None:
    folder = write_parts(tmp_path / "brown", [(0, 20), (5, 25)], listed=True)
    assert len(open_log(folder).parts) == 2
    assert find_recordings([str(tmp_path)], settle_s=0.0).recordings == (folder,)
