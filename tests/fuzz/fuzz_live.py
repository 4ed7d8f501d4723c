"""Plays odd servers to a watch; a traceback, a message that is lost, a hang or a heap of files is a find.

    python tests/fuzz/fuzz_live.py --minutes 60 [--seed 1] [--finds folder]

Each case is a server on this machine, of the Foxglove WebSocket protocol or rosbridge, that sends the
messages of a short drive with faults between them: clocks that step, values of another kind, payloads that
are cut, changed schemas, frames outside the protocol, frames that declare lengths they do not have,
connections that break. What the server sent as a message must be in the recording, a look at it must end
without a defect, and so must its analysis. Finds are kept, and the run goes on.
"""

import argparse
import json
import random
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "fixtures"), str(ROOT / "tests" / "live")]

from fuzzing import peak_mb  # noqa: E402 - the repository is put on the path first
from live_servers import (  # noqa: E402 - as above
    OlderFoxgloveServer,
    Played,
    RosbridgeServer,
    _plain,
    read_messages,
)
from mcap_ros2.decoder import DecoderFactory  # noqa: E402 - as above

from pipeline.analysis import Options  # noqa: E402 - as above
from pipeline.analysis.analyze import analyze_log  # noqa: E402 - as above
from pipeline.core import SlipError  # noqa: E402 - as above
from pipeline.live import receiver as live_receiver  # noqa: E402 - as above
from pipeline.live.receiver import LiveReceiver  # noqa: E402 - as above
from pipeline.live.watch import Watch  # noqa: E402 - as above
from pipeline.logs import open_log  # noqa: E402 - as above
from pipeline.logs.live_recording import LiveRecording  # noqa: E402 - as above
from pipeline.simulate import Scenario, simulate_run, write_log  # noqa: E402 - as above

STEPS_S = (3.0, -3.0, 7200.0, -7200.0, 3 * 86_400.0, -3 * 86_400.0, 30 * 365 * 86_400.0, -30 * 365 * 86_400.0)
ODD_VALUES: tuple[object, ...] = (
    *(
        "fast",
        "1.0",
        "NaN",
        "",
        True,
        False,
        None,
        [],
        [1.0],
        {},
        {"x": 1},
        1e308,
        -1e308,
        10**400,
        2**63,
        -1,
    ),
    *("x" * 5000, [[[[]]]], 1e-320),
)
ODD_FRAMES: tuple[str | bytes, ...] = (
    *(
        "",
        "null",
        "[]",
        "{",
        '{"op":null}',
        "{" * 5000,
        '{"op":"publish"}',
        '{"op":"publish","topic":"/odom"}',
    ),
    *(b"", b"\x01", b"\x01\x00\x00", b"\x01" + b"\xff" * 12, b"\x02" + b"\0" * 20, b"\xff" * 4096),
    '{"op":"advertise","channels":[{"id":-1,"topic":"/x","encoding":"cdr","schemaName":"nav_msgs/msg/Odometry"}]}',
    '{"op":"unadvertise","channelIds":[4294967296,-1]}',
    '{"op":"status","level":2,"message":{"deep":[1]}}',
    '{"op":"service_response","service":"/rosapi/topics","values":{"topics":["/a"],"types":[]},"result":true}',
    json.dumps({"op": "status", "level": "error", "msg": "x" * 100_000}),
)
RAW = (
    b"\x82\x7f" + struct.pack(">Q", 1 << 62),  # a frame of four exabytes
    b"\x82\x7f" + struct.pack(">Q", (1 << 63) + 5),  # a length that no frame has
    b"\x82\x7e\xff\xff" + b"abc",  # a frame that is cut
    b"\xf3\x05hello",  # reserved bits and an opcode that is none
    b"\x01\x03abc" * 50,  # fragments that never end
    b"\x81\x04\xff\xfe\xfd\xfc",  # text that is no UTF-8
    b"GET / HTTP/1.1\r\n\r\n",
)
LONGEST_S = 120.0
MOST_MB = 1500
MOST_FILES = 150


@dataclass
class Find:
    """What went wrong in a case."""

    what: str
    trace: str = ""


@dataclass
class Case:
    """One odd server and what became of it."""

    seed: int
    faults: Counter[str] = field(default_factory=Counter)
    sent: int = 0
    outcome: str = ""
    find: Find | None = None


def change_value(content: Any, rng: random.Random) -> None:  # noqa: ANN401 - any JSON
    """Put an odd value somewhere into a message."""
    while True:
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        if not keys:
            return
        key = rng.choice(keys)
        below = content[key]
        if isinstance(below, dict | list) and below and rng.random() < 0.85:
            content = below
            continue
        content[key] = rng.choice(ODD_VALUES)
        return


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Cut a payload, or change some of its bytes."""
    kind = rng.randrange(4)
    if kind == 0:
        return data[: rng.randrange(len(data) + 1)]
    if kind == 1:
        return data + rng.randbytes(rng.randrange(1, 200))
    content = bytearray(data)
    for _ in range(rng.randrange(1, 9)):
        at = rng.randrange(max(len(content) - 8, 1))
        odd = rng.choice(
            [b"\xff\xff\xff\xff", struct.pack("<d", float("nan")), struct.pack("<d", 1e300), b"\0" * 8]
        )
        content[at : at + len(odd)] = odd
    return bytes(content)


class Player:
    """Plays one case: what is sent is counted, faults stand between."""

    def __init__(self, case: Case, messages: list[Played], rng: random.Random) -> None:
        self.case, self.messages, self.rng = case, messages, rng
        self.is_foxglove = rng.random() < 0.5
        kind: Any = OlderFoxgloveServer if self.is_foxglove else RosbridgeServer
        self.server = kind(messages)
        self.step_ns = 0
        self._decoders = DecoderFactory()
        self.is_over: Callable[[], bool] = lambda: False
        self.chance = rng.choice([0.0005, 0.002, 0.01])

    def play(self) -> None:
        """Everything, as fast as it is taken."""
        if not self.server.subscribed.wait(20.0):
            return
        time.sleep(0.3)
        for message in self.messages:
            if self.is_over():
                return
            if self.rng.random() < self.chance:
                self.break_something()
            self.send(message, is_odd=self.rng.random() < self.chance)

    def break_something(self) -> None:
        fault = self.rng.choice(["step", "step", "frame", "frame", "raw", "close", "schema"])
        self.case.faults[fault] += 1
        if fault == "step":
            self.step_ns += round(self.rng.choice(STEPS_S) * 1e9)
        elif fault == "frame":
            self.server.send(self.rng.choice(ODD_FRAMES))
        elif fault == "schema" and self.is_foxglove:
            _, channel, _ = self.rng.choice(self.messages)
            gone = {"op": "unadvertise", "channelIds": [channel.id]}
            name, text = self.rng.choice(
                [
                    ("nav_msgs/msg/Odometry", ""),
                    ("sensor_msgs/msg/Imu", "float64 x"),
                    ("geometry_msgs/msg/Twist", "]["),
                ]
            )
            fresh = {
                "id": channel.id + 1000,
                "topic": channel.topic,
                "encoding": "cdr",
                "schemaName": name,
                "schema": text,
            }
            self.server.send(json.dumps(gone))
            self.server.send(json.dumps({"op": "advertise", "channels": [fresh]}))
        elif fault == "raw":
            self.reconnect(self.rng.choice(RAW))
        elif fault == "close":
            self.reconnect(b"")

    def reconnect(self, raw: bytes) -> None:
        """Break the connection, after bytes that are no frame, and wait for the next one."""
        time.sleep(0.5)  # what was sent before must have been taken
        self.server.subscribed.clear()
        before = self.server.connections
        for client in list(self.server.clients):
            try:
                client.socket.sendall(raw)
                client.socket.shutdown(2)
            except OSError:
                continue
        end = time.monotonic() + 30.0
        while self.server.connections == before or not self.server.subscribed.is_set():
            if time.monotonic() > end or self.is_over():
                return
            time.sleep(0.02)
        time.sleep(0.3)

    def send(self, message: Played, *, is_odd: bool) -> None:
        schema, channel, one = message
        if self.is_foxglove:
            server = cast("OlderFoxgloveServer", self.server)
            if channel.id not in server.numbers:
                return
            data = change_bytes(one.data, self.rng) if is_odd else one.data
            log_time = min(max(one.log_time + self.step_ns, 0), (1 << 64) - 1)
            if is_odd and self.rng.random() < 0.2:
                log_time = self.rng.choice([0, 1, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
            server.send(struct.pack("<BIQ", 1, server.numbers[channel.id], log_time) + data)
        else:
            decode = self._decoders.decoder_for(channel.message_encoding, schema)
            content = _plain(decode(one.data)) if decode else {}
            if self.step_ns and "header" in cast("dict[str, Any]", content):
                stamp = cast("dict[str, Any]", content)["header"]["stamp"]
                stamp["sec"] = max(stamp["sec"] + self.step_ns // 10**9, 0)
            told: dict[str, Any] = {"op": "publish", "topic": channel.topic, "msg": content}
            if is_odd:
                change_value(told["msg"], self.rng)
            self.server.send(json.dumps(told))
        self.case.faults["odd message"] += is_odd
        self.case.sent += 1


def run_case(messages: list[Played], seed: int, folder: Path) -> Case:
    """Play one server, record it, look at it, and analyze what was recorded."""
    begin, before_mb = time.monotonic(), peak_mb()
    case = record_case(messages, seed, folder)
    if case.find is not None:
        return case
    try:
        case.outcome = look(folder, seed)
    except Exception as error:  # noqa: BLE001 - is the find
        case.find = Find(f"a look broke: {type(error).__name__}: {error}", traceback.format_exc())
    count = len(list((folder / "run").glob("*.mcap")))
    if count > MOST_FILES:
        case.find = Find(f"{count} files were written")
    if time.monotonic() - begin > LONGEST_S:
        case.find = Find(f"it took {time.monotonic() - begin:.0f} s")
    # What a case adds to the most memory of this process so far is its own.
    if peak_mb() - before_mb > MOST_MB:
        case.find = Find("it took more memory than it may")
    return case


def record_case(messages: list[Played], seed: int, folder: Path) -> Case:
    """Play one server and record it: no message is lost, and the receiver ends without an error."""
    rng, case = random.Random(seed), Case(seed)  # noqa: S311 - no secret
    player = Player(case, messages, rng)
    errors: list[str] = []
    recording = LiveRecording(folder / "run")
    receiver = LiveReceiver(f"ws://127.0.0.1:{player.server.port}/", recording, {})

    def receive() -> None:
        try:
            receiver.run()
        except Exception:  # noqa: BLE001 - is the find
            errors.append(traceback.format_exc())

    thread = threading.Thread(target=receive, daemon=True)
    thread.start()
    player.is_over = lambda: not thread.is_alive()
    try:
        player.play()
        # What is sent under a changed schema may be left out: then the end is that nothing more comes.
        longest_s = 20.0 if case.faults["schema"] == 0 else 1.0
        heard, since = recording.message_count, time.monotonic()
        while heard < case.sent and time.monotonic() < since + longest_s and thread.is_alive():
            time.sleep(0.05)
            if recording.message_count > heard:
                heard, since = recording.message_count, time.monotonic()
        if case.faults["schema"] == 0 and recording.message_count < case.sent:
            case.find = Find(
                f"{recording.message_count} of {case.sent} messages were recorded ({receiver.note()})"
            )
        receiver.stop()
        thread.join(30.0)
        if thread.is_alive():
            case.find = Find("the receiver does not end")
    finally:
        player.server.close()
    if errors:
        case.find = Find("the receiver broke", errors[0])
    else:
        recording.close()
    return case


def look(folder: Path, seed: int) -> str:
    """Outcome of a look at a recording and of its analysis: a code of an error, or done."""
    path = folder / "run"
    if not path.is_dir():
        return "empty"
    codes = []
    vehicle = {"vehicle": {"preset": "husky_a200"}}
    # Of every fifth, what follows the stages as well.
    whole = seed % 5 == 0
    options = Options(out=folder / "results", report=whole, diagnosis=whole, overrides=vehicle)
    watch = Watch(path, options, (), 1.0)
    watch._log.update()
    for work in (watch._read_end, lambda: analyze_log(path, options)):
        try:
            work()
            codes.append("done")
        except SlipError as error:
            codes.append(error.code)
    open_log(path)
    return ", ".join(codes)


PATCHES = {"_write_state": lambda _: None, "_DELAYS_S": (0.05, 0.1)}
"""A receiver that reports to nobody and connects again at once."""


def prepare(folder: Path) -> list[Played]:
    """Messages of a short drive."""
    source = folder / "source.mcap"
    write_log(simulate_run(Scenario(duration_s=24.0, seed=5)), source)
    return read_messages(source)


def main() -> int:
    """Play servers until the time is up; returns 1 if there are finds."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--finds", type=Path, default=Path("fuzz_finds"))
    asked = parser.parse_args()
    end = time.monotonic() + 60.0 * asked.minutes
    outcomes, faults, finds, seed, sent = Counter[str](), Counter[str](), Counter[str](), asked.seed, 0
    with tempfile.TemporaryDirectory() as top:
        messages = prepare(Path(top))
        for name, value in PATCHES.items():
            setattr(live_receiver, name, value)
        while time.monotonic() < end:
            folder = Path(top) / str(seed)
            folder.mkdir()
            case = run_case(messages, seed, folder)
            outcomes[case.outcome] += 1
            faults += case.faults
            sent += case.sent
            if case.find:
                finds[case.find.what[:160]] += 1
                asked.finds.mkdir(parents=True, exist_ok=True)
                (asked.finds / f"live_{seed}.txt").write_text(f"{case}\n{case.find.trace}\n")
                sys.stdout.write(f"seed {seed}: {case.find.what[:300]}\n")
            seed += 1
    sys.stdout.write(f"{seed - asked.seed} servers, {sent} messages, faults {dict(faults)}\n")
    sys.stdout.write(f"outcomes {dict(outcomes)}\nfinds {dict(finds)}\n")
    return int(bool(finds))


if __name__ == "__main__":
    sys.exit(main())
