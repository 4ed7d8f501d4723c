"""A short run of the fuzz target of the exports; an hour is `python tests/fuzz/fuzz_exports.py`."""

import math
from pathlib import Path

import pytest
from exported_texts import READERS
from fuzz_exports import run

from pipeline.export import list_targets


@pytest.mark.long
def test_odd_models_are_exported_as_data_or_refused_in_one_line(tmp_path: Path) -> None:
    counts = run(math.inf, 1, tmp_path, most=25)
    assert min(counts[name] for name in ("read", "refused", "python", "json", "gazebo", "csv")) > 0
    assert not list(tmp_path.iterdir())


def test_all_targets_have_a_reader() -> None:
    assert set(READERS) == {target.name for target in list_targets()}


@pytest.mark.long
@pytest.mark.parametrize(
    ("target", "text"),
    [
        ("python", 'VEHICLE = ""\n""""""; EXECUTED = 1; """"""\n'),
        ("gazebo", "<plugin><!-- a---></plugin>"),
        ("gazebo", "<plugin><wheel_radius>nan</wheel_radius></plugin>"),
        ("nav2", "a: .inf"),
        ("json", '{"vehicle": NaN}'),
        ("px4", "1\t1\tRO_SPEED_LIM\tinf\t9"),
    ],
)
def test_the_readers_notice_what_they_look_for(target: str, text: str) -> None:
    with pytest.raises((AssertionError, ValueError, SyntaxError)):
        READERS[target](text)
