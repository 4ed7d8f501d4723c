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

import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.cli.screen import format_watch
from pipeline.live.running_log import RUNNING_T, list_passing, list_stated, summarize_knowledge
from pipeline.live.watch import HEAVY_SHARE, LIGHT_SHARE, NOTES, Watch, choose_recording
from pipeline.logs import LogError, open_log, read_topics
from pipeline.logs.index import GrowingLog
from pipeline.logs.reader import Wanted
from pipeline.results import Errors, Evidence, Growth, Named, RunDiagnosis, Step, Unobservable, Value
from pipeline.simulate import Scenario, simulate_run, write_log
from pipeline.store import Store

CHUNK = 1 << 14
OTHER = {"drive_lag": 0.5}


def make_log(path: Path, duration_s: float, **settings: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_log(simulate_run(Scenario(duration_s=duration_s, seed=5, **settings)), path)  # type: ignore[arg-type]
    return path


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


def test_a_file_cut_anywhere_holds_what_is_whole_and_no_damage(tmp_path: Path) -> None:
    source = make_log(tmp_path / "source.mcap", 12.0)
    Recorder(source, [tmp_path / "small.mcap"], 0.0).run()
    content, grown = (tmp_path / "small.mcap").read_bytes(), tmp_path / "grown.mcap"
    log, whole = GrowingLog(grown), open_log(tmp_path / "small.mcap")
    counts = []
    for size in [*range(1, len(content), len(content) // 23), len(content)]:
        grown.write_bytes(content[:size])
        log.update()
        index = log.make_index()
        assert index.losses == ()
        counts.append(index.message_count)
    assert counts == sorted(counts)
    assert counts[-1] == whole.message_count
    assert index.channels == whole.channels
    assert log.is_closed
    topic = whole.channels[0].topic
    some = read_topics(log.make_index(3.0), [Wanted(topic)], sha256="-").of(topic)[0]
    every = read_topics(whole, [Wanted(topic)]).of(topic)[0]
    assert 0 < len(some) < len(every)
    assert (some.log_time == every.log_time[-len(some) :]).all()


def test_only_what_was_added_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = make_log(tmp_path / "source.mcap", 12.0)
    Recorder(source, [tmp_path / "small.mcap"], 0.0).run()
    content, grown = (tmp_path / "small.mcap").read_bytes(), tmp_path / "grown.mcap"
    half = len(content) // 2
    grown.write_bytes(content[:half])
    log = GrowingLog(grown)
    log.update()
    places: list[int] = []
    read = os.pread
    monkeypatch.setattr(os, "pread", lambda fd, size, at: places.append(at) or read(fd, size, at))
    grown.write_bytes(content)
    log.update()
    assert min(at for at in places if at) > half - 2 * CHUNK


def test_a_file_that_was_replaced_is_refused(tmp_path: Path) -> None:
    grown = make_log(tmp_path / "grown.mcap", 3.0)
    log = GrowingLog(grown)
    log.update()
    grown.write_bytes(grown.read_bytes()[:2000])
    with pytest.raises(LogError, match="became shorter"):
        log.update()


@pytest.mark.parametrize("how", ["renamed over it", "written into it"])
@pytest.mark.parametrize("longer", [False, True], ids=["of its size", "longer"])
def test_a_file_in_place_of_another_is_noticed(how: str, longer: bool, tmp_path: Path) -> None:  # noqa: FBT001
    grown, other = (
        make_log(tmp_path / "grown.mcap", 3.0),
        make_log(tmp_path / "other.mcap", 5.0, effects=OTHER),
    )
    content = other.read_bytes()
    log = GrowingLog(grown)
    log.update()
    content = content if longer else content[: grown.stat().st_size].ljust(grown.stat().st_size, b"\0")
    if how == "renamed over it":
        other.write_bytes(content)
        other.replace(grown)
    else:
        grown.write_bytes(content)
        os.utime(grown, ns=(1, 1))
    with pytest.raises(LogError, match="was replaced by another while it was watched"):
        log.update()


def write_parts(path: Path, starts_s: list[float]) -> Path:
    """A log of ten seconds a part, whose clock is set between them."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200)
        writer.start(profile="", library="test")
        channel = writer.register_channel("/a", "json", writer.register_schema("T", "jsonschema", b"{}"))
        for start in starts_s:
            for tick in range(100):
                at = round((start + 0.1 * tick) * 1e9)
                writer.add_message(channel, at, b'{"a": 1}', at)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "starts_s", [[0.0], [0.0, 1.7e9], [1.7e9, 5.0], [1.7e9, 1.7e9 - 3 * 86_400.0, 1.8e9]]
)
def test_time_goes_on_however_the_clock_of_the_recorder_is_set(starts_s: list[float], tmp_path: Path) -> None:
    log = GrowingLog(write_parts(tmp_path / "run.mcap", starts_s))
    log.update()
    assert log.end_s == pytest.approx(10.0 * len(starts_s), abs=1.0)
    tail = read_topics(log.make_index(3.0), [Wanted("/a")], sha256="-").of("/a")[0]
    assert len(tail) == pytest.approx(30, abs=12)
    assert tail.log_time.min() * 1e-9 > starts_s[-1] + 5.0


def test_a_defect_of_a_look_is_one_line_and_the_watch_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = make_log(tmp_path / "run.mcap", 3.0)
    monkeypatch.setattr(Watch, "_read_end", lambda _: [].index("what\nis not there"))
    (look,) = Watch(log, Options(out=tmp_path / "out"), (), 1.0).follow()
    assert str(look["problem"]).startswith("this look failed (ValueError: ")
    assert "\n" not in str(look["problem"])
    assert look["duration_s"] == pytest.approx(3.0, abs=0.1)


def test_a_full_disk_under_what_is_shown_is_one_line_and_the_watch_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, looks = make_log(tmp_path / "run.mcap", 3.0), []

    def follow(_: Watch) -> Iterator[dict[str, object]]:
        seen = Watch(log, Options(out=tmp_path / "out"), (), 1.0).to_json()
        for number in range(3):
            looks.append(number)
            yield seen

    def fill(*_: object, **given: object) -> None:
        if given["is_live"]:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Watch, "follow", follow)
    monkeypatch.setattr("pipeline.cli.verbs_log._write_page", fill)
    told = run_verb("watch", log, "--page", tmp_path / "page.html", "--results", tmp_path / "out")
    assert looks == [0, 1, 2]
    assert told.stderr.count("No space left on device") == 1
    assert "The watch goes on." in told.stderr


@pytest.mark.parametrize("by", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)])
def test_a_signal_ends_a_watch_with_the_diagnosis_so_far(by: signal.Signals, tmp_path: Path) -> None:
    log = make_log(tmp_path / "run.mcap", 6.0)
    content = log.read_bytes()
    log.write_bytes(content[: len(content) * 3 // 4])
    command = [
        sys.executable,
        "-m",
        "pipeline",
        "watch",
        str(log),
        "--json",
        "--for",
        "300",
        "--results",
        "out",
    ]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
    ) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["kind"] == "look"
        process.send_signal(by)
        said, told = process.communicate(timeout=120)
    assert "stopped watching; this is the diagnosis of the log so far" in told
    final = json.loads(said.splitlines()[-1])
    assert (final["kind"], final["stopped"]) == ("final", True)
    assert process.returncode in {0, 1, 3}


def test_a_file_that_was_taken_away_while_it_was_watched_is_told(tmp_path: Path) -> None:
    source, folder = make_log(tmp_path / "source.mcap", 3.0), tmp_path / "bag"
    folder.mkdir()
    Recorder(source, [folder / "bag_0.mcap", folder / "bag_1.mcap"], 0.0).run()
    (folder / "metadata.yaml").unlink()
    log = GrowingLog(folder)
    log.update()
    (folder / "bag_0.mcap").unlink()
    with pytest.raises(LogError, match=r"bag_0.mcap: the file was removed while it was watched"):
        log.update()


def test_the_newest_recording_of_a_folder_is_watched(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no MCAP file"):
        choose_recording(tmp_path)
    with pytest.raises(LogError, match="no such file"):
        choose_recording(tmp_path / "no.mcap")
    for name in ("run_0", "run_1"):
        (tmp_path / f"{name}.mcap").touch()
    assert choose_recording(tmp_path) == tmp_path
    (tmp_path / "field.mcap").touch()
    os.utime(tmp_path / "run_1.mcap", (1, 1))
    os.utime(tmp_path / "run_0.mcap", (1, 1))
    assert choose_recording(tmp_path) == tmp_path / "field.mcap"


def test_a_file_that_never_grows_is_told(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    told = run_verb("watch", str(tmp_path / "run.mcap"), "--for", "0.5", "--results", str(tmp_path / "out"))
    assert told.returncode == 1
    assert "nothing was written to it for 0.5 s" in told.stderr
    assert "--for SECONDS" in told.stderr


def test_a_page_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    log, page = make_log(tmp_path / "run.mcap", 3.0), tmp_path / "nowhere" / "page.html"
    told = run_verb("watch", str(log), "--page", str(page), "--results", str(tmp_path / "out"))
    assert told.returncode == 1
    assert f"{page}: the page cannot be written: No such file or directory" in told.stderr


@pytest.mark.long
def test_slip_and_distance_are_followed_over_splits(tmp_path: Path) -> None:
    source = make_log(tmp_path / "source.mcap", 15.0)
    folder = tmp_path / "bag"
    folder.mkdir()
    recorder = Recorder(source, [folder / "bag_0.mcap", folder / "bag_1.mcap"], 0.2)
    recorder.begin()
    watched = Watch(folder, Options(out=tmp_path / "out"), [], 20.0)
    seen = list(watched.follow())
    recorder.join()
    assert len(seen) > 1
    times = [one["duration_s"] for one in seen]
    assert times == sorted(times)
    assert seen[-1]["closed"]
    assert seen[-1]["duration_s"] == pytest.approx(open_log(source).duration_s)
    assert set(seen[-1]["slip_mps"]) == {"command", "measured"}
    again = Watch(folder, Options(out=tmp_path / "out"), [], 20.0)
    (once,) = again.follow()
    assert seen[-1]["distance_m"] == pytest.approx(once["distance_m"], rel=0.05)


def name(effect: str, t: float, width: float = 0.1, *, corrected: bool = False) -> Named:
    number = Value(1.8, 1.8 - width, 1.8 + width)
    return Named(effect, {"k": number}, corrected=corrected, growth=Growth(Evidence((1.0, 2.0), (1.0, t))))


def test_a_name_needs_more_evidence_than_in_a_finished_log_and_a_second_look() -> None:
    weak, strong = (
        RunDiagnosis(effects=(name("effective_track", share * RUNNING_T),)) for share in (0.9, 1.1)
    )
    assert list_passing(weak) == []
    assert list_passing(strong) == ["effective_track"]
    assert list_stated(strong, []) == []
    (stated,) = list_stated(strong, ["effective_track"])
    assert stated.numbers["k"]["value"] == 1.8


def test_it_asks_until_it_knows_enough() -> None:
    known = name("effective_track", 50.0, 0.02)
    errors = Step(effects=("effective_track",), t_mrmse_m=0.01, r_mrmse_rad=0.01)
    diagnosis = RunDiagnosis(
        effects=(known,),
        unobservable_why={"slope_creep": Unobservable("no excitation")},
        ladder=(Step(t_mrmse_m=0.05, r_mrmse_rad=0.05), errors),
        noise_floor=Errors(t_mrmse_m=0.01, r_mrmse_rad=0.01),
    )
    asked = summarize_knowledge(diagnosis, [])
    assert asked["waiting"] == ["effective_track"]
    assert str(asked["drive"]).startswith("['drive on a slope")
    # A clock that is corrected anyway is nothing to confirm.
    clock = name("transport_delay", 9.0, corrected=True)
    diagnosis = msgspec.structs.replace(diagnosis, effects=(known, clock))
    done = summarize_knowledge(diagnosis, ["effective_track"])
    assert done["waiting"] == []
    assert done["enough"]
    assert done["drive"] == []
    seen = {
        "log": "run.mcap", "closed": False, "bytes": 1e6, "duration_s": 90.0, "distance_m": 40.0,
        "events": [], "slip_mps": {"command": 0.2}, "error_mps": {}, "problem": "",
        "knowledge": {"until_s": 80.0, **done}, "diagnosing": False, "cpu_share": 0.2,
    }  # fmt: skip
    text = "\n".join(format_watch(seen))
    assert "effective_track: k 1.800 [1.780, 1.820] (known to 1.1 %)" in text
    assert "no more driving is needed" in text
    assert "drive on a slope" not in text


@pytest.mark.parametrize(
    ("effect", "parameter", "value", "is_alarm"),
    [
        ("steering_offset", "o", 0.05, False),
        ("steering_offset", "o", -0.2, True),
        ("steering_gain", "g", 0.45, True),
        ("steering_gain", "g", 1.9, False),
        ("understeer", "K", 0.03, False),
        ("understeer", "K", 0.3, True),
        ("effective_track", "k", 3.9, False),
    ],
)
def test_numbers_beyond_what_learners_on_board_take_are_alarms(
    effect: str,
    parameter: str,
    value: float,
    is_alarm: bool,  # noqa: FBT001 - a case
) -> None:
    number = Value(value, value - 0.01, value + 0.01)
    growth = Growth(Evidence((1.0, 2.0), (1.0, 2.0 * RUNNING_T)))
    diagnosis = RunDiagnosis(effects=(Named(effect, {parameter: number}, growth=growth),))
    assert summarize_knowledge(diagnosis, [])["alarms"] == []
    known = summarize_knowledge(diagnosis, [effect])
    alarms = known["alarms"]
    assert [(one["effect"], one["value"]) for one in alarms] == [(effect, value)] * is_alarm  # type: ignore[attr-defined]
    seen = {
        "log": "run.mcap", "closed": True, "bytes": 1e6, "duration_s": 90.0, "distance_m": 40.0,
        "events": [], "slip_mps": {}, "error_mps": {}, "problem": "", "knowledge": {"until_s": 80.0, **known},
    }  # fmt: skip
    shown = [line for line in format_watch(seen) if line.startswith("alarm")]
    assert len(shown) == is_alarm
    assert all("openpilot's paramsd" in line for line in shown)


def test_a_finished_log_ends_with_its_alarms(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    drive = ("--vehicle", "ackermann_car", "--effect", "steering_offset=0.25", "--duration", "60")
    assert run_verb("simulate", *drive, "--file", log).returncode == 0
    watched = ("watch", log, "--results", tmp_path / "results")
    told = run_verb(*watched)
    (line,) = [line for line in told.stdout.splitlines() if line.startswith("alarm")]
    assert "steering_offset: o = 0.25 rad is outside of -0.17 to 0.17 rad" in line
    final = json.loads(run_verb(*watched, "--json").stdout.splitlines()[-1])
    assert [(one["effect"], one["parameter"]) for one in final["alarms"]] == [("steering_offset", "o")]


def test_looks_leave_more_than_half_a_core() -> None:
    assert LIGHT_SHARE + HEAVY_SHARE < 0.5


@pytest.mark.long
def test_the_answer_of_a_watched_log_is_that_of_the_finished_log(tmp_path: Path) -> None:
    source = make_log(tmp_path / "source.mcap", 100.0, effects={"effective_track": {"k": 1.8}})
    log, results, page = tmp_path / "run" / "run.mcap", tmp_path / "out", tmp_path / "page.html"
    log.parent.mkdir()
    recorder = Recorder(source, [log], 0.6, chunk=1 << 15)
    recorder.begin()
    told = run_verb("watch", str(log), "--json", "--results", str(results), "--page", str(page))
    recorder.join()
    assert told.returncode == 0, told.stderr
    lines = [json.loads(line) for line in told.stdout.splitlines()]
    *looks, final = lines
    assert final["kind"] == "final"
    assert any(one["knowledge"].get("until_s") for one in looks)
    alone = run_verb("diagnose", str(log), "--json", "--results", str(tmp_path / "alone"))
    assert final["runs"] == json.loads(alone.stdout)["runs"]
    assert "location.reload" not in page.read_text()
    assert "effective_track" in page.read_text()


@pytest.mark.long
def test_a_log_whose_name_begins_with_a_dash_is_diagnosed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = make_log(tmp_path / "whole.mcap", 40.0).read_bytes()
    (tmp_path / "-run.mcap").write_bytes(content[: int(0.9 * len(content))])
    monkeypatch.chdir(tmp_path)
    watched = Watch(Path("-run.mcap"), Options(out=tmp_path / "out"), [], 60.0)
    for seen in watched.follow():
        if seen["knowledge"]:
            break
    assert "until_s" in watched.knowledge


def test_notes_that_no_watch_wrote_are_forgotten(tmp_path: Path) -> None:
    log = make_log(tmp_path / "run.mcap", 3.0)
    notes = Store(tmp_path / "out").notes(NOTES)
    offset = Named("steering_offset", {"o": Value(0.3, 0.29, 0.31)}, growth=Growth(Evidence((1.0,), (50.0,))))
    diagnosis = RunDiagnosis(effects=(name("effective_track", 50.0), offset))
    known = {"until_s": 30.0, **summarize_knowledge(diagnosis, ["effective_track", "steering_offset"])}
    assert len(known["alarms"]) == 1  # type: ignore[arg-type]
    for noted, expected in ((known, known), (known | {"until_s": "30"}, {}), (known | {"stated": [5]}, {})):
        notes.write(str(log.resolve()), noted)
        assert Watch(log, Options(out=tmp_path / "out"), [], 5.0).knowledge == expected


@pytest.mark.long
def test_a_watch_that_is_killed_goes_on_from_what_it_knew(tmp_path: Path) -> None:
    source = make_log(tmp_path / "source.mcap", 60.0, effects={"effective_track": {"k": 1.8}})
    log, results = tmp_path / "run" / "run.mcap", tmp_path / "out"
    log.parent.mkdir()
    content = source.read_bytes()
    log.write_bytes(content[: int(0.9 * len(content))])
    command = [sys.executable, "-m", "pipeline", "watch", str(log), "--json", "--results", str(results)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            until = json.loads(line)["knowledge"].get("until_s")
            if until:
                break
        process.send_signal(signal.SIGKILL)
    again = Watch(log, Options(out=results), [], 5.0)
    assert again.knowledge["until_s"] == until
