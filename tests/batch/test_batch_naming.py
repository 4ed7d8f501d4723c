"""Names of runs: the same for the same logs, whatever was done before and in which order."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from pipeline.batch.batch_plan import KnownRun, assign_names, list_doubtful

PATHS = [Path(f"/{top}/{folder}/{stem}.mcap") for top in "xyz" for folder in "ab" for stem in "12"]
contents = st.dictionaries(st.sampled_from(PATHS), st.integers(0, 5), min_size=1)


def name_all(logs: dict[Path, int], known: list[KnownRun]) -> tuple[dict[Path, str], dict[Path, str]]:
    sizes = {path: content % 3 for path, content in logs.items()}
    doubtful = list_doubtful(sizes, known)
    hashes = {path: f"{logs[path]:064x}"[::-1] for path in doubtful}
    names = assign_names(list(logs), hashes, known)
    return dict(names.runs), dict(names.copies)


def know(runs: dict[Path, str], logs: dict[Path, int]) -> list[KnownRun]:
    return [
        KnownRun(run=run, sha256=f"{logs[path]:064x}"[::-1], size=logs[path] % 3, is_present=True)
        for path, run in runs.items()
    ]


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
    old = KnownRun(run="old/name", sha256="0" * 64, size=0, is_present=False)
    runs, copies = name_all({Path("/x/a/1.mcap"): 0}, [old])
    assert runs == {Path("/x/a/1.mcap"): "old/name"}
    assert copies == {}
