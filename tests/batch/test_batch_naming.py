"""Names of runs: the same for the same logs, whatever was done before and in which order."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from pipeline.batch.batch_plan import KnownRun, name_runs

PATHS = [Path(f"/{top}/{folder}/{stem}.mcap") for top in "xyz" for folder in "ab" for stem in "12"]
contents = st.dictionaries(st.sampled_from(PATHS), st.integers(0, 5), min_size=1)


def hash_of(content: int) -> str:
    return f"{content:064x}"[::-1]


def name_all(
    logs: dict[Path, int], known: list[KnownRun], *, is_present: bool = True
) -> tuple[dict[Path, str], dict[Path, str]]:
    sizes = {path: content % 3 for path, content in logs.items()}
    return name_runs(sizes, known, lambda path: hash_of(logs[path]), lambda _run: is_present)


def know(runs: dict[Path, str], logs: dict[Path, int]) -> list[KnownRun]:
    return [KnownRun(run, hash_of(logs[path]), logs[path] % 3) for path, run in runs.items()]


@given(contents)
def test_every_content_has_one_run_and_no_run_two_contents(logs: dict[Path, int]) -> None:
    runs, copies = name_all(logs, [])
    assert set(runs) | set(copies) == set(logs)
    assert len(set(runs.values())) == len(runs) == len(set(logs.values()))
    of_run = {run: logs[path] for path, run in runs.items()}
    assert all(of_run[run] == logs[path] for path, run in copies.items())


@given(contents, st.sets(st.sampled_from(PATHS)))
def test_an_interrupted_batch_goes_on_with_the_same_names(logs: dict[Path, int], done: set[Path]) -> None:
    runs, copies = name_all(logs, [])
    before = {path: run for path, run in runs.items() if path in done}
    rest = {path: content for path, content in logs.items() if path not in before}
    if rest:
        later, copied = name_all(rest, know(before, logs))
        assert before | later == runs
        assert copied == copies


def test_names_are_plain_where_they_can_be() -> None:
    first, second, other = Path("/x/a/1.mcap"), Path("/y/a/1.mcap"), Path("/x/b/1.mcap")
    runs, copies = name_all({first: 0, second: 1, other: 2}, [])
    assert runs == {first: "a/1", second: "a/1-10000000", other: "b/1"}
    assert copies == {}


def test_a_log_that_was_moved_keeps_its_run() -> None:
    old = KnownRun("old/name", hash_of(0), 0)
    first, second = Path("/x/a/1.mcap"), Path("/y/a/1.mcap")
    assert name_all({first: 0, second: 0}, [old], is_present=False) == (
        {first: "old/name"},
        {second: "old/name"},
    )
    assert name_all({first: 0}, [old]) == ({}, {first: "old/name"})


def test_a_log_that_cannot_be_read_is_no_copy() -> None:
    first, second = Path("/x/a/1.mcap"), Path("/x/b/1.mcap")
    runs, copies = name_runs({first: 0, second: 0}, [], lambda _path: "", lambda _run: True)
    assert (runs, copies) == ({first: "a/1", second: "b/1"}, {})
