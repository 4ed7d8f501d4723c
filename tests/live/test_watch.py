"""What a user is promised of a recording that is watched while it is written."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from few import few
from mcap.reader import make_reader
from mcap.writer import Writer
from verbs import ask_verb, run_verb

from pipeline import live
from pipeline.cli.screen import format_watch
from pipeline.live import RUNNING_T, choose_recording, follow, list_known, list_passing, summarize
from pipeline.logs import LogError
from pipeline.models import Number
from pipeline.results import Errors, GrownEvidence, Growth, Named, RunDiagnosis, Step, Unobservable
from pipeline.simulate import Scenario, simulate_run, write_log

CHUNK = 1 << 14
PROMISED = {"t_s", "slip", "error", "known", "drive_next", "events", "enough", "faults"}


def make_log(path: Path, duration_s: float, **settings: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_log(simulate_run(Scenario(duration_s=duration_s, seed=5, **settings)), path)  # type: ignore[arg-type]
    return path


def watch_json(*words: object) -> list[dict[str, Any]]:
    """The lines of `slip watch --json`."""
    done = run_verb("watch", *words, "--json")
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


class Recorder(threading.Thread):
    """Writes the messages of a log as a recorder would: chunk by chunk, split over files, with pauses."""

    def __init__(self, source: Path, files: list[Path], pause_s: float, *, chunk: int = CHUNK) -> None:
        super().__init__()
        self.source, self.files, self.pause_s, self.chunk = source, files, pause_s, chunk

    def begin(self) -> None:
        """Start, and wait until there is a file."""
        self.start()
        while not self.files[0].exists():
            time.sleep(0.05)

    def run(self) -> None:
        with self.source.open("rb") as stream:
            messages = list(make_reader(stream).iter_messages(log_time_order=True))
        share = -(-len(messages) // len(self.files))
        for number, file in enumerate(self.files):
            self.write(file, messages[number * share : (number + 1) * share])
        if len(self.files) > 1:
            listing = "".join(f"    - {file.name}\n" for file in self.files)
            text = f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listing}"
            (self.files[0].parent / "metadata.yaml").write_text(text)

    def write(self, file: Path, messages: list[tuple[object, ...]]) -> None:
        with file.open("wb") as stream:
            writer = Writer(stream, chunk_size=self.chunk)
            writer.start(profile="ros2", library="test")
            schemas: dict[int, int] = {}
            channels: dict[int, int] = {}
            last = 0
            for schema, channel, message in messages:  # type: ignore[assignment]
                if channel.id not in channels:
                    if schema.id not in schemas:
                        schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, schemas[schema.id]
                    )
                writer.add_message(
                    channels[channel.id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                    message.sequence,
                )
                if stream.tell() != last:
                    last = stream.tell()
                    stream.flush()
                    time.sleep(self.pause_s)
            writer.finish()


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[dict[str, Any]]]:
    """What the next looks find, in place of an analysis."""
    found: list[dict[str, Any]] = []
    monkeypatch.setattr(live, "_analyze", lambda *_: found.pop(0))
    monkeypatch.setattr(live, "_POLL_S", 0.01)
    yield found
    assert found == []


def find(t: float = 1.2 * RUNNING_T) -> dict[str, Any]:
    """An analysis that names an effect."""
    return {"diagnosis": msgspec.to_builtins(RunDiagnosis(effects=(name("effective_track", t),)))}


def list_effects(look: dict[str, Any]) -> list[str]:
    return [one["effect"] for one in look["known"]]


def cut(log: Path, share: float) -> bytes:
    """Leave only the beginning of a log, and return all of it."""
    content = log.read_bytes()
    log.write_bytes(content[: round(share * len(content))])
    return content


def test_every_line_has_what_is_promised_and_a_closed_log_the_answer_of_a_diagnosis(tmp_path: Path) -> None:
    log, results = (
        make_log(tmp_path / "run.mcap", 60.0, effects={"effective_track": {"k": 1.8}}),
        tmp_path / "out",
    )
    (look,) = watch_json(log, "--results", results)
    assert set(look) >= PROMISED
    assert look["t_s"] == pytest.approx(60.0, abs=0.5)
    assert set(look["slip"]) == {"command", "measured"}
    (run,) = ask_verb("diagnose", log, "--results", results)["runs"]
    for one in run["effects"]:
        value = one["parameters"][next(iter(one["parameters"]))]
        assert (one["id"], value["value"]) in [(row["effect"], row["value"]) for row in look["known"]]
    assert "effective_track" in list_effects(look)


def test_a_truncated_last_chunk_is_no_loss(tmp_path: Path) -> None:
    log = make_log(tmp_path / "run.mcap", 40.0)
    cut(log, 0.7)
    done = run_verb("watch", log, "--for", "0.5", "--results", tmp_path / "out", "--json")
    (look,) = map(json.loads, done.stdout.splitlines())
    assert (done.returncode, look["closed"], look["problem"]) == (0, False, "")
    assert 15.0 < look["t_s"] < 40.0
    assert "loss" not in done.stdout + done.stderr


@pytest.mark.parametrize("after_s", few([3.0, 6.0], 2))
def test_it_ends_within_two_seconds_after_an_interrupt(after_s: float, tmp_path: Path) -> None:
    cut(make_log(tmp_path / "run.mcap", 200.0, effects={"drive_lag": {"tau": 0.5}}), 0.9)
    command = [sys.executable, "-m", "pipeline", "watch", "run.mcap", "--for", "300"]
    around = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, env=around) as process:
        time.sleep(after_s)
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
    assert time.monotonic() - begin < 2.0
    assert process.returncode in {0, 130}
    assert "Traceback" not in told


def test_it_looks_again_when_the_file_has_grown_until_it_is_closed(
    answers: list[dict[str, Any]], tmp_path: Path
) -> None:
    log = make_log(tmp_path / "run.mcap", 3.0)
    content = cut(log, 0.5)
    answers += [find(), {"problem": "the log is odd"}, find()]
    looks = follow(log, (), every_s=0.0, quiet_s=60.0)
    assert not next(looks)["closed"]
    log.write_bytes(content[:-9])
    assert next(looks)["problem"] == "the log is odd"
    log.write_bytes(content)
    last = next(looks)
    assert last["closed"]
    # One look is enough for a closed log, of which there is no second.
    assert list_effects(last) == ["effective_track"]
    assert list(looks) == []


def test_a_folder_is_closed_by_its_listing(answers: list[dict[str, Any]], tmp_path: Path) -> None:
    log = make_log(tmp_path / "bag" / "bag_0.mcap", 3.0)
    answers += [find(), find()]
    looks = follow(log.parent, (), every_s=0.0, quiet_s=60.0)
    assert list_effects(next(looks)) == []
    (log.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n", encoding="utf-8")
    last = next(looks)
    assert (last["closed"], list_effects(last)) == (True, ["effective_track"])
    assert list(looks) == []


def test_an_effect_is_reported_after_two_looks(answers: list[dict[str, Any]], tmp_path: Path) -> None:
    log = make_log(tmp_path / "run.mcap", 3.0)
    content = cut(log, 0.5)
    answers += [find(), find(), find(0.9 * RUNNING_T)]
    seen = []
    for look in follow(log, (), every_s=0.0, quiet_s=0.3):
        seen.append(list_effects(look))
        log.write_bytes(content[: len(content) // 2 + min(len(seen), 2)])
    assert seen == [[], ["effective_track"], []]


def test_looks_leave_most_of_a_core(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    log, begins = make_log(tmp_path / "run.mcap", 3.0), []
    content = cut(log, 0.5)

    def analyze(*_: object) -> dict[str, Any]:
        begins.append(time.monotonic())
        time.sleep(0.2)
        log.write_bytes(content[: len(content) // 2 + len(begins)])
        return {}

    monkeypatch.setattr(live, "_analyze", analyze)
    looks = follow(log, (), every_s=0.0, quiet_s=60.0)
    next(looks), next(looks), next(looks)
    assert min(begins[1] - begins[0], begins[2] - begins[1]) > 0.6


def test_the_newest_recording_of_a_folder_is_watched(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no MCAP file"):
        choose_recording(tmp_path)
    with pytest.raises(LogError, match="no such file"):
        choose_recording(tmp_path / "no.mcap")
    for number in range(2):
        (tmp_path / f"run_{number}.mcap").touch()
    assert choose_recording(tmp_path) == tmp_path
    (tmp_path / "field.mcap").touch()
    for number in range(2):
        os.utime(tmp_path / f"run_{number}.mcap", (1, 1))
    assert choose_recording(tmp_path) == tmp_path / "field.mcap"


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(LogError, match="no such file"):
        choose_recording(tmp_path / "pipe.mcap")


def test_a_file_that_never_grows_is_told(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    told = run_verb("watch", tmp_path / "run.mcap", "--for", "0.5", "--results", tmp_path / "out")
    assert told.returncode == 1
    assert "run.mcap: the file is empty" in told.stderr
    assert "not yet   the file is empty" in told.stdout


def test_a_file_that_was_taken_away_while_it_was_watched_is_told(
    answers: list[dict[str, Any]], tmp_path: Path
) -> None:
    log = make_log(tmp_path / "run.mcap", 3.0)
    cut(log, 0.5)
    answers += [{}]
    looks = follow(log, (), every_s=0.0, quiet_s=60.0)
    next(looks)
    log.unlink()
    with pytest.raises(LogError, match=r"run.mcap: the recording cannot be read: No such file"):
        next(looks)


def name(effect: str, t: float, width: float = 0.1, *, corrected: bool = False) -> Named:
    number = Number(1.8, 1.8 - width, 1.8 + width)
    return Named(
        effect, {"k": number}, corrected=corrected, growth=Growth(GrownEvidence((1.0, 2.0), (1.0, t)))
    )


def test_a_name_needs_more_evidence_than_in_a_finished_log_and_a_second_look() -> None:
    weak, strong = (
        RunDiagnosis(effects=(name("effective_track", share * RUNNING_T),)) for share in (0.9, 1.1)
    )
    assert list_passing(weak) == []
    assert list_passing(strong) == ["effective_track"]
    assert list_known(weak, ["effective_track"]) == list_known(strong, []) == []
    (known,) = list_known(strong, ["effective_track"])
    assert (known["parameter"], known["value"]) == ("k", 1.8)
    assert [one["effect"] for one in list_known(weak, None)] == ["effective_track"]


def test_a_wide_interval_and_a_guessed_vehicle_are_told_as_such() -> None:
    wide, narrow = name("effective_track", 50.0, 1.2), name("drive_gain", 50.0, 0.02)
    guess = {"id": "vehicle_fitted", "severity": "warning", "where": "vehicle"}
    values = {"kind": "wheels alone", "assumed": {"wheel_radius_m": 0.1}}
    narrow = msgspec.structs.replace(narrow, parameters={"g": Number(0.8, 0.79, 0.81)})
    answer = {"findings": [{**guess, "values": values}]}
    shown = format_watch(
        {"log": "run.mcap", "closed": False, **summarize(answer, RunDiagnosis(effects=(wide, narrow)), None)}
    )
    assert shown[2].startswith("vehicle   no vehicle is given")
    assert shown[3] == "known     drive_gain: g 0.800 [0.790, 0.810]"
    assert shown[4] == "open      effective_track: k not yet known: 1.8 [0.6, 3.0]"


def test_what_is_wrong_is_shown_before_any_number() -> None:
    dead = {"id": "wheel_dead", "severity": "error", "where": "wheels left"}
    values = {"side": "left", "other": "right", "has_pose": True}
    answer = {
        "log": {"duration_s": 30.0},
        "by_input": {"measured": {"median_modulus": 0.4}},
        "findings": [{**dead, "values": values}],
    }
    look = {"log": "run.mcap", "closed": False, **summarize(answer, RunDiagnosis(), None)}
    labels = [line.split()[0] for line in format_watch(look)]
    assert labels[0] == "watching"
    wrong = next(n for n, line in enumerate(format_watch(look)) if "the left wheels' encoder" in line)
    assert wrong == 1 < labels.index("slip")


def test_it_asks_until_it_knows_enough() -> None:
    known = name("effective_track", 50.0, 0.02)
    errors = Step(effects=("effective_track",), t_mrmse_m=0.01, r_mrmse_rad=0.01)
    diagnosis = RunDiagnosis(
        effects=(known,),
        unobservable_why={"slope_creep": Unobservable("no excitation")},
        ladder=(Step(t_mrmse_m=0.05, r_mrmse_rad=0.05), errors),
        noise_floor=Errors(t_mrmse_m=0.01, r_mrmse_rad=0.01),
    )
    asked = summarize({}, diagnosis, [])
    assert not asked["enough"]
    assert asked["drive_next"][0].startswith("drive on a slope")
    # A clock that is corrected anyway is nothing to confirm.
    clock = name("transport_delay", 9.0, corrected=True)
    diagnosis = msgspec.structs.replace(diagnosis, effects=(known, clock))
    done = summarize({}, diagnosis, ["effective_track"])
    assert (done["enough"], done["drive_next"]) == (True, [])
    wide = msgspec.structs.replace(diagnosis, effects=(name("effective_track", 50.0, 0.2),))
    assert not summarize({}, wide, ["effective_track"])["enough"]
    nothing = msgspec.structs.replace(diagnosis, effects=())
    assert not summarize({}, nothing, [])["enough"]
    text = "\n".join(format_watch({"log": "run.mcap", "closed": False, **done}))
    assert "known     effective_track: k 1.800 [1.780, 1.820]" in text
    assert "no more driving is needed" in text


@pytest.mark.long
def test_a_log_is_followed_while_a_recorder_writes_its_parts(tmp_path: Path) -> None:
    source = make_log(tmp_path / "source.mcap", 100.0, effects={"effective_track": {"k": 1.8}})
    folder = tmp_path / "bag"
    folder.mkdir()
    recorder = Recorder(source, [folder / "bag_0.mcap", folder / "bag_1.mcap"], 0.6, chunk=1 << 15)
    recorder.begin()
    drive = ("--vehicle", "husky_a200", "--results")
    looks = watch_json(folder, "--every", "1", *drive, tmp_path / "out")
    recorder.join()
    times = [one["t_s"] for one in looks]
    assert len(looks) > 2
    assert times == sorted(times)
    assert [one["closed"] for one in looks] == [False] * (len(looks) - 1) + [True]
    (alone,) = watch_json(source, *drive, tmp_path / "alone")
    assert looks[-1]["known"] == alone["known"]
