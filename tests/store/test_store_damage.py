"""What changed in a run, went from it or was added is told; nothing of strangers leads out of the results."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from itertools import cycle
from pathlib import Path

import polars as pl
import pytest
from store_samples import read_seed, write_generation

from pipeline.store import Manifest, Store, StoreError
from pipeline.store.checksums import decode_checked, encode_checked
from pipeline.store.files import hash_bytes
from pipeline.store.names import Sample

RUN, OTHER = "2026/husky", "2026/warthog"


@pytest.fixture
def filled(store: Store) -> Store:
    """Two runs, of one also an older generation, a page over all, and a note."""
    write_generation(store, RUN, "old", 1)
    write_generation(store, RUN, "new", 2)
    write_generation(store, OTHER, "key", 3)
    store.write_results_text("comparison.html", "<p>pools</p>")
    store.notes("batch/logs").write("log", {"state": "done"})
    assert store.examine().problems == ()
    return store


def take(store: Store, run: str = RUN) -> Manifest:
    manifest = store.manifest(run)
    assert manifest is not None
    return manifest


def test_a_changed_byte_and_a_file_that_went_are_noticed_wherever(filled: Store) -> None:
    current = take(filled).folder.name
    found = [path for path in filled.root.rglob("*") if path.is_file() and path.stat().st_size]
    flips = cycle((0x01, 0x20, 0x80, 0xFF))
    checked = 0
    for path in sorted(found):
        # What is over all runs is made again, and what is older is not read.
        is_old = RUN.rpartition("/")[2] in path.parts and path.parent.name not in (current, "husky")
        if path.name in {".lock", "comparison.html"} or "latest" in path.parts or is_old:
            continue
        whole = path.read_bytes()
        # `make bench NAME=damage_results` tries every byte.
        for at in range(0, len(whole), 1 + len(whole) // 11):
            path.write_bytes(whole[:at] + bytes([whole[at] ^ next(flips)]) + whole[at + 1 :])
            assert filled.examine().problems, f"byte {at} of {path.relative_to(filled.root)}"
        path.unlink()
        # A note may go at any time, which costs a look at the log.
        assert filled.examine().problems or "batch" in path.parts, path.relative_to(filled.root)
        path.write_bytes(whole)
        checked += 1
    assert checked == 11
    assert filled.examine().problems == ()
    assert filled.examine().unchecked == ("comparison.html",)


def copy_another_run_over_it(store: Store) -> None:
    home = take(store).home
    shutil.rmtree(home)
    shutil.copytree(take(store, OTHER).home, home, symlinks=True)


def swap_two_runs(store: Store) -> None:
    one, other = take(store).home, take(store, OTHER).home
    one.rename(one.with_name("aside"))
    other.rename(one)
    one.with_name("aside").rename(other)


def swap_two_manifests(store: Store) -> None:
    one, other = (take(store, run).home / "manifest.json" for run in (RUN, OTHER))
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])


def add_a_file_to_a_folder_of_its_own(store: Store) -> None:
    (take(store).folder / "figures").mkdir()
    (take(store).folder / "figures" / "more.svg").touch()


def add_a_link(store: Store) -> None:
    (take(store).folder / "elsewhere").symlink_to("/", target_is_directory=True)


CHANGES: dict[Callable[[Store], object], str] = {
    add_a_file_to_a_folder_of_its_own: "extra_file",
    add_a_link: "extra_file",
    lambda store: (take(store).folder / "extra.parquet").write_bytes(b"x"): "extra_file",
    lambda store: (take(store).home / "manifest.json").unlink(): "run_missing",
    copy_another_run_over_it: "name_clash",
    swap_two_runs: "name_clash",
    swap_two_manifests: "name_clash",
    lambda store: shutil.copy(take(store).path("slip"), take(store, OTHER).path("slip")): "file_damaged",
}


@pytest.mark.parametrize(("change", "code"), CHANGES.items())
def test_what_was_added_deleted_or_swapped_is_noticed(
    filled: Store, change: Callable[[Store], None], code: str
) -> None:
    change(filled)
    problems = [problem for problem in filled.examine().problems if problem.code == code]
    assert problems
    assert all(problem.home in {f"runs/{RUN}", f"runs/{OTHER}"} for problem in problems)


def test_a_sample_draws_its_share_and_looks_at_every_run(filled: Store) -> None:
    write_generation(filled, "2026/jackal", "key", 4)
    whole = filled.examine()
    assert whole.files.looked_at == whole.files.all > 12
    draws = [filled.examine(Sample(0.3, f"day {day}")).files for day in range(60)]
    assert {tally.all for tally in draws} == {whole.files.all}
    # 60 draws of 30 %: four standard deviations of the mean are 0.06 of the share.
    assert abs(sum(tally.looked_at for tally in draws) / (60 * whole.files.all) - 0.3) < 0.06
    assert filled.examine(Sample(0.3, "day 1")).files == draws[1]

    take(filled).path("slip").write_bytes(b"x")
    noticed = [bool(filled.examine(Sample(0.3, f"day {day}")).problems) for day in range(60)]
    assert 6 < sum(noticed) < 32
    take(filled).path("slip").unlink()
    (take(filled, OTHER).home / "manifest.json").unlink()
    found = {problem.code for problem in filled.examine(Sample(0.0, "")).problems}
    assert found == {"run_missing", "file_missing"}


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "manifest_damaged"),
        (b"\x00" * 80, "manifest_damaged"),
        (b'{"run": "x"}', "manifest_damaged"),
        (encode_checked({"run": RUN, "other": 1}), "other_version"),
    ],
)
def test_a_damaged_manifest_says_what_to_do_and_costs_no_other_run(
    store: Store, content: bytes, code: str
) -> None:
    path = write_generation(store, RUN, "k", 1).home / "manifest.json"
    write_generation(store, "other", "k", 2)
    path.write_bytes(content)
    looks = (store.runs, lambda: store.manifest(RUN), lambda: store.scan("slip"))
    for look_at in (*looks, lambda: write_generation(store, RUN, "k", 1)):
        with pytest.raises(StoreError) as caught:
            look_at()
        assert (caught.value.code, caught.value.where) == (code, str(path))
    assert [(problem.run, problem.code) for problem in store.examine().problems] == [(RUN, code)]
    survey = store.survey()
    assert [manifest.run for manifest in survey.manifests] == ["other"]
    assert [(error.code, error.where) for error in survey.errors] == [(code, str(path))]
    path.unlink()
    write_generation(store, RUN, "k", 3)
    assert (read_seed(store, RUN), read_seed(store, "other")) == (3, 2)


def test_a_damaged_table_says_what_to_do(store: Store) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    manifest.path("slip").write_bytes(b"PAR1 nothing")
    with pytest.raises(StoreError, match="--force") as caught:
        manifest.read("slip")
    assert caught.value.code == "table_damaged"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with something precious in it, beside which the results stand."""
    victim = tmp_path / "victim"
    victim.mkdir()
    for name in ("bashrc", "bashrc.json", "manifest.json"):
        (victim / name).write_text("precious")
    return tmp_path


def look(folder: Path) -> dict[str, bytes]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def edit(path: Path, changes: dict[str, object]) -> None:
    """Change a manifest as somebody would who knows how it is made."""
    path.write_bytes(encode_checked(decode_checked(path.read_bytes()) | changes))


ENTRY = {"bytes": 1, "sha256": "0" * 64}
TABLE = {"rows": 1, "quarantined": 0, "contract_version": 1, "rules": {}}
ELSEWHERE = ["../../../victim/x", "/etc/passwd", "C:x", "a\\..\\..\\x", "\uff0e\uff0e/x", "a/../../x"]


@pytest.mark.parametrize("name", [*ELSEWHERE, "", ".", ".."])
def test_a_manifest_names_nothing_outside_of_its_run(store: Store, name: str) -> None:
    path = write_generation(store, RUN, "k", 1).home / "manifest.json"
    changes: list[tuple[str, dict[str, object]]] = [
        ("other_version", {"number": name}),
        ("other_version", {"number": -1}),
        ("manifest_damaged", {"files": {name: ENTRY}}),
        ("manifest_damaged", {"tables": {name: TABLE}, "files": {f"{name}.parquet": ENTRY}}),
        ("manifest_damaged", {"tables": {"slip": TABLE}, "files": {name: ENTRY}}),
    ]
    whole = path.read_bytes()
    for code, change in changes:
        edit(path, change)
        for look_at in (store.manifests, lambda: store.manifest(RUN), lambda: store.prune(0)):
            with pytest.raises(StoreError) as caught:
                look_at()
            assert caught.value.code == code
        assert [problem.code for problem in store.examine().problems] == [code]
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
        take(store).read("slip")
    with pytest.raises(StoreError):
        store.query("SELECT * FROM slip")
    assert {problem.run for problem in store.examine().problems} == {RUN}


@pytest.mark.parametrize("run", ["..", "other", "2026/husky2", "husky", ""])
def test_a_run_stands_in_its_own_folder_only(store: Store, run: str) -> None:
    """Whatever runs are called, their names come to be names of files: of exports, and of pages."""
    manifest = write_generation(store, RUN, "k", 1)
    edit(manifest.home / "manifest.json", {"run": run})
    for look_at in (store.manifests, lambda: store.manifest(RUN)):
        with pytest.raises(StoreError) as caught:
            look_at()
        assert caught.value.code == "name_clash"
    assert [problem.code for problem in store.examine().problems] == ["name_clash"]


@pytest.mark.parametrize("name", ["manifest.json", "slip.parquet", "datasets.parquet"])
def test_a_pipe_in_the_results_is_not_waited_for(store: Store, name: str) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    places = {"manifest.json": manifest.home, "datasets.parquet": store.root}
    path = places.get(name, manifest.folder) / name
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    with pytest.raises(StoreError, match="a pipe, a socket or a device") as caught:
        store.query("SELECT * FROM slip, datasets")
    assert caught.value.code == "not_a_file"
    found = [problem.path for problem in store.examine().problems]
    assert found == ([] if path.parent == store.root else [path])


@pytest.mark.parametrize("change", ["a column less", "another type"])
def test_a_table_has_the_columns_of_its_contract(store: Store, change: str) -> None:
    """Whoever makes results can give their hashes as well."""
    manifest = write_generation(store, RUN, "k", 1)
    path = manifest.path("slip")
    frame = pl.read_parquet(path)
    odd = frame.drop("t") if change == "a column less" else frame.with_columns(pl.lit("x").alias("t"))
    odd.write_parquet(path)
    files = {name: asdict(entry) for name, entry in manifest.files.items()}
    files["slip.parquet"]["sha256"] = hash_bytes(path.read_bytes())
    edit(manifest.home / "manifest.json", {"files": files})
    with pytest.raises(StoreError, match="not those of its contract") as caught:
        take(store).read("slip")
    assert caught.value.code == "table_damaged"


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


@pytest.mark.parametrize("name", ["batch", "batch/logs", "batch/claims", "identities"])
def test_no_link_in_the_results_leads_what_is_written_outside(store: Store, place: Path, name: str) -> None:
    write_generation(store, RUN, "k", 1)
    (store.root / name).parent.mkdir(exist_ok=True)
    (store.root / name).symlink_to(place / "victim", target_is_directory=True)
    before = look(place / "victim")
    writers: dict[str, Callable[[], object]] = {
        "batch/claims": store.claim("x").__enter__,
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
