"""What changed in a run, went from it or was added is noticed by its manifest; a kill is none of these."""

import shutil
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import pytest
from store_samples import write_generation
from store_writer import StartWriter

from pipeline.store import Store
from pipeline.store.names import Sample

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
    """Whether a checksum covers a file: those over all runs are made again, and older ones not read."""
    return path.name not in {".lock", "comparison.html"} and "old" not in path.parts


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


def swap_two_tables(store: Store) -> None:
    one, other = store.manifest(RUN), store.manifest(OTHER)
    assert one is not None
    assert other is not None
    shutil.copy(one.path("slip"), other.path("slip"))


def add_a_file(store: Store) -> None:
    (home_of(store, RUN) / "new" / "extra.parquet").write_bytes(b"x")


def add_an_empty_file_to_a_folder_of_its_own(store: Store) -> None:
    folder = home_of(store, RUN) / "new" / "figures"
    folder.mkdir()
    (folder / "more.svg").touch()


def add_a_link(store: Store) -> None:
    (home_of(store, RUN) / "new" / "elsewhere").symlink_to("/", target_is_directory=True)


CHANGES = {
    add_a_file: "extra_file",
    add_an_empty_file_to_a_folder_of_its_own: "extra_file",
    add_a_link: "extra_file",
    delete_manifest: "run_missing",
    copy_another_run_over_it: "name_clash",
    swap_two_runs: "name_clash",
    swap_two_manifests: "name_clash",
    swap_two_tables: "file_damaged",
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
    write_generation(filled, "2026/jackal", "key", 4)
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
    assert [writer.wait() for writer in writers] == [0, 0]
    assert looks > 5
