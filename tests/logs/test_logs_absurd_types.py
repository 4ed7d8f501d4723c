"""Definitions that somebody made to break a reader: one error, at once."""

import time
from pathlib import Path

import pytest

from pipeline.logs import LogError, open_log
from pipeline.logs.index import find_parts
from pipeline.logs.schema import SchemaError, parse_idl, parse_msg

LINE = "=" * 80
MANY = 100_000
NINES = "9" * 5000


def doubling(levels: int) -> str:
    """A type of two fields of a type of two fields of ..."""
    sections = [f"demo/T{level} a\ndemo/T{level} b\n" for level in range(1, levels)]
    named = [f"{LINE}\nMSG: demo/T{level}\n{text}" for level, text in enumerate(sections[1:], start=1)]
    return "".join([sections[0], *named, f"{LINE}\nMSG: demo/T{levels - 1}\nfloat64 x\n"])


MSG = {
    "a type that holds itself": "demo/T a\n",
    "types that hold each other": f"demo/A a\n{LINE}\nMSG: demo/A\ndemo/B b\n{LINE}\nMSG: demo/B\ndemo/A a\n",
    "a type nested too deep": "demo/A0 a\n"
    + "".join(f"{LINE}\nMSG: demo/A{n}\ndemo/A{n + 1} a\n" for n in range(2000)),
    "2 to the 60 fields": doubling(60),
    "an array of 10 to the 12": "float64[1000000000000] x\n",
    "an array of 5,000 digits": f"float64[{NINES}] x\n",
    "arrays of arrays": f"demo/A[10000] a\n{LINE}\nMSG: demo/A\n"
    f"demo/B[10000] b\n{LINE}\nMSG: demo/B\nfloat64 x\n",
    "a field of 100,000 letters that is none": "x" * MANY,
}
IDL = {
    "modules nested too deep": "module a {" * 5000,
    "sequences nested too deep": "module demo { struct T { "
    + "sequence<" * 5000
    + "long"
    + ">" * 5000
    + " x; }; };",
    "an array of 5,000 digits": f"module demo {{ struct T {{ long x[{NINES}]; }}; }};",
    "an array of many sides": "module demo { struct T { long x" + "[999999999]" * 5000 + "; }; };",
    "a constant of 5,000 digits": f"const long N = {NINES}; module demo {{ struct T {{ long x[N]; }}; }};",
    "digits that are no number": "module demo { struct T { long x[\u00b2]; }; };",
    "comments that never end": "/*" * MANY,
    "strings that never end": '"' + '\\"' * MANY,
    "characters that never end": "'\\" * MANY,
    "blank lines": "\n" * MANY + "x",
    "annotations that never end": "@a(" * MANY,
    "a type that holds itself": "module demo { struct T { demo::T x; }; };",
    "a type definition of itself": "typedef demo::T T; module demo { struct T { T x; }; };",
}


def refuse(parse: object, text: str) -> None:
    started = time.process_time()
    with pytest.raises(SchemaError) as caught:
        parse("demo/msg/T", text)  # type: ignore[operator]
    assert time.process_time() - started < 5.0
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", MSG)
def test_an_absurd_message_definition_is_refused(name: str) -> None:
    refuse(parse_msg, MSG[name])


@pytest.mark.parametrize("name", IDL)
def test_an_absurd_idl_definition_is_refused(name: str) -> None:
    refuse(parse_idl, IDL[name])


def test_quotes_in_comments_and_slashes_in_strings_change_nothing() -> None:
    text = """// he said "so
    /* and " so */ module demo { module msg { struct T { @verbatim (text="http://x /* \\" ")
    double x; // it's
    @default (value='a') char c; }; }; };"""
    assert [member.name for member in parse_idl("demo/msg/T", text).members] == ["x", "c"]


@pytest.mark.parametrize(
    "text",
    [
        "\n" * MANY,
        "relative_file_paths:\n" + "  - [\n" * MANY,
        "{" * MANY,
        "relative_file_paths:\n" * MANY,
        "- " * MANY,
    ],
)
def test_an_absurd_listing_costs_no_time(text: str, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(text)
    (tmp_path / "bag_0.mcap").write_bytes(b"x")
    started = time.process_time()
    assert find_parts(tmp_path)[0] == [tmp_path / "bag_0.mcap"]
    assert time.process_time() - started < 5.0


def test_a_huge_listing_is_no_listing(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_bytes(b"#" * (5 << 20))
    with pytest.raises(LogError, match=r"metadata\.yaml holds 5\.2 MB"):
        open_log(tmp_path)


def test_blank_lines_between_the_files_of_a_listing_are_none(tmp_path: Path) -> None:
    names = ["bag_0.mcap", "bag_1.mcap"]
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "metadata.yaml").write_text(
        "a:\n  relative_file_paths:\n\n    - bag_0.mcap\n  \n    - bag_1.mcap\n  b: 1\n"
    )
    assert [path.name for path in find_parts(tmp_path)[0]] == names


def test_a_folder_that_is_named_like_a_file_is_none(tmp_path: Path) -> None:
    (tmp_path / "extracted_from.mcap").mkdir()
    (tmp_path / "bag_0.mcap").write_bytes(b"x")
    assert find_parts(tmp_path)[0] == [tmp_path / "bag_0.mcap"]
    (tmp_path / "bag_0.mcap").unlink()
    with pytest.raises(LogError, match="the folder holds no recording"):
        open_log(tmp_path)
