"""Public data sets, a few made-up rows of each in its own format: recognized, and analyzed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fomo_session import EFFECTIVE_TRACK, write_session
from mcap.reader import make_reader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from simulated_platforms import simulate_platform
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.long
def test_a_folder_of_tables_becomes_a_log_by_the_script_of_the_examples(tmp_path: Path) -> None:
    session, log = write_session(tmp_path / "red_2025-10-14-11-41"), tmp_path / "session.mcap"
    subprocess.run([sys.executable, EXAMPLES / "tables_to_mcap.py", session, log], check=True)
    outcome = analyze_log(log, Options(out=tmp_path / "results", report=False, diagnosis=True))
    assert outcome.summary["vehicle"] == "warthog"
    assert "heading_from_imu" in {finding["id"] for finding in outcome.manifest.read("findings").to_dicts()}
    (effect,) = outcome.summary["diagnosis"]["effects"]
    assert effect["id"] == "effective_track"
    assert effect["parameters"]["k"]["value"] == pytest.approx(EFFECTIVE_TRACK, rel=0.02)


def as_bag(log: Path) -> Path:
    """A simulated log as a bag of ROS 1, as the data set publishes it."""
    store, modern = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    bag = log.with_suffix(".bag")
    with log.open("rb") as stream, BagWriter(bag) as writer:
        connections = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.topic not in connections:
                if schema.name not in store.types:
                    found = get_types_from_msg(schema.data.decode(), schema.name)
                    for known in (store, modern):
                        known.register(
                            {name: made for name, made in found.items() if name not in known.types}
                        )
                connections[channel.topic] = writer.add_connection(
                    channel.topic, schema.name, typestore=store
                )
            data = modern.cdr_to_ros1(message.data, schema.name)
            writer.write(connections[channel.topic], message.log_time, data)
    return bag


@pytest.mark.parametrize(
    ("platform", "effects", "lacks"),
    [
        pytest.param(
            "tartandrive",
            {"wheel_radius": 0.93},
            "throttle and steering as shares",
            marks=pytest.mark.long,
        ),
        pytest.param("f1tenth_ros1", {"steering_offset": 0.05}, "", marks=pytest.mark.long),
        ("jackal_ros1", {"effective_track": 1.5}, ""),
    ],
)
def test_a_bag_of_ros_1_is_recognized_and_its_effect_is_named(
    tmp_path: Path, platform: str, effects: dict[str, float], lacks: str
) -> None:
    log = simulate_platform(platform, effects, out=tmp_path / "run.mcap", seed=3, duration_s=90.0)
    bag = as_bag(log)
    log.unlink()
    said = json.loads(run_verb("inspect", bag, "--json").stdout)
    assert said["profile"] == "ros1"
    assert said["problem"] is None
    assert lacks in run_verb("inspect", bag).stdout
    outcome = analyze_log(bag, Options(out=tmp_path / "results", report=False, diagnosis=True))
    assert {effect["id"] for effect in outcome.summary["diagnosis"]["effects"]} >= effects.keys()


def test_a_topic_that_is_not_what_its_type_says_serves_where_it_is_named(tmp_path: Path) -> None:
    log = simulate_platform("tartandrive", {}, out=tmp_path / "run.mcap", seed=3, duration_s=20.0)
    assert json.loads(run_verb("inspect", log, "--json").stdout)["roles"]["command"] is None
    (tmp_path / "run.toml").write_text('[command]\ntopic = "/cmd"\n', encoding="utf-8")
    named = json.loads(run_verb("inspect", log, "--json").stdout)["roles"]["command"]
    assert named["topic"] == "/cmd"
