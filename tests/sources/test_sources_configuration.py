"""Configuration: which file wins, and that every mistake is one clear line."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.sources import ConfigurationError, explain_unread, load_configuration, merge

Write = Callable[[str, str], Path]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    folder = tmp_path / "season" / "2026" / "monday"
    folder.mkdir(parents=True)
    path = folder / "warthog_ice.mcap"
    path.touch()
    return path


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write_file(name: str, text: str) -> Path:
        path = tmp_path / "season" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write_file


def test_folders_inherit_and_the_nearer_file_wins(log: Path, write: Write) -> None:
    write("fleet.toml", '[run]\nterrain = "snow"\ndataset = "season"\n[velocity]\nrate_hz = 10\n')
    write("2026/fleet.toml", '[run]\nterrain = "ice"\n')
    found = load_configuration(log)
    assert (found.run.terrain, found.run.dataset, found.velocity.rate_hz) == ("ice", "season", 10.0)


def test_of_several_matches_the_last_wins(log: Path, write: Write) -> None:
    write(
        "fleet.toml",
        '[run]\nterrain = "plain"\n'
        '[[match]]\nglob = "2026/*/warthog*"\n[match.run]\nterrain = "first"\ndataset = "kept"\n'
        '[[match]]\nglob = "*.mcap"\n[match.run]\nterrain = "last"\n'
        '[[match]]\nglob = "2025/*"\n[match.run]\nterrain = "never"\n',
    )
    found = load_configuration(log)
    assert (found.run.terrain, found.run.dataset) == ("last", "kept")


def test_a_nearer_fleet_file_wins_over_a_match_further_up(log: Path, write: Write) -> None:
    write("fleet.toml", '[[match]]\nglob = "*"\n[match.run]\nterrain = "far"\n')
    write("2026/monday/fleet.toml", '[run]\nterrain = "near"\n')
    assert load_configuration(log).run.terrain == "near"


def test_the_run_file_wins_over_fleets_and_the_command_line_over_all(log: Path, write: Write) -> None:
    write("fleet.toml", '[[match]]\nglob = "*"\n[match.run]\nterrain = "fleet"\n')
    write("2026/monday/run.toml", '[run]\nterrain = "run"\ndataset = "run"\n')
    assert load_configuration(log).run.terrain == "run"
    found = load_configuration(log, overrides={"run": {"terrain": "typed"}})
    assert (found.run.terrain, found.run.dataset) == ("typed", "run")


def test_a_file_named_like_the_log_speaks_of_it_alone(log: Path, write: Write) -> None:
    write("2026/monday/run.toml", '[run]\nterrain = "all"\n')
    write("2026/monday/warthog_ice.toml", '[run]\nterrain = "this"\n')
    other = log.with_name("husky.mcap")
    other.touch()
    assert load_configuration(log).run.terrain == "this"
    assert load_configuration(other).run.terrain == "all"


def test_a_recording_that_is_a_folder_has_its_configuration_beside_it_or_in_it(write: Write) -> None:
    folder = write("2026/bag/metadata.yaml", "").parent
    write("2026/run.toml", '[run]\nterrain = "beside"\ndataset = "beside"\n')
    found = load_configuration(folder)
    assert (found.run.terrain, found.run.dataset) == ("beside", "beside")
    write("2026/bag/run.toml", '[run]\nterrain = "inside"\n')
    found = load_configuration(folder)
    assert (found.run.terrain, found.run.dataset) == ("inside", "beside")


def test_a_mark_before_the_text_is_none_of_it(log: Path, write: Write) -> None:
    write("2026/monday/run.toml", '\ufeff[run]\nterrain = "ice"\n')
    assert load_configuration(log).run.terrain == "ice"


def test_an_interval_in_single_brackets_is_told_how_it_is_written(log: Path, write: Write) -> None:
    write("2026/monday/run.toml", "[interval]\nstart_s = 10\n")
    with pytest.raises(ConfigurationError, match=r"line 1.*a list belongs there.*Write \[\[interval\]\]"):
        load_configuration(log)


def test_a_given_file_stands_in_for_the_one_beside_the_log(log: Path, write: Write) -> None:
    write("2026/monday/run.toml", '[run]\nterrain = "beside"\ndataset = "beside"\n')
    given_file = write("elsewhere/my.toml", '[run]\nterrain = "given"\n')
    found = load_configuration(log, given=given_file)
    assert (found.run.terrain, found.run.dataset) == ("given", None)


def test_another_preset_does_not_inherit_a_geometry(log: Path, write: Write) -> None:
    write("fleet.toml", '[vehicle]\npreset = "husky"\ntrack_width_m = 0.56\nwheel_radius_m = 0.17\n')
    write("2026/fleet.toml", '[vehicle]\npreset = "warthog"\n')
    assert load_configuration(log).vehicle.track_width_m is None
    write("2026/fleet.toml", '[vehicle]\npreset = "husky_a200"\nwheel_radius_m = 0.18\n')
    found = load_configuration(log).vehicle
    assert (found.track_width_m, found.wheel_radius_m) == (0.56, 0.18)


@pytest.mark.parametrize(
    ("name", "text", "is_told"),
    [
        ("Run.toml", "", True),
        ("RUN.TOML", "", True),
        ("fleet.toml", "[run]\nterrain = 'ice'\n", False),
        ("settings.toml", "[wheels]\nsign = -1\n", True),
        ("run.toml", "[wheels]\nsign = -1\n", False),
        ("warthog_ice.toml", "[wheels]\nsign = -1\n", False),
        ("other.toml", "[wheels]\nsign = -1\n", False),
        ("pyproject.toml", "[tool.x]\ny = 1\n", False),
        ("model.toml", "format = 1\n[vehicle]\n", False),
        ("broken.toml", "[wheels", False),
    ],
)
def test_a_file_beside_the_log_that_is_not_read_is_told(
    name: str,
    text: str,
    is_told: bool,  # noqa: FBT001
    log: Path,
) -> None:
    log.with_name("other.mcap").touch()
    log.with_name(name).write_text(text, encoding="utf-8")
    told = (
        f"{name} beside the log is not read: name it run.toml or warthog_ice.toml, or give it with --config"
    )
    assert explain_unread(log) == (told if is_told else "")


def test_a_file_in_a_recording_that_is_a_folder_has_one_name(log: Path) -> None:
    (log.parent / "rec1").mkdir()
    for name in ("rec1_0.mcap", "rec1_0.toml"):
        (log.parent / "rec1" / name).write_text("[wheels]\nsign = -1\n", encoding="utf-8")
    assert explain_unread(log.parent / "rec1").startswith(
        "rec1_0.toml beside the log is not read: name it run.toml,"
    )


trees = st.recursive(
    st.integers(), lambda below: st.dictionaries(st.sampled_from("abc"), below, max_size=3), max_leaves=8
).filter(lambda tree: isinstance(tree, dict))


@given(trees, trees, trees)
def test_merging_is_associative_and_the_empty_layer_changes_nothing(a: dict, b: dict, c: dict) -> None:
    assert merge([a, b, c]) == merge([merge([a, b]), c])
    assert merge([a, {}]) == merge([{}, a]) == a
