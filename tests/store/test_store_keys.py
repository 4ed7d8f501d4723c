"""A key seals the list: nobody rewrites it unnoticed without the key, or drops the seal by accident."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from store_samples import read_seed, write_generation

from pipeline.store import Store, StoreError
from pipeline.store.files import hash_bytes
from pipeline.store.listing import entry_name, make_entry, parse_entry
from pipeline.store.mirror import Mirror
from pipeline.store.seals import KEY_VARIABLE, encode_manifest, encode_marker, find_key, read_key, seal

if TYPE_CHECKING:
    from collections.abc import Callable

RUN, OTHER = "2026/husky", "2026/warthog"


@pytest.fixture
def key_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "key"
    path.write_bytes(bytes(range(32)))
    path.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    return path


@pytest.fixture
def sealed(key_file: Path, store: Store) -> Store:
    """Two runs, of one also an older generation, and a page over all runs; sealed with the key."""
    assert key_file.exists()
    write_generation(store, RUN, "old", 1)
    write_generation(store, RUN, "new", 2)
    write_generation(store, OTHER, "key", 3)
    store.write_results_text("comparison.html", "<p>pools</p>")
    return store


def look(store: Store) -> set[tuple[str, str]]:
    found = Store(store.root).examine()
    assert found.unlisted == ()
    return {(problem.run, problem.code) for problem in found.problems}


def manifest_path(store: Store, run: str = RUN) -> Path:
    return store.root / "runs" / run / "manifest.json"


def forge_run(store: Store) -> None:
    """Change a table, and rewrite marker, manifest and list as slip would without a key."""
    manifest = store.manifest(RUN)
    assert manifest is not None
    summary = manifest.path("summary.json")
    summary.write_bytes(b"7\n")
    entry = replace(manifest.files["summary.json"], sha256=hash_bytes(b"7\n"), bytes=2)
    forged = replace(manifest, files={**manifest.files, "summary.json": entry})
    (forged.folder / ".generation").write_bytes(encode_marker(RUN, forged.hashes(), None))
    data = encode_manifest(forged)
    manifest_path(store).write_bytes(data)
    name = manifest_path(store).relative_to(store.root).as_posix()
    (store.root / entry_name(name)).write_bytes(
        make_entry(name, hash_bytes(data), manifest=forged).encode(None)
    )


def forge_page(store: Store) -> None:
    (store.root / "comparison.html").write_bytes(b"better")
    entry = make_entry("comparison.html", hash_bytes(b"better"))
    (store.root / entry_name("comparison.html")).write_bytes(entry.encode(None))


def forge_old_generation(store: Store) -> None:
    folder = store.root / "runs" / RUN / "old"
    (folder / "summary.json").write_bytes(b"7\n")
    files = {path.name: hash_bytes(path.read_bytes()) for path in folder.iterdir() if path.name[0] != "."}
    (folder / ".generation").write_bytes(encode_marker(RUN, files, None))


def drop_run(store: Store) -> None:
    """Delete a run, its entry, and its line in the register."""
    shutil.rmtree(manifest_path(store, OTHER).parent)
    name = f"runs/{OTHER}/manifest.json"
    (store.root / entry_name(name)).unlink()
    register = store.root / "listed.json"
    content = json.loads(register.read_bytes())
    del content["checksum"], content["entries"][entry_name(name)]
    data = seal(content)
    register.write_bytes(data)
    (store.root / entry_name("listed.json")).write_bytes(
        make_entry("listed.json", hash_bytes(data)).encode(None)
    )


FORGERIES = {
    forge_run: {(RUN, "not_sealed"), (RUN, "file_damaged")},
    forge_page: {("", "not_sealed")},
    forge_old_generation: {(RUN, "old_generation")},
    drop_run: {("", "not_sealed")},
}


@pytest.mark.parametrize("forge", FORGERIES, ids=lambda forge: forge.__name__)
def test_a_list_that_was_rewritten_without_the_key_is_noticed(
    sealed: Store, forge: Callable[[Store], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert look(sealed) == set()
    forge(sealed)
    assert look(sealed) == FORGERIES[forge]
    # What a key is for: the checksums alone are right again.
    monkeypatch.delenv(KEY_VARIABLE)
    assert look(sealed) == set()
    assert Store(sealed.root).examine().seal == "not_checked"


def test_results_without_a_seal_or_of_another_key_are_a_finding(
    sealed: Store, key_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key_file.write_bytes(b"another key, of 32 bytes or more")
    assert look(sealed) == {("", "other_key")}
    monkeypatch.delenv(KEY_VARIABLE)
    plain = Store(tmp_path / "plain")
    write_generation(plain, RUN, "k", 1)
    assert plain.examine().seal == "none"
    monkeypatch.setenv(KEY_VARIABLE, str(key_file))
    assert look(plain) == {("", "not_sealed")}
    (sealed.root / "sealed.json").unlink()
    assert ("", "not_sealed") in look(sealed)


def test_nobody_writes_without_the_key_or_with_another(
    sealed: Store, key_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(code: str) -> None:
        fresh = Store(sealed.root)
        for write in (
            lambda: write_generation(fresh, RUN, "next", 4),
            lambda: write_generation(fresh, "2026/third", "next", 4),
            lambda: fresh.write_results_text("trend.html", "x"),
            fresh.check_writable,
            lambda: fresh.prune(0),
        ):
            with pytest.raises(StoreError) as caught:
                write()
            assert caught.value.code == code

    whole = key_file.read_bytes()
    key_file.write_bytes(b"another key, of 32 bytes or more")
    refuse("other_key")
    monkeypatch.delenv(KEY_VARIABLE)
    refuse("key_missing")
    monkeypatch.setenv(KEY_VARIABLE, str(key_file))
    key_file.write_bytes(whole)
    fresh = Store(sealed.root)
    write_generation(fresh, RUN, "next", 4)
    fresh.prune(0)
    assert look(sealed) == set()
    assert read_seed(fresh, RUN) == 4


def test_a_run_that_was_forged_is_not_built_upon(sealed: Store) -> None:
    forge_run(sealed)
    fresh = Store(sealed.root)
    with pytest.raises(StoreError) as caught:
        write_generation(fresh, RUN, "next", 4)
    assert caught.value.code == "not_sealed"
    with pytest.raises(StoreError):
        fresh.prune(0)
    manifest = fresh.manifest(RUN)
    assert manifest is not None
    fresh.ask_again(manifest)
    write_generation(fresh, RUN, "next", 4)
    assert look(sealed) == set()


def test_results_are_sealed_as_they_are_only_when_told_to_and_whole(
    store: Store, key_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(KEY_VARIABLE)
    write_generation(store, RUN, "old", 1)
    write_generation(store, RUN, "new", 2)
    store.write_results_text("comparison.html", "x")
    monkeypatch.setenv(KEY_VARIABLE, str(key_file))
    fresh = Store(store.root)
    with pytest.raises(StoreError) as caught:
        write_generation(fresh, OTHER, "k", 1)
    assert caught.value.code == "not_sealed"
    page = store.root / "comparison.html"
    page.write_text("y")
    with pytest.raises(StoreError) as caught:
        fresh.seal()
    assert (caught.value.code, caught.value.where) == ("not_whole", str(page))
    page.write_text("x")
    fresh.seal()
    assert look(store) == set()
    forge_old_generation(store)
    assert look(store) == {(RUN, "old_generation")}
    with pytest.raises(StoreError) as caught:
        fresh.seal()
    assert caught.value.code == "sealed_already"


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        (b"x" * 31, 0o600, "31 bytes"),
        (b"x" * 70_000, 0o600, "more than 65536"),
        (b"x" * 32, 0o640, "others may read the key"),
        (b"x" * 32, 0o604, "others may read the key"),
    ],
)
def test_a_key_that_is_none_or_that_others_may_read_is_refused(
    tmp_path: Path, content: bytes, mode: int, said: str
) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(mode)
    with pytest.raises(StoreError, match=said) as caught:
        read_key(path)
    assert caught.value.code == "bad_key_file"
    assert "xxx" not in str(caught.value)


def test_a_key_file_that_is_not_there_is_no_missing_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(KEY_VARIABLE, str(tmp_path / "gone"))
    with pytest.raises(StoreError, match="cannot be read"):
        find_key()


def test_a_signature_belongs_to_its_content(key_file: Path) -> None:
    key = read_key(key_file)
    name = entry_name("comparison.html")
    data = make_entry("comparison.html", "0" * 64).encode(key)
    entry = parse_entry(data, name)
    assert entry.is_sealed_with(key)
    assert not replace(entry, sha256=("1" * 64,)).is_sealed_with(key)
    assert not replace(entry, log="elsewhere").is_sealed_with(key)
    assert key.secret.hex() not in repr(key)


def test_results_in_a_bucket_are_sealed_from_the_first_run_or_as_they_are(
    key_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = "memory://keys/results"
    monkeypatch.delenv(KEY_VARIABLE)
    plain = Mirror(address, tmp_path / "plain")
    plain.push_run(write_generation(plain.store, RUN, "k", 1))
    plain.push_register()
    monkeypatch.setenv(KEY_VARIABLE, str(key_file))
    mirror = Mirror(address, tmp_path / "mirror")
    mirror.pull_index()
    with pytest.raises(StoreError) as caught:
        write_generation(mirror.store, OTHER, "k", 2)
    assert caught.value.code == "not_sealed"
    mirror.seal()
    assert (mirror.examine().problems, mirror.examine().seal) == ((), "checked")
    monkeypatch.delenv(KEY_VARIABLE)
    late = Mirror(address, tmp_path / "late")
    late.pull_run(OTHER)
    with pytest.raises(StoreError) as caught:
        write_generation(late.store, OTHER, "k", 2)
    assert caught.value.code == "key_missing"
