import math
from pathlib import Path

import pytest

from pipeline.core.untrusted import mapping_in, number_in, numbers_in, objects_in, read_object


def test_only_a_finite_number_is_a_number() -> None:
    for value, number in [
        (2, 2.0),
        (-0.5, -0.5),
        (True, None),
        ("2", None),
        (None, None),
        (math.nan, None),
        (-math.inf, None),
        (10**400, None),
    ]:
        assert number_in({"size": value}, "size") == number
        assert numbers_in({"sizes": [value, 1]}, "sizes") == [number, 1.0]


def test_what_is_missing_or_of_another_kind_is_left_out() -> None:
    source = {"one": {"a": 1}, "many": [{"a": 1}, 2, "text", {"b": 2}], "text": "text"}
    assert number_in(source, "none") is None
    assert mapping_in(source, "one") == {"a": 1}
    assert objects_in(source, "many") == [{"a": 1}, {"b": 2}]
    assert [objects_in(source, key) for key in ("none", "one", "text")] == [[], [], []]
    assert [mapping_in(source, key) for key in ("none", "many", "text")] == [{}, {}, {}]
    assert [numbers_in(source, key) for key in ("none", "one", "text")] == [[], [], []]


@pytest.mark.parametrize(
    "data", [b"", b"[1]", b"{", b'{"a": "\xff"}', b"[" * 100_000, b'{"a":' * 100_000, None]
)
def test_a_file_without_an_object_that_can_be_read_is_empty(tmp_path: Path, data: bytes | None) -> None:
    path = tmp_path / "content.json"
    if data is not None:
        path.write_bytes(data)
    assert read_object(path) == {}
    path.write_bytes(b'{"a": [1, null]}')
    assert read_object(path) == {"a": [1, None]}
