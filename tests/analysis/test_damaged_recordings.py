"""A damaged recording gives no wrong number without a word: a few damages of each format.

`make bench NAME=damage ARGS="--analyses 500"` makes many, of real recordings, too.
"""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from damaged_analyses import (
    DAMAGES,
    KINDS,
    OUTCOMES,
    Analyzed,
    Damage,
    analyze,
    damage_one,
    is_equal,
    write_formats,
)
from few import few

FORMATS = (".mcap", ".bag", ".db3")
SECONDS = 20.0


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory, samples: Path) -> dict[str, tuple[Path, Analyzed]]:
    """The same drive in three formats, and what an analysis says of each."""
    paths = write_formats(tmp_path_factory.mktemp("whole"), samples / "mystery_2.mcap", SECONDS)
    return {path.suffix: (path, analyze(path)) for path in paths}


def test_the_same_drive_has_the_same_slip_in_every_format(
    recordings: dict[str, tuple[Path, Analyzed]],
) -> None:
    found = [recordings[suffix][1] for suffix in FORMATS]
    assert not any(one.refusal or one.losses for one in found)
    for name in ("command", "measured"):
        medians = [(one.slip or {})[name]["modulus"].median() for one in found]
        assert medians == pytest.approx([medians[0]] * len(FORMATS), rel=1e-6)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("kind", few(KINDS, 2))
def test_a_damaged_recording_is_refused_or_gives_the_slip_of_what_is_left(
    recordings: dict[str, tuple[Path, Analyzed]], suffix: str, kind: str
) -> None:
    path, whole = recordings[suffix]
    for number in (1, 2):
        _, outcome, details = damage_one(Damage(path, kind, number), whole)
        assert outcome in OUTCOMES[:3], details


def test_all_kinds_of_damage_change_the_file(
    recordings: dict[str, tuple[Path, Analyzed]], tmp_path: Path
) -> None:
    for suffix in FORMATS:
        content = recordings[suffix][0].read_bytes()
        for kind in KINDS:
            path = tmp_path / f"damaged{suffix}"
            path.write_bytes(content)
            DAMAGES[kind](path, np.random.default_rng(1))
            assert path.read_bytes() != content, kind


def test_a_wrong_number_is_noticed(recordings: dict[str, tuple[Path, Analyzed]]) -> None:
    _, whole = recordings[".mcap"]
    assert whole.slip is not None
    rows = whole.slip["command"]
    part = rows[rows.height // 2 :]
    assert is_equal(rows, part)
    assert not is_equal(rows, part.with_columns(pl.col("modulus") * 3.0))
    far = part.with_columns(pl.col("stamp") + 10**12, pl.col("t") + 1e3)
    assert not is_equal(rows, far)
    assert is_equal(rows, part.with_columns(pl.col("stamp") + 10**12))
