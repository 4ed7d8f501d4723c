"""Generations: published whole, never changed, reused by link, pruned on demand."""

import json
from collections.abc import Callable

import pytest
from store_samples import break_windows, make_slip, make_windows, read_seed, write_generation

from pipeline.store import Generation, Manifest, Store, StoreError, TableReport

RUN = "2026/husky"


def test_looking_creates_nothing(store: Store) -> None:
    assert store.manifest(RUN) is None
    assert store.runs() == ()
    assert store.examine().problems == ()
    assert store.prune(0) == ()
    with pytest.raises(StoreError, match="no results of '2026/husky'"):
        store.read(RUN, "slip")
    assert not store.root.exists()


def test_nothing_is_seen_before_the_commit_and_nothing_stays_without_one(store: Store) -> None:
    with store.open_generation(RUN, "k") as generation:
        generation.write_text("report.html", "<html>")
        assert store.manifest(RUN) is None
    assert store.manifest(RUN) is None
    assert [path.name for path in (store.root / "runs" / RUN).iterdir()] == [".lock"]


def test_same_key_again_never_leaves_readers_without_files(store: Store) -> None:
    first = write_generation(store, RUN, "k", 1)
    before = first.read("slip")
    second = write_generation(store, RUN, "k", 2)
    assert (first.key, second.key) == ("k", "k")
    assert first.folder != second.folder
    assert first.read("slip").equals(before)
    assert read_seed(store, RUN) == 2


def test_reuse_links_the_file_and_its_quarantine(store: Store) -> None:
    first = write_generation(store, RUN, "one", 1)
    with store.open_generation(RUN, "two") as generation:
        assert generation.previous == first
        assert generation.reuse_table("windows") == generation_report(first)
        generation.reuse_file("summary.json")
        generation.write_table("slip", make_slip(RUN, 9))
        second = generation.commit({})
    for name in ("windows", "quarantine_windows", "summary.json"):
        assert second.path(name).samefile(first.path(name))
    assert second.tables["windows"] == first.tables["windows"]
    assert second.path("slip").read_bytes() != first.path("slip").read_bytes()
    assert store.examine().problems == ()


def generation_report(manifest: Manifest) -> TableReport:
    entry = manifest.tables["windows"]
    return TableReport(rows=entry.rows, quarantined=entry.quarantined, rules=entry.rules)


def test_reuse_refuses_what_is_not_there_or_not_what_was_written(store: Store) -> None:
    with (
        pytest.raises(StoreError, match="no 'slip' to take over"),
        store.open_generation(RUN, "k") as generation,
    ):
        generation.reuse_table("slip")
    manifest = write_generation(store, RUN, "one", 1)
    with store.open_generation(RUN, "two") as generation:
        for reuse, name in (
            (generation.reuse_table, "poses"),
            (generation.reuse_table, "summary.json"),
            (generation.reuse_file, "slip"),
        ):
            with pytest.raises(StoreError) as caught:
                reuse(name)
            assert caught.value.code == "no_such_table"
    path = manifest.path("slip")
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    with pytest.raises(StoreError) as caught, store.open_generation(RUN, "two") as generation:
        generation.reuse_table("slip")
    assert caught.value.code == "file_damaged"
    path.unlink()
    with pytest.raises(StoreError) as caught, store.open_generation(RUN, "two") as generation:
        generation.reuse_table("slip")
    assert caught.value.code == "file_missing"


@pytest.mark.parametrize(
    "write",
    [
        lambda generation: generation.write_text("summary.json", "again"),
        lambda generation: generation.write_table("slip", make_slip(RUN, 2)),
        lambda generation: generation.write_bytes("slip.parquet", b""),
        lambda generation: generation.reuse_table("slip"),
    ],
)
def test_writing_twice_never_reaches_an_older_generation(
    store: Store, write: Callable[[Generation], object]
) -> None:
    first = write_generation(store, RUN, "one", 1)
    with store.open_generation(RUN, "two") as generation:
        generation.reuse_table("slip")
        generation.reuse_file("summary.json")
        with pytest.raises(StoreError) as caught:
            write(generation)
        generation.commit({})
    assert caught.value.code == "written_twice"
    assert store.examine().problems == ()
    assert first.path("summary.json").read_text() == "1\n"


def test_stages_read_what_the_ones_before_wrote(store: Store) -> None:
    write_generation(store, RUN, "one", 1)
    with store.open_generation(RUN, "two") as generation:
        assert generation.table_names == ()
        generation.reuse_table("slip")
        generation.write_table("windows", break_windows(make_windows(RUN, 2)))
        assert generation.table_names == ("slip", "windows")
        assert generation.read_table("slip").equals(make_slip(RUN, 1))
        assert generation.read_table("windows").height == 498
        with pytest.raises(StoreError, match="'poses'") as caught:
            generation.read_table("poses")
        generation.commit({})
    assert caught.value.code == "no_such_table"
    assert store.read(RUN, "windows").height == 498


@pytest.mark.parametrize("details", [{"x": float("nan")}, {"x": {1, 2}}, {"x": b""}])
def test_details_must_be_json(store: Store, details: dict[str, object]) -> None:
    with pytest.raises(StoreError) as caught, store.open_generation(RUN, "k") as generation:
        generation.commit(details)  # type: ignore[arg-type]
    assert caught.value.code == "bad_details"
    assert store.manifest(RUN) is None


def test_prune_keeps_the_current_and_the_newest(store: Store) -> None:
    for number in range(6):
        write_generation(store, RUN, f"k{number}", number)
    home = store.root / "runs" / RUN

    removed = store.prune(2)
    assert {path.name for path in removed} == {"k0", "k1", "k2"}
    assert {path.name for path in home.iterdir() if not path.name.startswith(".")} == {
        "k3", "k4", "k5", "latest", "manifest.json",
    }  # fmt: skip
    assert store.prune(2) == ()
    assert {path.name for path in store.prune(0)} == {"k3", "k4"}
    assert read_seed(store, RUN) == 5
    with pytest.raises(StoreError, match="-1"):
        store.prune(-1)


def test_reader_that_meets_a_pruned_generation_finds_the_next(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_generation(store, RUN, "one", 1)
    look = Manifest.read

    def read_late(manifest: Manifest, table: str) -> object:
        monkeypatch.setattr(Manifest, "read", look)
        write_generation(store, RUN, "two", 2)
        store.prune(0)
        return look(manifest, table)

    monkeypatch.setattr(Manifest, "read", read_late)
    assert store.read(RUN, "slip")["step"].unique().to_list() == [2]


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "manifest_damaged"),
        (b"\x00" * 80, "manifest_damaged"),
        (b'{"format": 1, "run": "x"}', "manifest_damaged"),
        (b'{"format": 2, "other": 1}', "manifest_too_new"),
    ],
)
def test_damaged_manifest_says_what_to_do(store: Store, content: bytes, code: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    write_generation(store, "other", "k", 2)
    path = manifest.folder.parent / "manifest.json"
    path.write_bytes(content)
    actions = (store.runs, lambda: store.manifest(RUN), lambda: store.scan("slip"))
    for look in (*actions, lambda: write_generation(store, RUN, "k", 1)):
        with pytest.raises(StoreError) as caught:
            look()
        assert caught.value.code == code
        assert caught.value.where == str(path)
    assert [(problem.run, problem.code) for problem in store.examine().problems] == [(RUN, code)]
    survey = store.survey()
    assert [manifest.run for manifest in survey.manifests] == ["other"]
    assert [(error.code, error.where) for error in survey.errors] == [(code, str(path))]
    assert read_seed(store, "other") == 2

    path.unlink()
    write_generation(store, RUN, "k", 3)
    assert read_seed(store, RUN) == 3


@pytest.mark.parametrize("field", ["folder", "earlier", "files"])
def test_edited_manifest_cannot_lead_elsewhere(store: Store, field: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    path = manifest.folder.parent / "manifest.json"
    content = json.loads(path.read_text())
    elsewhere = "../../../../precious"
    entry = {"bytes": 0, "sha256": ""}
    content[field] = {"folder": elsewhere, "earlier": [elsewhere], "files": {elsewhere: entry}}[field]
    path.write_text(json.dumps(content))
    with pytest.raises(StoreError, match="precious"):
        store.prune(0)


def test_verify_names_every_file_that_changed(store: Store) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    write_generation(store, "other", "k", 2)
    assert store.examine().problems == ()
    manifest.path("summary.json").write_text("2\n")
    manifest.path("slip").unlink()
    found = [(problem.run, problem.path.name, problem.code) for problem in store.examine().problems]
    assert found == [
        (RUN, "slip.parquet", "file_missing"),
        (RUN, "summary.json", "file_damaged"),
    ]


def test_damaged_table_says_what_to_do(store: Store) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    manifest.path("slip").write_bytes(b"PAR1 nothing")
    with pytest.raises(StoreError, match="--force") as caught:
        store.read(RUN, "slip")
    assert caught.value.code == "table_damaged"
