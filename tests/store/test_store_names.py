"""A run may be called anything; its folder is safe, readable and its own."""

import shutil
import unicodedata
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from store_samples import write_generation

from pipeline.store import Store, StoreError
from pipeline.store.names import LONGEST_PART, check_file_name, check_key, encode_run

NASTY = "ab./\\~% é\u0301\u0000\nA\u00e9:%2F\u200d\U0001f600"
NAMES = st.one_of(
    st.text(min_size=1, max_size=300), st.text(NASTY, min_size=1, max_size=8), st.text("a/.", min_size=1)
).filter(lambda name: not any(0xD800 <= ord(character) < 0xE000 for character in name))


@given(NAMES)
@example("..")
@example("../../etc/passwd")
@example("/etc/passwd")
@example("a//b")
@example("a/")
@example("/")
@example("a\0b")
@example("é" * 300)
@example("MANIFEST.JSON")
@example("x/latest")
def test_folder_is_one_or_two_safe_parts(name: str) -> None:
    parts = encode_run(name).parts
    assert len(parts) == (2 if "/" in name else 1)
    for part in parts:
        assert part
        assert part[0] != "."
        assert part[-1] not in ". "
        assert not {"/", "\\", "\0", "\n"} & set(part)
        assert len(part.encode()) <= LONGEST_PART
        assert part.casefold() not in ("manifest.json", "latest")
    root = Path("/results/runs")
    assert (root / encode_run(name)).resolve().is_relative_to(root)


@given(NAMES, NAMES)
@example("a/b/c", "a%2Fb/c")
@example("a", "a ")
@example("\u00e9", "e\u0301")
@example("x" * 300, "x" * 301)
@example("a//b", "a/b")
@example("latest", "%6Catest")
@example("a", "a/")
def test_different_names_have_different_folders(one: str, other: str) -> None:
    folders = [unicodedata.normalize("NFC", str(encode_run(name))) for name in (one, other)]
    assert (folders[0] == folders[1]) == (one == other)


@given(st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_ :,+=()\[\]é-]{0,40}[A-Za-z0-9]", fullmatch=True))
def test_harmless_names_stay_as_they_are(name: str) -> None:
    if name != unicodedata.normalize("NFC", name) or name.casefold() == "latest":
        return
    assert str(encode_run(f"2026-11/{name}")) == f"2026-11/{name}"


@pytest.mark.parametrize("name", ["", "\udcff"])
def test_names_that_cannot_be_written_are_refused(name: str) -> None:
    with pytest.raises(StoreError) as caught:
        encode_run(name)
    assert caught.value.code == "bad_run_name"


def test_nasty_runs_live_side_by_side(store: Store) -> None:
    names = [
        "..",
        "a/..",
        "../a",
        "a",
        "a/b",
        "a/b/c",
        "A",
        "é",
        "e\u0301",
        "a\0",
        "x" * 400,
        "a/manifest.json",
    ]
    for seed, name in enumerate(names):
        write_generation(store, name, "key", seed)
    assert store.runs() == tuple(sorted(names))
    for seed, name in enumerate(names):
        manifest = store.manifest(name)
        assert manifest is not None
        assert manifest.details == {"seed": seed}
    assert {path.name for path in store.root.parent.iterdir()} == {"results"}
    assert store.scan("slip").select("run").collect()["run"].n_unique() == len(names)


def test_disk_that_ignores_case_gives_an_error_not_the_other_run(store: Store) -> None:
    manifest = write_generation(store, "Run", "key", 1)
    shutil.copytree(manifest.folder.parent, manifest.folder.parents[1] / "run", symlinks=True)
    with pytest.raises(StoreError, match="'run' and of 'Run'") as caught:
        store.manifest("run")
    assert caught.value.code == "name_clash"


def test_run_named_like_a_generation_is_refused(store: Store) -> None:
    write_generation(store, "a", "0123abcd", 1)
    with pytest.raises(StoreError) as caught:
        write_generation(store, "a/0123abcd", "key", 2)
    assert caught.value.code == "name_clash"
    write_generation(store, "b/0123abcd", "key", 3)
    assert write_generation(store, "b", "0123abcd", 4).folder.name == "0123abcd.2"
    assert store.runs() == ("a", "b", "b/0123abcd")


def test_keys_are_plain_words() -> None:
    for key in ["", ".", "..", "a/b", "a.2", "-a", "a" * 65, "é"]:
        with pytest.raises(StoreError):
            check_key(key)


def test_file_names_stay_inside() -> None:
    for name in ["", "../x", "/x", "a//b", ".hidden", "a/.b", "a\0", "a\nb", "x" * 101]:
        with pytest.raises(StoreError):
            check_file_name(name)
