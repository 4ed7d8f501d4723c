"""The sample logs: what their README says, and that they are what the simulator makes."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from few import few
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from verbs import print_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.recording.inspection import _measure_rate
from pipeline.simulate import simulate_case

ROW = re.compile(
    r"^\| `(\w+\.mcap)` \| ([\d.]+) m/s \| ([\d.]+ m/s|-) \| ([\d.]+) \| ([\d.]+|-) \|$", re.MULTILINE
)
NAMES = ("husky_tile.mcap", "warthog_ice.mcap", "ackermann_gravel.mcap")


@pytest.mark.parametrize("name", few(NAMES, 3))
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


def test_a_simulated_log_says_so_by_its_metadata_and_a_recorded_one_does_not(
    samples: Path, tmp_path: Path
) -> None:
    shutil.copy(samples / "husky_tile.mcap", tmp_path / "run.mcap")
    logs = (tmp_path / "run.mcap", samples / "recorded" / "diff_circular.mcap")
    told = [
        print_verb("analyze", log, "--no-report", "--no-diagnosis", "--results", tmp_path / "out", code=0)
        for log in logs
    ]
    assert ["simulated" in text.splitlines()[0] for text in told] == [True, False]


@pytest.mark.long
def test_samples_are_small_and_made_by_the_simulator(samples: Path, tmp_path: Path) -> None:
    for name in NAMES:
        made = simulate_case(Path(name).stem, out=tmp_path / name)
        decoders = DecoderFactory()
        kept = samples / made.name
        again = f"{made.name}: run `make samples`"
        assert kept.stat().st_size < 2_000_000
        (messages, records), (others, more) = read_content(kept), read_content(made)
        assert [one[:4] for one in messages] == [one[:4] for one in others], again
        assert records == more, again
        for (topic, *_, layout, data, schema), (*_, own, _) in zip(messages, others, strict=True):
            if data != own:
                # Processors round the last digit of a sine differently.
                decode = decoders.decoder_for(layout, schema)
                assert decode is not None
                ours, theirs = (split_numbers(decode(one)) for one in (data, own))
                assert ours[0] == theirs[0], again
                assert ours[1] == pytest.approx(theirs[1], abs=1e-12), f"{topic}: {again}"


def read_content(log: Path) -> tuple[list[tuple[Any, ...]], object]:
    """Every message, its bytes and schema last, and the metadata, however a writer lays out the file."""
    with log.open("rb") as stream:
        reader = make_reader(stream)
        messages = [
            (
                channel.topic,
                (one.log_time, one.publish_time, one.sequence),
                schema and (schema.name, schema.encoding, schema.data),
                channel.message_encoding,
                one.data,
                schema,
            )
            for schema, channel, one in reader.iter_messages()
        ]
        records = [(record.name, record.metadata) for record in reader.iter_metadata()]
    # Channels are numbered as the writer likes.
    return sorted(messages, key=lambda one: one[:2]), records


def split_numbers(message: object) -> tuple[object, list[float]]:
    """All of a message but its numbers of type float, and these."""
    if isinstance(message, float):
        return None, [message]
    if isinstance(message, (list, tuple)):
        parts = [split_numbers(one) for one in message]
    elif hasattr(message, "__slots__"):
        parts = [split_numbers(getattr(message, name)) for name in message.__slots__]
    else:
        return message, []
    return [layout for layout, _ in parts], [number for _, numbers in parts for number in numbers]


def test_a_vehicle_that_the_metadata_of_the_log_contradict_is_warned_about(
    samples: Path, tmp_path: Path
) -> None:
    """The log names its vehicle, and nothing else in it shows one."""
    for name in ("husky_a200", "warthog"):
        options = Options(
            out=tmp_path / name, report=False, diagnosis=False, overrides={"vehicle": {"preset": name}}
        )
        findings = analyze_log(samples / "husky_tile.mcap", options).summary["findings"]
        texts = [str(one["text"]) for one in findings if one["id"] == "vehicle_contradiction"]
        assert [text.partition(" (")[0] for text in texts] == (
            [] if name == "husky_a200" else ["the metadata of the log indicates a Clearpath Husky A200"]
        )


def test_the_rate_of_a_topic_is_that_of_its_messages_between_gaps() -> None:
    """A median period would be that within bunches."""
    steady, bunched = np.full(200, 0.05), np.tile([0.001, 0.099], 100)
    for periods in (steady, bunched):
        assert _measure_rate(periods, np.zeros(200, dtype=bool)) == pytest.approx(20.0)
    with_gap = np.append(steady, 5.0)
    assert _measure_rate(with_gap, with_gap > 1.0) == pytest.approx(20.0)
    rare = np.array([0.001, 30.0, 0.001, 30.0])
    assert _measure_rate(rare, rare > 1.0) == pytest.approx(4.0 / 60.002)
    assert _measure_rate(np.zeros(3), np.zeros(3, dtype=bool)) is None
