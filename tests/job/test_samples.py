"""The sample logs: what their README says, and that they are what the simulator makes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from mcap.reader import make_reader

from pipeline.job import Options
from pipeline.job.analyze import analyze_log
from pipeline.simulate import write_samples

ROW = re.compile(
    r"^\| `(\w+\.mcap)` \| ([\d.]+) m/s \| ([\d.]+ m/s|-) \| ([\d.]+) \| ([\d.]+|-) \|$", re.MULTILINE
)
NAMES = ("husky_tile.mcap", "warthog_ice.mcap", "ackermann_gravel.mcap")


@pytest.mark.parametrize("name", NAMES)
def test_the_readme_gives_the_medians(name: str, samples: Path, tmp_path: Path) -> None:
    rows = {row[0]: row[1:] for row in ROW.findall((samples / "README.md").read_text())}
    by_input = analyze_log(samples / name, Options(out=tmp_path, report=False)).summary["by_input"]

    command, measured, command_norm, measured_norm = rows[name]
    assert by_input["command"]["median_modulus"] == pytest.approx(float(command), rel=0.01)
    assert by_input["command"]["median_window_norm"] == pytest.approx(float(command_norm), rel=0.01)
    assert ("measured" in by_input) == (measured != "-")
    if measured != "-":
        assert by_input["measured"]["median_modulus"] == pytest.approx(float(measured.split()[0]), rel=0.01)
        assert by_input["measured"]["median_window_norm"] == pytest.approx(float(measured_norm), rel=0.01)


def test_samples_are_small_and_made_by_the_simulator(samples: Path, tmp_path: Path) -> None:
    for made in write_samples(tmp_path):
        kept = samples / made.name
        assert kept.stat().st_size < 2_000_000
        assert read_content(kept) == read_content(made), f"{made.name}: run `make samples`"


def read_content(log: Path) -> object:
    """Every message and metadata record of a log, however its writer lays out the file."""
    with log.open("rb") as stream:
        reader = make_reader(stream)
        # Channels are numbered as the writer likes.
        messages = [
            (
                told.log_time,
                channel.topic,
                told.sequence,
                told.publish_time,
                told.data,
                schema and schema.data,
            )
            for schema, channel, told in reader.iter_messages()
        ]
        records = [(record.name, record.metadata) for record in reader.iter_metadata()]
    return sorted(messages), records
