"""Results from a stranger read and write nothing outside of themselves."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict
from pathlib import Path

import polars as pl
import pytest
from store_samples import write_generation

from pipeline.store import Store, StoreError
from pipeline.store.checksums import decode_checked, encode_checked
from pipeline.store.files import hash_bytes

RUN = "2026/husky"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with something precious in it, beside which the results stand."""
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "bashrc").write_text("precious")
    (victim / "bashrc.json").write_text("precious")
    (victim / "manifest.json").write_text("precious")
    return tmp_path


def look(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def edit(path: Path, changes: dict[str, object]) -> None:
    """Change a manifest as somebody would who knows how it is made."""
    path.write_bytes(encode_checked(decode_checked(path.read_bytes()) | changes))


ENTRY = {"bytes": 1, "sha256": "0" * 64}
TABLE = {"rows": 1, "quarantined": 0, "contract_version": 1, "rules": {}}
ELSEWHERE = [
    "../../../victim/x",
    "/etc/passwd",
    "C:x",
    "a\\..\\..\\x",
    "\uff0e\uff0e/x",
    "a/../../x",
    "",
    ".",
    "..",
]


@pytest.mark.parametrize("field", ["folder", "key", "earlier", "files", "table", "table's file"])
def test_a_manifest_names_nothing_outside_of_its_run(store: Store, field: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    path = manifest.folder.parent / "manifest.json"
    whole = path.read_bytes()
    for name in ELSEWHERE:
        changes: dict[str, dict[str, object]] = {
            "folder": {"folder": name},
            "key": {"key": name},
            "earlier": {"earlier": [name]},
            "files": {"files": {name: ENTRY}},
            "table": {"tables": {name: TABLE}, "files": {f"{name}.parquet": ENTRY}},
            "table's file": {"tables": {"slip": TABLE}, "files": {name: ENTRY}},
        }
        edit(path, changes[field])
        for look_at in (store.manifests, lambda: store.manifest(RUN), lambda: store.prune(0)):
            with pytest.raises(StoreError) as caught:
                look_at()
            assert caught.value.code == "manifest_damaged"
        assert [problem.code for problem in store.examine().problems] == ["manifest_damaged"]
        path.write_bytes(whole)
    assert store.examine().problems == ()


@pytest.mark.parametrize("what", ["folder", "file"])
def test_a_link_in_a_run_leads_nowhere_outside(store: Store, tmp_path: Path, what: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    target = tmp_path / "secret"
    source = manifest.folder if what == "folder" else manifest.path("slip")
    source.rename(target)
    source.symlink_to(target)
    with pytest.raises(StoreError):
        store.read(RUN, "slip")
    with pytest.raises(StoreError):
        store.query("SELECT * FROM slip")
    assert {problem.run for problem in store.examine().problems} == {RUN}


@pytest.mark.parametrize("run", ["..", "other", "2026/husky2", "husky", ""])
def test_a_run_stands_in_its_own_folder_only(store: Store, run: str) -> None:
    """Whatever runs are called, their names come to be names of files: of exports, and of pages."""
    manifest = write_generation(store, RUN, "k", 1)
    edit(manifest.folder.parent / "manifest.json", {"run": run})
    with pytest.raises(StoreError):
        store.manifests()
    assert [error.code for error in store.survey().errors] == ["name_clash"] if run else True
    assert len(store.examine().problems) == 1


def test_notes_of_strange_content_are_no_notes(store: Store) -> None:
    notes = store.notes("batch/logs")
    path = notes.path_of("x")
    path.parent.mkdir(parents=True)
    for content in (b"[]", b"null", b"{", b'"x"', b"[" * 100_000, b'{"a": "\xed\xb3\xbf"}'):
        path.write_bytes(content)
        assert notes.read("x") is None
        assert list(notes.read_all()) == []
    path.unlink()
    os.mkfifo(path)
    assert list(notes.read_all()) == []


@pytest.mark.parametrize("name", ["manifest.json", "slip.parquet", "datasets.parquet"])
def test_a_pipe_in_the_results_is_not_waited_for(store: Store, name: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    places = {"manifest.json": manifest.folder.parent, "datasets.parquet": store.root}
    path = places.get(name, manifest.folder) / name
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    with pytest.raises(StoreError, match="a pipe, a socket or a device") as caught:
        store.query("SELECT * FROM slip, datasets")
    assert caught.value.code == "not_a_file"
    assert [problem.path for problem in store.examine().problems] == (
        [] if path.parent == store.root else [path]
    )


@pytest.mark.parametrize("change", ["a column less", "another type"])
def test_a_table_has_the_columns_of_its_contract(store: Store, change: str) -> None:
    """Whoever makes results can give their hashes as well."""
    manifest = write_generation(store, RUN, "k", 1)
    path = manifest.path("slip")
    frame = pl.read_parquet(path)
    odd = frame.drop("t") if change == "a column less" else frame.with_columns(pl.lit("x").alias("t"))
    odd.write_parquet(path)
    home = path.parents[1] / "manifest.json"
    files = {name: asdict(entry) for name, entry in manifest.files.items()}
    files["slip.parquet"]["sha256"] = hash_bytes(path.read_bytes())
    edit(home, {"files": files})
    with pytest.raises(StoreError, match="not those of its contract") as caught:
        store.read(RUN, "slip")
    assert caught.value.code == "table_damaged"


@pytest.mark.parametrize("name", ["batch", "batch/logs", "batch/claims", "identities"])
def test_no_link_in_the_results_leads_what_is_written_outside(store: Store, place: Path, name: str) -> None:
    write_generation(store, RUN, "k", 1)
    shutil.rmtree(store.root / name, ignore_errors=True)
    (store.root / name).parent.mkdir(exist_ok=True)
    (store.root / name).symlink_to(place / "victim", target_is_directory=True)
    before = look(place / "victim")

    def claim() -> None:
        with store.claim("x"):
            pass

    writers = {
        "batch/claims": claim,
        "identities": lambda: store.notes("identities").write("x", {"a": 1}),
    }
    with pytest.raises(StoreError) as caught:
        writers.get(name, lambda: store.notes("batch/logs").write("x", {"a": 1}))()
    assert caught.value.code == "file_outside"
    assert look(place / "victim") == before


def test_a_link_among_notes_leads_nowhere_outside(store: Store, place: Path) -> None:
    notes = store.notes("batch/logs")
    folder = notes.path_of("x").parent
    folder.parent.mkdir(parents=True)
    folder.symlink_to(place / "victim", target_is_directory=True)
    before = look(place / "victim")
    assert not notes.write("x", {"a": 1})
    assert notes.read("x") is None
    notes.remove("x")
    assert look(place / "victim") == before
