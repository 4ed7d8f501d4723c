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
    return name_runs(sizes, known, (), lambda path: hash_of(logs[path]), lambda _run: is_present, Path)


def know(runs: dict[Path, str], logs: dict[Path, int]) -> list[KnownRun]:
    return [KnownRun(run, hash_of(logs[path]), logs[path] % 3, path) for path, run in runs.items()]


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
    assert runs == {first: "x/a/1", second: "y/a/1", other: "b/1"}
    assert copies == {}


def test_one_robot_more_renames_no_run() -> None:
    """The first robot's night was named before there was another; both nights after it name the robots."""
    nights = [[Path(f"/logs/robot{robot}/{night}/run.mcap") for robot in (1, 2)] for night in "12"]
    logs = {path: number for number, path in enumerate([*nights[0], *nights[1]])}
    alone, _ = name_all({nights[0][0]: 0}, [])
    later, _ = name_all({path: logs[path] for path in nights[1]}, know(alone, logs))
    added, _ = name_all({nights[0][1]: 1}, know(alone | later, logs))
    assert list((alone | later | added).values()) == ["1/run", "robot1/2/run", "robot2/2/run", "robot2/1/run"]


def test_logs_of_one_folder_and_stem_are_told_apart_by_their_content() -> None:
    first, second = Path("/x/a/1.bag"), Path("/x/a/1.mcap")
    assert name_all({first: 0, second: 1}, [])[0] == {first: "a/1", second: f"a/1-{hash_of(1)[:8]}"}


def test_links_are_named_as_they_are_listed() -> None:
    robots = {Path(f"/disks/{disk}/night/run.mcap"): disk for disk in (0, 1)}
    listed = {path: Path(f"/logs/robot{disk}/night/run.mcap") for path, disk in robots.items()}
    hashes = {path: hash_of(disk) for path, disk in robots.items()}
    runs, _ = name_runs(robots, [], (), hashes.__getitem__, lambda _run: True, listed.__getitem__)
    assert list(runs.values()) == ["robot0/night/run", "robot1/night/run"]


@given(st.lists(st.integers(0, 4), min_size=2, max_size=4, unique=True), st.sampled_from("._"))
def test_a_log_that_is_rotated_keeps_its_run(contents: list[int], mark: str) -> None:
    """The newest is run.mcap; the older ones move on by one each night, to names that sort either way."""
    known: list[KnownRun] = []
    run_of: dict[int, str] = {}
    names = [Path("/logs/run.mcap"), *(Path(f"/logs/run{mark}{age}.mcap") for age in range(1, len(contents)))]
    for night in range(1, len(contents) + 1):
        logs = dict(zip(names, reversed(contents[:night]), strict=False))
        hashes = {path: hash_of(content) for path, content in logs.items()}
        present = {each.run for each in known if hashes[each.path] == each.sha256}
        sizes = {path: content % 3 for path, content in logs.items()}
        runs, copies = name_runs(sizes, known, (), hashes.__getitem__, present.__contains__, Path)
        assert copies == {}
        assert len(set(runs.values())) == night
        for path, run in runs.items():
            assert run_of.setdefault(logs[path], run) == run
        known = know(runs, logs)


def test_a_log_that_was_moved_keeps_its_run() -> None:
    old = KnownRun("old/name", hash_of(0), 0, Path("/x/old/name.mcap"))
    first, second = Path("/x/a/1.mcap"), Path("/y/a/1.mcap")
    assert name_all({first: 0, second: 0}, [old], is_present=False) == (
        {first: "old/name"},
        {second: "old/name"},
    )
    assert name_all({first: 0}, [old]) == ({}, {first: "old/name"})


def test_a_log_that_cannot_be_read_is_no_copy() -> None:
    first, second = Path("/x/a/1.mcap"), Path("/x/b/1.mcap")
    runs, copies = name_runs({first: 0, second: 0}, [], (), lambda _path: "", lambda _run: True, Path)
    assert (runs, copies) == ({first: "a/1", second: "b/1"}, {})
