"""Throws damaged files and random types at the reader; anything but data or one clear error is a find.

    python tests/fuzz/fuzz_logs.py --minutes 60 [--seed 1] [--finds folder]

Each case is a small valid log of some kind with a few bytes changed, removed, doubled or mixed with
another log. Memory is limited, a warning is an error, and a case that takes longer than 20 s ends the run
with a traceback. A case that fails is kept in the folder of finds.
"""

import random
import sys
import tempfile
import time
import warnings
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "fixtures")]

import numpy as np  # noqa: E402 - the repository is put on the path first
from bag_files import BagWriter, write_bag, write_db3  # noqa: E402
from fuzzing import keep_failure, run_script  # noqa: E402
from google.protobuf.descriptor_pb2 import FileDescriptorSet  # noqa: E402
from google.protobuf.struct_pb2 import Value  # noqa: E402
from mcap.writer import CompressionType, IndexType, Writer  # noqa: E402

from pipeline.logs import LogError, TransformBuffer, Wanted, definition_text, open_log, read_topics  # noqa: E402
from pipeline.logs.schema import (  # noqa: E402
    SchemaError,
    parse_idl,
    parse_msg,
)
from pipeline.logs.writer import LogWriter  # noqa: E402

START = 1_700_000_000_000_000_000
HANG_S = 20
MEMORY = 3 << 30
NUMBERS = (
    0,
    1,
    2,
    0x7F,
    0x80,
    0xFF,
    0xFFFF,
    1 << 20,
    1 << 31,
    (1 << 32) - 1,
    1 << 40,
    1 << 60,
    (1 << 64) - 1,
)
NESTED = (
    "uint8 a\ndemo/In[] items\nstring[] words\nfloat64[3] x\n"
    + "=" * 80
    + "\nMSG: demo/In\nstring n\nfloat32[] v\n"
)
IDL = "module demo { module msg { struct T { double x; sequence<string> s; long y[3]; }; }; };"


def write_seeds(folder: Path) -> list[bytes]:
    """Valid logs of every kind."""
    seeds = []
    times = START + np.arange(12) * 10_000_000
    for compression in ("zstd", "lz4", ""):
        path = folder / "seed.mcap"
        with LogWriter(path, chunk_size=600, compression=compression) as writer:
            writer.metadata("deployment", {"vehicle": "husky"})
            names = {"name": ["l", "r"], "velocity": np.ones((12, 2)), "header.frame_id": "base"}
            writer.write_columns("/joints", "sensor_msgs/msg/JointState", times, names, header_time=times)
            writer.write_columns(
                "/text", "std_msgs/msg/String", times, {"data": [f"t{i}" for i in range(12)]}
            )
            frames = {"transforms[].child_frame_id": ["a", "b"] * 6, "transforms[].header.frame_id": "map"}
            writer.write_columns("/tf", "tf2_msgs/msg/TFMessage", times, frames, header_time=times)
            writer.write_columns("/nested", "demo/msg/T", times, {"x": np.ones((12, 3))}, definition=NESTED)
        seeds.append(path.read_bytes())
    for options in (
        {"use_chunking": False},
        {"use_chunking": False, "enable_data_crcs": True},
        {"enable_crcs": False, "compression": CompressionType.NONE},
        {"enable_crcs": False, "compression": CompressionType.NONE, "enable_data_crcs": True},
        {"enable_crcs": False, "compression": CompressionType.ZSTD},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
    ):
        path = folder / "seed.mcap"
        with path.open("wb") as stream:
            writer2 = Writer(stream, chunk_size=400, **options)
            writer2.start()
            text = (definition_text("std_msgs/msg/String") or "").encode()
            kinds = (("ros2msg", text, "cdr"), ("ros1msg", text, "ros1"), ("jsonschema", b"{}", "json"))
            bodies = (b"\0\1\0\0\3\0\0\0ab\0", b"\2\0\0\0ab", b'{"a": [1, {"b": "c"}]}')
            channels = [
                writer2.register_channel(f"/{m}", m, writer2.register_schema("std_msgs/msg/String", e, t))
                for e, t, m in kinds
            ]
            idl = writer2.register_schema("demo/msg/T", "ros2idl", IDL.encode())
            channels.append(writer2.register_channel("/idl", "cdr", idl))
            buf = writer2.register_schema("google.protobuf.Value", "protobuf", describe_value())
            channels.append(writer2.register_channel("/protobuf", "protobuf", buf))
            bodies = (*bodies, b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\2\0\0\0q\0\0\0" + bytes(12))
            bodies = (*bodies, b"\x32\x0d\x0a\x0b\x11" + bytes(8) + b"\x08\0")
            for number in range(25):
                time_ns = START + number
                writer2.add_message(channels[number % 5], time_ns, bodies[number % 5], time_ns)
            writer2.finish()
        seeds.append(path.read_bytes())
    bags = Path(tempfile.mkdtemp(dir=folder))
    forms = (None, *BagWriter.CompressionFormat)
    seeds += [write_bag(bags / f"{form}.bag", form).read_bytes() for form in forms]
    seeds += [file.read_bytes() for file in write_db3(bags / "run").glob("*.db3")]
    return seeds


def describe_value() -> bytes:
    """The definition of a protobuf type that holds itself, in lists and in maps."""
    files = FileDescriptorSet()
    Value.DESCRIPTOR.file.CopyToProto(files.file.add())
    return files.SerializeToString()


def mutate(seeds: list[bytes], rng: random.Random) -> bytes:
    """One damaged log."""
    content = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        if len(content) < 16:
            break
        place = rng.randrange(len(content) - 8)
        size = rng.choice((1, 2, 4, 8))
        span = rng.randrange(1, min(400, len(content) - place))
        kind = rng.randrange(8)
        if kind <= 1:
            content[place] ^= 1 << rng.randrange(8)
        elif kind == 2:
            content[place : place + size] = (rng.choice(NUMBERS) % (1 << 8 * size)).to_bytes(size, "little")
        elif kind == 3:
            del content[place : place + span]
        elif kind == 4:
            content[place:place] = content[place : place + span]
        elif kind == 5:
            other = rng.choice(seeds)
            start = rng.randrange(len(other))
            content[place : place + span] = other[start : start + span]
        elif kind == 6:
            content[place : place + span] = bytes(span)
        else:
            del content[place:]
    return bytes(content)


def check_log(path: Path) -> None:
    """Read everything of a log; raises for anything but a ``LogError``."""
    try:
        index = open_log(path)
        data = read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1, sha256="-")
    except LogError as error:
        if "\n" in str(error):
            raise AssertionError(f"the error is no single line: {error}") from error
        return
    for columns in data.topics:
        for name, column in columns.fields.items():
            if len(column) != len(columns):
                raise AssertionError(f"{name} has {len(column)} rows of {len(columns)}")
        if (np.diff(columns.log_time) < 0).any():
            raise AssertionError("the messages are not in order")
    TransformBuffer(data.topics)


def check_definition(rng: random.Random) -> None:
    """Parse a damaged definition; raises for anything but a ``SchemaError``."""
    idl = rng.random() < 0.5
    text = list(IDL if idl else NESTED)
    for _ in range(rng.randrange(1, 6)):
        place = rng.randrange(len(text))
        if rng.random() < 0.5:
            del text[place : place + rng.randrange(1, 20)]
        else:
            text.insert(place, rng.choice("{}[]<>;:=#@ \n9/aA_\"'é"))
        text = text or ["x"]
    try:
        (parse_idl if idl else parse_msg)("demo/msg/T", "".join(text))
    except SchemaError:
        return


def run(seconds: float, seed: int, finds: Path | None) -> int:
    """Try cases for some time; the count of them.

    Raises:
        BaseException: whatever a case raised, after keeping it.
    """
    rng = random.Random(seed)  # noqa: S311 - no secret
    cases = 0
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        seeds = write_seeds(Path(folder))
        path = Path(folder) / "case.mcap"
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            case = mutate(seeds, rng)
            path.write_bytes(case)
            with keep_failure(finds, f"find_{seed}_{cases}.mcap", case, hang_s=HANG_S):
                check_log(path)
                check_definition(rng)
            cases += 1
    return cases


if __name__ == "__main__":
    raise SystemExit(run_script(__doc__, MEMORY, run))
