"""Runs: published whole, never changed, taken over by link, pruned; called anything, never mixed up."""

import unicodedata
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from store_samples import (
    break_windows,
    make_slip,
    make_windows,
    read_current,
    read_seed,
    write_generation,
)

from pipeline.store import Store, StoreError
from pipeline.store.names import LONGEST_PART, check_file_name, encode_run

RUN = "2026/husky"


def test_looking_creates_nothing(store: Store) -> None:
    assert store.manifest(RUN) is None
    assert store.runs() == ()
    assert store.examine().problems == ()
    assert store.prune(0) == ()
    assert not store.root.exists()


def test_nothing_is_seen_before_the_commit_and_nothing_stays_without_one(store: Store) -> None:
    write_generation(store, RUN, "old", 1)
    before = sorted(store.root.rglob("*"))

    def interrupt() -> None:
        with store.open_generation(RUN, "new") as generation:
            generation.write_text("report.html", "half")
            assert read_seed(store, RUN) == 1
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert sorted(store.root.rglob("*")) == before
    assert read_seed(store, RUN) == 1


def test_what_readers_hold_stays_when_a_run_is_written_again_and_goes_when_it_is_pruned(store: Store) -> None:
    written = [write_generation(store, RUN, f"key{seed % 2}", seed) for seed in range(5)]
    home = written[0].home
    assert [int(one.path("summary.json").read_text()) for one in written] == [0, 1, 2, 3, 4]
    assert read_seed(store, RUN) == 4
    assert {path.name for path in store.prune(2)} == {"generation-1", "generation-2"}
    kept = {"generation-3", "generation-4", "generation-5", "latest", "manifest.json", ".lock"}
    assert {path.name for path in home.iterdir()} == kept
    assert (home / "latest").resolve() == written[4].folder
    assert store.prune(2) == ()
    assert {path.name for path in store.prune(0)} == {"generation-3", "generation-4"}
    assert read_seed(store, RUN) == 4
    assert write_generation(store, RUN, "key", 5).number == 6


def test_what_is_taken_over_is_the_same_file_and_never_changes_the_older_one(store: Store) -> None:
    first = write_generation(store, RUN, "one", 1)
    with store.open_generation(RUN, "two") as generation:
        assert generation.previous == first
        for name in ("windows", "slip"):
            generation.reuse_table(name)
        generation.reuse_file("summary.json")
        assert generation.table_names == ("windows", "slip")
        assert generation.read_table("slip").equals(make_slip(RUN, 1))
        assert generation.read_table("windows").height == 498
        with pytest.raises(StoreError, match="'poses'"):
            generation.read_table("poses")
        generation.replace_table("slip", make_slip(RUN, 2))
        with pytest.raises(StoreError, match="500 rows"):
            generation.replace_table("slip", make_slip(RUN, 2, rows=8))
        generation.write_text("summary.json", "2")
        second = generation.commit({})
    for name in ("windows", "quarantine_windows"):
        assert second.path(name).samefile(first.path(name))
    assert second.tables["windows"] == first.tables["windows"]
    assert first.path("summary.json").read_text() == "1\n"
    assert first.read("slip").equals(make_slip(RUN, 1))
    assert second.read("slip").equals(make_slip(RUN, 2))
    with store.open_generation(RUN, "three") as generation:
        generation.reuse_all("summary.json")
        third = generation.commit({})
    assert third.files.keys() == second.files.keys() - {"summary.json"}
    assert store.examine().problems == ()


def test_nothing_is_taken_over_that_is_not_there_or_not_what_was_written(store: Store) -> None:
    with pytest.raises(StoreError, match="'slip"), store.open_generation(RUN, "k") as generation:
        generation.reuse_table("slip")
    path = write_generation(store, RUN, "one", 1).path("slip")
    with store.open_generation(RUN, "two") as generation:
        for reuse, name in (
            (generation.reuse_table, "poses"),
            (generation.reuse_table, "summary.json"),
            (generation.reuse_file, "slip"),
        ):
            with pytest.raises(StoreError) as caught:
                reuse(name)
            assert caught.value.code == "no_such_table"
    data = path.read_bytes()
    path.write_bytes(data[:100] + bytes([data[100] ^ 1]) + data[101:])
    for code in ("file_damaged", "file_missing"):
        with pytest.raises(StoreError) as caught, store.open_generation(RUN, "two") as generation:
            generation.reuse_table("slip")
        assert caught.value.code == code
        path.unlink(missing_ok=True)


@pytest.mark.parametrize("details", [{"x": float("nan")}, {"x": {1, 2}}, {"x": b""}])
def test_details_must_be_json(store: Store, details: dict[str, object]) -> None:
    with pytest.raises(StoreError) as caught, store.open_generation(RUN, "k") as generation:
        generation.commit(details)
    assert caught.value.code == "bad_details"
    assert store.manifest(RUN) is None


def test_a_run_that_is_asked_for_again_says_so_until_it_is_written(store: Store) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    store.ask_again(manifest)
    assert read_seed(store, RUN) == 1
    assert [one.again for one in store.manifests()] == [True]
    write_generation(store, RUN, "k", 1)
    store.ask_again(manifest)
    assert [one.again for one in store.manifests()] == [False]


NASTY = "ab./\\~% é\u0301\u0000\nA\u00e9:%2F\u200d\U0001f600"
NAMES = st.one_of(
    st.text(min_size=1, max_size=300), st.text(NASTY, min_size=1, max_size=8), st.text("a/.", min_size=1)
).filter(lambda name: not any(0xD800 <= ord(character) < 0xE000 for character in name))


@given(NAMES, NAMES)
@example("..", "../../etc/passwd")
@example("/etc/passwd", "/")
@example("a\0b", "é" * 300)
@example("MANIFEST.JSON", "x/latest")
@example("x/generation-3", "x/Generation-3")
@example("a/b/c", "a%2Fb/c")
@example("a", "a ")
@example("\u00e9", "e\u0301")
@example("x" * 300, "x" * 301)
@example("a//b", "a/b")
@example("latest", "%6Catest")
@example("a", "a/")
def test_a_run_has_a_safe_folder_of_its_own(one: str, other: str) -> None:
    for name in (one, other):
        parts = encode_run(name).parts
        assert len(parts) == (2 if "/" in name else 1)
        for part in parts:
            assert part[0] != "."
            assert part[-1] not in ". "
            assert not {"/", "\\", "\0", "\n"} & set(part)
            assert len(part.encode()) <= LONGEST_PART
            assert part.casefold() not in ("manifest.json", "latest", "generation-3")
    folders = [unicodedata.normalize("NFC", str(encode_run(name))) for name in (one, other)]
    assert (folders[0] == folders[1]) == (one == other)


@given(st.from_regex(r"[A-Za-z0-9_][A-Za-z0-9_ :,+=()\[\]é-]{0,40}[A-Za-z0-9]", fullmatch=True))
def test_harmless_names_stay_as_they_are(name: str) -> None:
    if name != unicodedata.normalize("NFC", name) or name.casefold().startswith(("latest", "generation")):
        return
    assert str(encode_run(f"2026-11/{name}")) == f"2026-11/{name}"


@pytest.mark.parametrize("name", ["", "\udcff"])
def test_names_that_cannot_be_written_are_refused(name: str) -> None:
    with pytest.raises(StoreError) as caught:
        encode_run(name)
    assert caught.value.code == "bad_run_name"


def test_nasty_runs_live_side_by_side(store: Store) -> None:
    names = ["..", "a/..", "../a", "a", "a/b", "a/b/c", "A", "é", "e\u0301", "a\0", "x" * 400]
    names += ["a/manifest.json", "a/generation-1", "a/latest", "generation-1"]
    for seed, name in enumerate(names):
        write_generation(store, name, "key", seed)
    assert store.runs() == tuple(sorted(names))
    assert [read_seed(store, name) for name in names] == list(range(len(names)))
    assert store.examine().problems == ()
    assert {path.name for path in store.root.parent.iterdir()} == {"results"}
    assert store.scan("slip").select("run").collect()["run"].n_unique() == len(names)


def test_file_names_stay_inside(store: Store) -> None:
    for name in ["", "../x", "/x", "a//b", ".hidden", "a/.b", "a\0", "a\nb", "x" * 101]:
        with pytest.raises(StoreError):
            check_file_name(name)
    with pytest.raises(StoreError):
        store.write_results_text("../comparison.html", "")


def test_broken_rows_go_to_the_quarantine_with_the_names_of_the_rules(store: Store) -> None:
    frame = break_windows(make_windows("r", 1, rows=6))
    with store.open_generation("r", "k") as generation:
        report = generation.write_table("windows", frame)
        manifest = generation.commit({})
    assert (report.rows, report.quarantined) == (4, 2)
    assert {rule for rule in report.rules if not rule.startswith("t_end|")} == {
        "terrain|nullability",
        "segment|min",
    }
    assert manifest.tables["windows"] == report
    assert read_current(store, "r", "windows")["t_start"].to_list() == [0.0, 4.0, 8.0, 10.0]
    broken = read_current(store, "r", "quarantine_windows")
    assert broken["t_start"].to_list() == [2.0, 6.0]
    assert broken["broken_rules"].to_list()[0] == ["terrain|nullability"]
    assert {"segment|min", "t_end|check"} <= set(broken["broken_rules"].to_list()[1])


def test_text_and_table_of_the_whole_results_are_replaced(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = store.write_results_table("windows", break_windows(make_windows("*", 1, rows=6)))
    assert (report.rows, report.quarantined) == (4, 2)
    assert store.scan("quarantine_windows").collect().height == 2
    store.write_results_table("windows", make_windows("*", 2, rows=8))
    assert store.scan("windows").collect().equals(make_windows("*", 2, rows=8))
    path = store.write_results_text("comparison.html", "é")

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", refuse)
        with pytest.raises(StoreError) as caught:
            store.write_results_text("comparison.html", "new")
    assert caught.value.code == "disk_full"
    assert path.read_bytes() == "é".encode()
    assert {path.name for path in store.root.iterdir()} == {"comparison.html", "windows.parquet", ".lock"}
    store.edit_results_text("comparison.html", str.upper)
    store.edit_results_text("fleet.html", str.upper)
    assert path.read_text() == "É"
    assert not (store.root / "fleet.html").exists()
    path.write_bytes(b"\xff")
    store.edit_results_text("comparison.html", str.upper)
    assert path.read_bytes() == b"\xff"


def test_a_file_that_is_too_large_to_read_is_told_as_that(store: Store) -> None:
    path: Path = store.write_results_text("note.txt", "")
    with path.open("r+b") as file:
        file.truncate(40 << 20)
    with pytest.raises(StoreError, match="it has more than 32 MB") as caught:
        store.edit_results_text("note.txt", str.upper)
    assert caught.value.code == "too_large"
