"""Every value is the one that the official reader returns."""

# ruff: noqa: ANN401 - columns and messages come in many shapes
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_files import SHARED, assert_equals_official, payloads, write_channels
from mcap_ros2 import _dynamic
from mcap_ros2._cdr import CdrWriter, EncapsulationKind

from pipeline.logs import (
    LogError,
    Ragged,
    RaggedStrings,
    Wanted,
    bundled_types,
    definition_text,
    open_log,
    read_topics,
)
from pipeline.logs.schema import SEQUENCE, SIZES, Structure, bundled_structure

LOGS = sorted((SHARED / "logs").glob("*.mcap"))
CORPUS = sorted((SHARED / "mcap_corpus").rglob("*.mcap"))
needs_shared = pytest.mark.skipif(not LOGS, reason="the shared recordings are not here")


@needs_shared
def test_a_field_recording_equals_the_official_reader() -> None:
    smallest = min(LOGS, key=lambda path: path.stat().st_size)
    assert assert_equals_official(smallest) > 1000


@pytest.mark.long
@needs_shared
@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_all_field_recordings_equal_the_official_reader(path: Path) -> None:
    assert assert_equals_official(path) > 1000


def official_count(path: Path) -> int | None:
    try:
        with path.open("rb") as stream:
            return sum(isinstance(record, Message) for record in StreamReader(stream).records)
    except McapError:
        return None


@needs_shared
def test_every_file_of_the_corpus_is_read_to_its_end_or_refused() -> None:
    refused = []
    for path in CORPUS:
        try:
            index = open_log(path)
        except LogError as error:
            refused.append((path.name, str(error).count("\n")))
            continue
        assert index.message_count == official_count(path), path
        data = read_topics(index, [Wanted(topic) for topic in index.topics()], threads=1)
        channels = {channel.id: channel.message_count for channel in index.channels}
        got = Counter({columns.channel_id: len(columns) for columns in data.topics})
        assert all(got[number] == channels[number] for number in got), path
        assert {loss.kind for loss in data.losses} <= {"unsupported_encoding"}, path
    assert refused == [("keelson_2024-05-15.mcap", 0)]


@needs_shared
def test_bags_of_the_ros_2_recorder_equal_the_official_reader() -> None:
    for path in CORPUS:
        if "talker" in path.name or "wbag_0" in path.name or "base_msgs" in path.name:
            assert assert_equals_official(path) > 0


def values_of(
    structure: Structure, rows: int, draw: Any, prefix: str = "", counts: Any = None
) -> dict[str, Any]:
    """Random columns for every leaf of a type."""
    found: dict[str, Any] = {}
    for member in structure.members:
        path = f"{prefix}{member.name}"
        if isinstance(member.element, Structure):
            inner = counts
            if member.count is not None:
                if counts is not None:
                    continue
                several = member.count == SEQUENCE
                drawn = draw(st.lists(st.integers(0, 3), min_size=rows, max_size=rows)) if several else None
                inner = np.full(rows, member.count) if drawn is None else np.array(drawn)
            below = f"{path}{'[]' if member.count is not None else ''}."
            found |= values_of(member.element, rows, draw, below, inner)
            continue
        if member.count == SEQUENCE and counts is not None:
            continue
        own = (
            np.array(draw(st.lists(st.integers(0, 4), min_size=rows, max_size=rows)))
            if member.count == SEQUENCE
            else None
        )
        sizes = counts if counts is not None else own
        total = rows if sizes is None else int(sizes.sum())
        seed = draw(st.integers(0, 2**32 - 1))
        rng = np.random.default_rng(seed)
        offsets = None if sizes is None else np.append(0, np.cumsum(sizes))
        if member.element == "string":
            texts = tuple(
                draw(
                    st.lists(
                        st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=9),
                        min_size=3,
                        max_size=3,
                    )
                )
            )
            codes = rng.integers(0, 3, size=total).astype(np.int32)
            found[path] = (
                [texts[c] for c in codes] if offsets is None else RaggedStrings(codes, texts, offsets)
            )
            continue
        width = (member.count,) if member.count not in (None, SEQUENCE) else ()
        values = random_numbers(member.element, (total, *width), rng)
        found[path] = values if offsets is None else Ragged(values, offsets)
    return found


def random_numbers(kind: str, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    raw = rng.integers(0, 256, size=(*shape, SIZES[kind]), dtype=np.uint8)
    if kind == "bool":
        return raw[..., 0] > 127
    return raw.view(np.dtype(kind)).reshape(shape)


@pytest.mark.parametrize("kind", [kind for kind in bundled_types() if "Empty" not in kind])
@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_random_messages_of_every_bundled_type_equal_the_official_reader(
    tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    structure = bundled_structure(kind)
    assert structure is not None
    rows = data.draw(st.integers(1, 40))
    encoded = payloads(kind, rows, values_of(structure, rows, data.draw))
    path = tmp_path / "log.mcap"
    text = (definition_text(kind) or "").encode()
    write_channels(
        path,
        [("/x", kind, "ros2msg", text, "cdr", encoded)],
        chunk_size=data.draw(st.sampled_from([50, 10**6])),
    )
    assert assert_equals_official(path) == rows


NESTED = """uint8 a
demo/Inner[] items
demo/Inner[2] pair
demo/Points points
string[] words
string[2] two
bool[3] flags
================================================================================
MSG: demo/Inner
uint8 tag
float64[] list
string name
================================================================================
MSG: demo/Points
demo/Point[] points
demo/Skewed[] skewed
int64 last
================================================================================
MSG: demo/Point
float64 x
uint8 flag
================================================================================
MSG: demo/Skewed
uint8 flag
float64 x
"""


def nested_message(rng: np.random.Generator) -> Any:
    def inner() -> dict[str, Any]:
        return {
            "tag": int(rng.integers(256)),
            "list": rng.normal(size=rng.integers(4)).tolist(),
            "name": "n" * int(rng.integers(5)),
        }

    def point() -> dict[str, Any]:
        return {"x": float(rng.normal()), "flag": int(rng.integers(256))}

    return {
        "a": int(rng.integers(256)),
        "items": [inner() for _ in range(rng.integers(4))],
        "pair": [inner(), inner()],
        "points": {
            "points": [point() for _ in range(rng.integers(4))],
            "skewed": [point() for _ in range(rng.integers(4))],
            "last": int(rng.integers(2**60)),
        },
        "words": ["w" * int(rng.integers(6)) for _ in range(rng.integers(4))],
        "two": ["x", "y" * int(rng.integers(3))],
        "flags": [True, False, bool(rng.integers(2))],
    }


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 30), orders=st.sets(st.integers(0, 1), min_size=1))
def test_nested_sequences_of_the_official_encoder_are_read(
    tmp_path: Path, seed: int, rows: int, orders: set[int]
) -> None:
    encode = _dynamic.serialize_dynamic("demo/msg/Outer", NESTED)["demo/msg/Outer"]
    rng = np.random.default_rng(seed)
    encoded = []
    for _ in range(rows):
        kind = EncapsulationKind(int(rng.choice(sorted(orders))))
        with mock.patch.object(_dynamic, "CdrWriter", partial(CdrWriter, kind=kind)):
            encoded.append(encode(nested_message(rng)))
    path = tmp_path / "log.mcap"
    write_channels(path, [("/x", "demo/msg/Outer", "ros2msg", NESTED.encode(), "cdr", encoded)])
    assert assert_equals_official(path) == rows
