"""The real recording of data_samples: slip against the log's own numbers, read without the program."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import slip

FOLDER = Path(__file__).parents[2] / "data_samples" / "recorded"
LOG = FOLDER / "diff_circular.mcap"
RADIUS_M, TRACK_M = 0.042, 0.2


def test_slip_sums_up_to_what_the_wheels_turned_more_than_the_body(tmp_path: Path) -> None:
    poses, wheels = [], []
    with LOG.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            if channel.topic == "/mocap/pose":
                turn = content.pose.orientation
                poses.append((message.log_time, 2.0 * np.arctan2(turn.z, turn.w)))
            else:
                wheels.append((message.log_time, *content.position))
    (times, headings), (ticked, left, right) = np.array(poses).T, np.array(wheels).T
    from_wheels = RADIUS_M / TRACK_M * np.interp(times, ticked, right - left)
    expected = np.ptp(from_wheels) - np.ptp(np.unwrap(headings))

    run = slip.analyze(LOG, results=tmp_path, report=False, diagnosis=False)
    found = run.slip.select(pl.col("g_w").sum() * 0.05).collect().item()

    assert abs(expected) > np.radians(5.0)  # the nominal track is too narrow, as its authors published
    assert abs(found) == pytest.approx(abs(expected), rel=0.1)


def test_source_and_licence_stand_beside_the_recording() -> None:
    assert "Ricardo Sousa" in (FOLDER / "LICENSE").read_text("utf-8")
    assert "sousarbarb/optiodom" in (FOLDER / "README.md").read_text("utf-8")
    assert LOG.stat().st_size < 2_000_000
