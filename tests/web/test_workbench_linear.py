"""A megabyte of whatever somebody wrote takes a moment to refuse: no pattern looks at it twice."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from few import few

from pipeline.core import SlipError
from pipeline.logs import columns, index, schema
from pipeline.logs import schema as idl
from pipeline.models.parameter import parse_unit
from pipeline.recording import drive, pose_choice
from pipeline.sources import Signal, candidates, read_description
from pipeline.sources import layers as sources
from pipeline.web.cards import make_formula
from pipeline.web.jobs import clean_name

LENGTH = 1_000_000
LONGEST_S = 3.0
PIECES = (
    "/* ", "\n", " \n", '"', '\\"', "\\'", "//", "<", "[", " ", "1", "=", "===\n", "a", "_", "- \n", "m*",
    "`$", "value '", "left_", "#", "_1", "IDL:", ",", "0 .. ",
)  # fmt: skip
READERS: dict[str, tuple[str, Callable[[str], object]]] = {
    "idl": ('"', lambda text: idl.parse_idl("a/B", text)),
    "msg": ("a", lambda text: schema.parse_msg("a/B", text)),
    "metadata.yaml": ("relative_file_paths:\n", index._listed_files),
    "file name": ("_", lambda text: index.split_number(Path(text))),
    "indexed field": ("[", columns._INDEXED.match),
    "unit": ("m", lambda text: parse_unit(text, "")),
    "configuration": ("[", sources._read_header),
    "complaint": ("at `$", lambda text: sources._find(sources._PLACE, text)),
    "topic": ("/", candidates.is_localization),
    "pose frame": ("/", pose_choice._FIXED_FRAME.search),
    "field path": ("[1].", lambda text: Signal.parse(f"/topic.{text}").fields()),
    "robot description": ("<robot>", read_description),
    "joint": ("_", drive._LEFT.search),
    "parameters": ("c [1] ", lambda text: make_formula("own", "v_w", "c * w0", text)),
    "formula": ("c * ", lambda text: make_formula("own", "v_w", text, "c [1] 0 .. 1")),
    "upload": ("", clean_name),
}


@pytest.mark.parametrize("reader", few(READERS, 4))
def test_a_megabyte_is_read_or_refused_in_a_moment(reader: str) -> None:
    start, read = READERS[reader]
    for piece in PIECES:
        text = f"{start}{piece * (LENGTH // len(piece))}!"
        started = time.process_time()
        with contextlib.suppress(SlipError, schema.SchemaError):
            read(text)
        assert time.process_time() - started < LONGEST_S, piece


def test_a_definition_with_comments_and_quotes_is_still_read() -> None:
    text = """
    // a wheel of 5" and a robot's arm
    # a line of the old kind
    module a { module msg {
      /* until "here */
      @verbatim (language="comment", text="it's // no comment /* at all")
      struct B { double x; sequence<string> s; /* y */ long y[3]; };
    }; };
    """
    members = idl.parse_idl("a/msg/B", text).members
    assert [member.name for member in members] == ["x", "s", "y"]
