"""What changed in a run, went from it or was added is noticed by its manifest; a kill is none of these."""

from __future__ import annotations

import json
import os
import shutil
import tracemalloc
from itertools import cycle
from typing import TYPE_CHECKING

import pytest
from store_samples import make_slip, read_seed, write_generation

from pipeline.core.untrusted import MOST_BYTES
from pipeline.store import Store
from pipeline.store.checksums import decode_checked, encode_checked
from pipeline.store.names import Sample

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import StartWriter

RUN, OTHER = "2026/husky", "2026/warthog"


@pytest.fixture
def filled(store: Store) -> Store:
    """Two runs, of one also an older generation, a table and a page over all, and a note."""
    write_generation(store, RUN, "old", 1)
    write_generation(store, RUN, "new", 2)
    write_generation(store, OTHER, "key", 3)
    store.write_results_text("comparison.html", "<p>pools</p>")
    store.notes("batch/logs").write("log", {"state": "done"})
    assert store.examine().problems == ()
    return store


def list_files(root: Path) -> list[Path]:
    """Every file that holds something."""
    found = [path for path in root.rglob("*") if path.is_file() and not path.is_symlink()]
    return sorted(path for path in found if path.stat().st_size and "latest" not in path.parts)


def is_held(path: Path) -> bool:
    """Whether a checksum covers a file: those over all runs are made of the runs again."""
    return path.name not in {".lock", "comparison.html"}


def test_a_changed_byte_is_noticed_wherever_it_is(filled: Store) -> None:
    flips = cycle((0x01, 0x20, 0x80, 0xFF))
    for path in filter(is_held, list_files(filled.root)):
        whole = path.read_bytes()
        # `make bench NAME=damage_results` tries every byte.
        for at in range(0, len(whole), 1 + len(whole) // 11):
            path.write_bytes(whole[:at] + bytes([whole[at] ^ next(flips)]) + whole[at + 1 :])
            assert filled.examine().problems, f"byte {at} of {path.relative_to(filled.root)}"
        path.write_bytes(whole)
    assert filled.examine().problems == ()


def test_a_file_that_went_from_a_run_is_noticed(filled: Store) -> None:
    for path in filter(is_held, list_files(filled.root)):
        if "batch" in path.parts:
            # A note may go at any time, which costs a look at the log.
            continue
        whole = path.read_bytes()
        path.unlink()
        assert filled.examine().problems, path.relative_to(filled.root)
        path.write_bytes(whole)
    assert filled.examine().problems == ()


def home_of(store: Store, run: str) -> Path:
    manifest = store.manifest(run)
    assert manifest is not None
    return manifest.folder.parent


def delete_manifest_of(store: Store, run: str) -> None:
    (home_of(store, run) / "manifest.json").unlink()


def delete_manifest(store: Store) -> None:
    delete_manifest_of(store, RUN)


def copy_another_run_over_it(store: Store) -> None:
    home = home_of(store, RUN)
    shutil.rmtree(home)
    shutil.copytree(home_of(store, OTHER), home, symlinks=True)


def swap_two_runs(store: Store) -> None:
    one, other = home_of(store, RUN), home_of(store, OTHER)
    one.rename(one.with_name("aside"))
    other.rename(one)
    one.with_name("aside").rename(other)


def swap_two_manifests(store: Store) -> None:
    one, other = (home_of(store, run) / "manifest.json" for run in (RUN, OTHER))
    contents = one.read_bytes(), other.read_bytes()
    one.write_bytes(contents[1])
    other.write_bytes(contents[0])


def delete_an_old_generation(store: Store) -> None:
    shutil.rmtree(home_of(store, RUN) / "old")


def swap_two_tables(store: Store) -> None:
    one, other = store.manifest(RUN), store.manifest(OTHER)
    assert one is not None
    assert other is not None
    shutil.copy(one.path("slip"), other.path("slip"))


def swap_two_markers(store: Store) -> None:
    shutil.copy(home_of(store, RUN) / "new" / ".generation", home_of(store, OTHER) / "key" / ".generation")


def delete_a_marker(store: Store) -> None:
    (home_of(store, RUN) / "new" / ".generation").unlink()


def add_a_file(store: Store) -> None:
    (home_of(store, RUN) / "new" / "extra.parquet").write_bytes(b"x")


def add_an_empty_file_to_a_folder_of_its_own(store: Store) -> None:
    folder = home_of(store, RUN) / "new" / "figures"
    folder.mkdir()
    (folder / "more.svg").touch()


def add_a_link(store: Store) -> None:
    (home_of(store, RUN) / "new" / "elsewhere").symlink_to("/", target_is_directory=True)


def add_a_file_to_an_old_generation(store: Store) -> None:
    (home_of(store, RUN) / "old" / "extra").write_bytes(b"x")


CHANGES = {
    delete_a_marker: "file_missing",
    add_a_file: "extra_file",
    add_an_empty_file_to_a_folder_of_its_own: "extra_file",
    add_a_link: "extra_file",
    add_a_file_to_an_old_generation: "old_generation",
    delete_manifest: "run_missing",
    copy_another_run_over_it: "name_clash",
    swap_two_runs: "name_clash",
    swap_two_manifests: "name_clash",
    delete_an_old_generation: "old_generation",
    swap_two_tables: "file_damaged",
    swap_two_markers: "file_damaged",
}


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_was_deleted_or_swapped_is_noticed(filled: Store, change: Callable[[Store], None]) -> None:
    change(filled)
    (said,) = {problem.code for problem in filled.examine().problems} & {CHANGES[change]}
    assert said


def test_an_extra_file_is_named_and_stays(filled: Store) -> None:
    add_a_file(filled)
    (problem,) = filled.examine().problems
    assert problem.path == home_of(filled, RUN) / "new" / "extra.parquet"
    assert (problem.run, problem.home) == (RUN, f"runs/{RUN}")


def test_a_sample_draws_its_share_and_looks_at_every_run(filled: Store) -> None:
    whole = filled.examine()
    assert whole.files.looked_at == whole.files.all > 12
    draws = [filled.examine(Sample(0.3, f"day {day}")).files for day in range(60)]
    assert {tally.all for tally in draws} == {whole.files.all}
    # 60 draws of 30 %: four standard deviations of the mean are 0.06 of the share.
    assert abs(sum(tally.looked_at for tally in draws) / (60 * whole.files.all) - 0.3) < 0.06
    assert filled.examine(Sample(0.3, "day 1")).files == draws[1]

    next(home_of(filled, RUN).glob("new/slip.parquet")).write_bytes(b"x")
    noticed = [bool(filled.examine(Sample(0.3, f"day {day}")).problems) for day in range(60)]
    assert 6 < sum(noticed) < 32
    none = Sample(0.0, "")
    delete_manifest_of(filled, OTHER)
    assert [problem.code for problem in filled.examine(none).problems] == ["run_missing"]
    next(home_of(filled, RUN).glob("new/slip.parquet")).unlink()
    assert "file_missing" in {problem.code for problem in filled.examine(none).problems}


def test_results_that_are_being_written_are_not_damaged(store: Store, start_writer: StartWriter) -> None:
    write_generation(store, RUN, "k", 1)
    writers = [start_writer("loop", store.root, run, 2, 10) for run in (RUN, OTHER)]
    looks = 0
    while any(writer.poll() is None for writer in writers):
        found = store.examine()
        assert (found.problems, found.unchecked) == ((), ())
        looks += 1
    assert [writer.returncode for writer in writers] == [0, 0]
    assert looks > 5


def test_pages_over_all_runs_are_said_to_have_no_checksum(filled: Store) -> None:
    (filled.root / "comparison.html").write_text("another")
    found = filled.examine()
    assert (found.problems, found.unchecked) == ((), ("comparison.html",))


def make_old(root: Path) -> None:
    """Results as they were before there were checksums."""
    for path in (*root.rglob("manifest.json"), *root.glob("batch/**/*.json")):
        content = json.loads(path.read_bytes())
        if content.pop("checksum", None):
            path.write_text(json.dumps(content, indent=1, sort_keys=True))
    for path in root.rglob(".generation"):
        path.write_bytes(b"")


def test_results_of_before_there_were_checksums_are_not_damaged(filled: Store) -> None:
    make_old(filled.root)
    found = filled.examine()
    assert found.problems == ()
    assert found.unchecked == ("comparison.html", f"runs/{RUN}/old/.generation")
    assert filled.notes("batch/logs").read("log") == {"state": "done"}
    assert read_seed(filled, RUN) == 2

    write_generation(filled, RUN, "next", 4)
    filled.prune(0)
    found = filled.examine()
    assert (found.problems, found.unchecked) == ((), ("comparison.html",))
    path = filled.root / "runs" / OTHER / "key" / "summary.json"
    path.write_text("x")
    assert [problem.code for problem in filled.examine().problems] == ["file_damaged"]


def seal_as_before(root: Path) -> None:
    """Results as older versions left them: a list, the mark of a key, and signatures in markers."""
    names = [*(f"runs/{run}/manifest.json" for run in (RUN, OTHER)), "comparison.html"]
    (root / "listed").mkdir()
    for number, name in enumerate(names):
        entry = {"log": "", "path": name, "run": "", "sha256": ["0" * 64], "signature": "1" * 64}
        (root / "listed" / f"{number:032x}.json").write_bytes(encode_checked(entry))
    (root / "listed.json").write_bytes(encode_checked({"entries": {}}))
    (root / "sealed.json").write_bytes(encode_checked({"key": "0" * 16}))
    for path in root.rglob(".generation"):
        path.write_bytes(encode_checked({**decode_checked(path.read_bytes()), "signature": "1" * 64}))


def test_results_that_were_listed_and_sealed_are_read_verified_and_written(filled: Store) -> None:
    seal_as_before(filled.root)
    assert filled.examine().problems == ()
    assert filled.examine().unchecked == ("comparison.html",)
    assert read_seed(filled, RUN) == 2
    (home_of(filled, RUN) / "old" / "summary.json").write_text("x")
    (home_of(filled, OTHER) / "key" / "summary.json").write_text("x")
    codes = {problem.run: problem.code for problem in filled.examine().problems}
    assert codes == {RUN: "old_generation", OTHER: "file_damaged"}

    for run in (RUN, OTHER):
        write_generation(filled, run, "next", 4)
    filled.prune(0)
    assert filled.examine().problems == ()
    assert read_seed(filled, OTHER) == 4


def test_a_generation_made_again_in_the_place_of_a_deleted_one_is_not_pruned(store: Store) -> None:
    manifest = write_generation(store, RUN, "k", 1)
    shutil.rmtree(manifest.folder)
    write_generation(store, RUN, "k", 2)
    store.prune(0)
    assert read_seed(store, RUN) == 2
    assert store.examine().problems == ()


def test_a_table_of_results_has_the_rows_that_broke_its_contract_last(store: Store) -> None:
    store.write_results_table("slip", make_slip(RUN, 1))
    broken = make_slip(RUN, 1).with_columns(modulus=-1.0)
    store.write_results_table("slip", broken)
    assert (store.root / "quarantine_slip.parquet").exists()
    store.write_results_table("slip", make_slip(RUN, 2))
    assert not (store.root / "quarantine_slip.parquet").exists()


def test_a_note_that_was_changed_is_none(store: Store) -> None:
    notes = store.notes("identities")
    notes.write("log", {"sha256": "0" * 64, "size": 1})
    path = notes.path_of("log")
    assert notes.read("log") == {"sha256": "0" * 64, "size": 1}
    path.write_bytes(path.read_bytes().replace(b'"size": 1', b'"size": 2'))
    assert notes.read("log") is None
    assert [problem.code for problem in store.examine().problems] == ["note_damaged"]


def test_a_huge_note_is_none_and_is_not_read_whole(store: Store) -> None:
    write_generation(store, RUN, "k", 1)
    notes = store.notes("batch/logs")
    notes.write("log", {"state": "done"})
    manifest = home_of(store, RUN) / "manifest.json"
    for path in (notes.path_of("log"), manifest):
        os.truncate(path, 2 * 2**30)
    tracemalloc.start()
    assert notes.read("log") is None
    assert list(notes.read_all()) == []
    (error,) = store.survey().errors
    found = store.examine()
    assert tracemalloc.get_traced_memory()[1] < 4 * MOST_BYTES
    tracemalloc.stop()
    assert error.code == "too_large"
    assert f"{manifest}: it has more than 32 MB" in str(error)
    assert {problem.code for problem in found.problems} == {"note_damaged", "manifest_damaged"}
    assert all("it has more than 32 MB" in problem.what for problem in found.problems)
