"""Results from a stranger, in a bucket or in a folder, read and write nothing outside of themselves."""

from __future__ import annotations

import os
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl
import pytest
from store_samples import read_seed, write_generation

from pipeline.store import Store, StoreError
from pipeline.store.checksums import decode_checked, encode_checked
from pipeline.store.files import hash_bytes
from pipeline.store.mirror import Mirror

fsspec = pytest.importorskip("fsspec", reason="the extra s3 is not installed")

if TYPE_CHECKING:
    from collections.abc import Iterator

RUN = "2026/husky"
ADDRESS = "memory://field/results"

OUTSIDE = [
    "batch/logs/../../../victim/bashrc",
    "batch/logs/../../../victim/bashrc.json",
    "runs/../../victim/manifest.json",
    "runs/a/../../../victim/manifest.json",
    "runs//etc/manifest.json",
    "runs/..\\..\\victim/manifest.json",
    "runs/\uff0e\uff0e/\uff0e\uff0e/victim/manifest.json",
    "runs/\u2025/\u2025/victim/manifest.json",
    f"runs/{'x' * 300}/manifest.json",
    f"runs/{'/'.join(['x' * 200] * 30)}/manifest.json",
    "runs/a\0b/manifest.json",
    "runs/link/manifest.json",
    "batch/logs/link/x.json",
]
"""Keys that look like objects of results and lead, or might lead, elsewhere."""

OTHERS = [
    "..",
    ".bashrc",
    ".lock",
    "C:",
    "\uff0e\uff0e",
    "latest\\x",
    "runs/a/b/c/d/manifest.json",
]
"""Keys that are no objects of results."""


@pytest.fixture
def bucket() -> Iterator[fsspec.AbstractFileSystem]:
    objects = fsspec.filesystem("memory")
    objects.store.clear()
    yield objects
    objects.store.clear()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with something precious in it, beside which the mirror will stand."""
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
        if path.is_file() and "mirror" not in path.relative_to(folder).parts[:1]
    }


def put(objects: fsspec.AbstractFileSystem, name: str, data: bytes) -> None:
    """An object under any key at all: nothing tidies the key up."""
    from fsspec.implementations.memory import MemoryFile  # noqa: PLC0415 - an extra

    key = f"/field/results/{name}"
    objects.store[key] = MemoryFile(objects, key, data)


@pytest.mark.parametrize("name", OUTSIDE, ids=lambda name: ascii(name)[:40])
def test_an_object_whose_name_leads_elsewhere_is_refused(
    bucket: fsspec.AbstractFileSystem, place: Path, name: str
) -> None:
    if "link" in name:
        link = place / "mirror" / name.rpartition("/")[0]
        link.parent.mkdir(parents=True)
        link.symlink_to(place / "victim")
    before = look(place)
    put(bucket, name, b'{"evil": 1}')
    with pytest.raises(StoreError) as caught:
        Mirror(ADDRESS, place / "mirror").pull_index()
    assert caught.value.code == "bad_object_name"
    assert ADDRESS in caught.value.where
    assert len(str(caught.value).splitlines()) == 1
    assert look(place) == before


@pytest.mark.parametrize("name", OTHERS, ids=ascii)
def test_objects_that_are_none_of_ours_are_left_alone(
    bucket: fsspec.AbstractFileSystem, place: Path, name: str
) -> None:
    before = look(place)
    put(bucket, name, b"evil")
    put(bucket, "index.html", b"ours")
    Mirror(ADDRESS, place / "mirror").pull_index()
    Mirror(ADDRESS, place / "mirror").pull_index()
    assert look(place) == before
    found = {path.name: path.read_bytes() for path in (place / "mirror").iterdir() if path.is_file()}
    assert b"evil" not in found.values()
    assert found["index.html"] == b"ours"


def upload(objects: fsspec.AbstractFileSystem, root: Path) -> None:
    for path in root.rglob("*"):
        if path.is_file() and "latest" not in path.parts and path.name != ".lock":
            put(objects, path.relative_to(root).as_posix(), path.read_bytes())


def test_a_run_is_fetched_as_it_was_written(
    bucket: fsspec.AbstractFileSystem, store: Store, tmp_path: Path
) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    upload(bucket, store.root)
    mirror = Mirror(ADDRESS, tmp_path / "mirror")
    mirror.pull_run(RUN)
    assert read_seed(mirror.store, RUN) == 1
    damaged = manifest.path("slip").relative_to(store.root).as_posix()
    put(bucket, damaged, manifest.path("slip").read_bytes()[:-1] + b"x")
    with pytest.raises(StoreError) as caught:
        Mirror(ADDRESS, tmp_path / "another").pull_run(RUN)
    assert caught.value.code == "file_damaged"
    assert damaged in caught.value.where


def edit(path: Path, changes: dict[str, object]) -> None:
    """Change a manifest as somebody would who knows how it is made."""
    path.write_bytes(encode_checked(decode_checked(path.read_bytes()) | changes))


ENTRY = {"bytes": 1, "sha256": "0" * 64}
TABLE = {**ENTRY, "file": "slip.parquet", "rows": 1, "quarantined": 0, "contract_version": 1, "rules": {}}
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
            "table": {"tables": {name: {**TABLE, "file": f"{name}.parquet"}}},
            "table's file": {"tables": {"slip": {**TABLE, "file": name}}},
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
    entry = {**asdict(manifest.tables["slip"]), "sha256": hash_bytes(path.read_bytes())}
    edit(home, {"tables": {"slip": entry}})
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
