"""Numbers of two groups of runs: what is called a change, how seldom wrongly, and what would be found."""

import numpy as np
import pytest

from pipeline.core.arrays import Floats
from pipeline.datasets.changes import AFTER, BEFORE, CHANCE, Change, RunNumbers, compare_sides

COUNT = 4
USUAL = np.full(COUNT, 0.3)


def draw_runs(
    draw: np.random.Generator,
    runs: int,
    *,
    shift: Floats | None = None,
    error: float = 0.1,
    spread: float = 0.0,
    shared: float = 0.0,
) -> list[RunNumbers]:
    """So many runs a side; numbers of one run have errors that share so much of their variance."""
    covariance = error**2 * ((1.0 - shared) * np.eye(COUNT) + shared)
    found = []
    for side in (BEFORE, AFTER):
        for number in range(runs):
            values = draw.multivariate_normal(np.ones(COUNT), covariance) + spread * draw.normal(size=COUNT)
            moved = values + shift if shift is not None and side == AFTER else values
            found.append(RunNumbers(f"{side} {number}", side, moved, covariance))
    return found


def list_changed(found: list[Change]) -> list[int]:
    return [place for place, change in enumerate(found) if change.status == "changed"]


@pytest.mark.parametrize("runs", [2, pytest.param(3, marks=pytest.mark.long)])
def test_runs_that_differ_as_is_usual_raise_few_alarms(runs: int) -> None:
    draw = np.random.default_rng(7)
    usual = 0.3
    alarms = 0
    for _ in range(200):
        spread = usual * abs(float(draw.normal()))
        alarms += bool(list_changed(compare_sides(draw_runs(draw, runs, spread=spread), USUAL)))

    # 2.5 % of 200 are 5; nine or more come by chance once in thirty such tests.
    assert alarms <= 8


def test_recordings_of_alike_runs_raise_few_alarms() -> None:
    draw = np.random.default_rng(8)
    alarms = sum(bool(list_changed(compare_sides(draw_runs(draw, 1), USUAL, alike=True))) for _ in range(200))

    assert alarms <= 8


def test_of_numbers_with_shared_errors_the_one_that_changed_is_named() -> None:
    draw = np.random.default_rng(9)
    shift = np.array([0.0, 0.8, 0.0, 0.0])

    named = [
        list_changed(compare_sides(draw_runs(draw, 3, shift=shift, shared=0.9), USUAL)) for _ in range(30)
    ]

    assert sum(one == [1] for one in named) >= 27


def test_single_runs_do_not_show_what_several_do() -> None:
    draw = np.random.default_rng(10)
    shift = np.array([0.6, 0.0, 0.0, 0.0])

    (single, *_) = compare_sides(draw_runs(draw, 1, shift=shift), USUAL)
    (several, *_) = compare_sides(draw_runs(draw, 4, shift=shift), USUAL)

    assert single.status == "differs"
    assert single.is_default
    assert single.p_within <= CHANCE < single.p
    assert several.status == "changed"
    assert not several.is_default
    assert several.low < 0.6 < several.high


def test_single_runs_show_no_change_however_far_they_are_apart() -> None:
    draw = np.random.default_rng(10)
    far = np.array([30.0, 0.0, 0.0, 0.0])

    single = compare_sides(draw_runs(draw, 1, shift=far), USUAL)
    settings = compare_sides(draw_runs(draw, 1, shift=far), np.array([0.0, 0.3, 0.3, 0.3]))

    assert single[0].p < 0.02
    assert single[0].status == "differs"
    # A setting is the same in all runs without a change.
    assert settings[0].status == "changed"


def test_a_difference_whose_interval_holds_zero_is_none() -> None:
    draw = np.random.default_rng(11)
    for _ in range(50):
        found = compare_sides(draw_runs(draw, 1, shift=np.array([0.3, 0.25, 0.3, 0.3]), shared=0.95), USUAL)
        assert all(one.within[0] * one.within[1] > 0.0 for one in found if one.status == "differs")


def test_the_runs_that_are_asked_for_show_the_difference() -> None:
    draw = np.random.default_rng(11)
    shift = np.array([0.6, 0.0, 0.0, 0.0])
    (single, *_) = compare_sides(draw_runs(draw, 1, shift=shift), USUAL)
    more = single.count_missing()
    assert more is not None
    runs = 1 + more

    found = [compare_sides(draw_runs(draw, runs, shift=shift), USUAL)[0].status for _ in range(20)]

    assert found.count("changed") >= 14
    assert 1 <= more <= 6


@pytest.mark.parametrize(
    "size", [pytest.param(0.7, marks=pytest.mark.long), 1.0, pytest.param(1.4, marks=pytest.mark.long)]
)
def test_a_change_is_found_as_often_as_is_said(size: float) -> None:
    draw = np.random.default_rng(12)
    # Spreads as they are believed to be: those of single runs cannot be told by the runs themselves.
    said, found = [], []
    (asked, *_) = compare_sides(draw_runs(draw, 2), USUAL)
    change = size * asked.smallest
    for _ in range(200):
        spread = float(np.abs(draw.normal())) * USUAL[0]
        (one, *_) = compare_sides(
            draw_runs(draw, 2, shift=np.array([change, 0.0, 0.0, 0.0]), spread=spread), USUAL
        )
        said.append(one.find_power(change))
        found.append(one.status == "changed")

    assert np.mean(found) == pytest.approx(np.mean(said), abs=0.08)


def test_a_number_that_one_side_does_not_tell_is_unknown_and_spoils_no_other() -> None:
    draw = np.random.default_rng(13)
    runs = draw_runs(draw, 2, shift=np.array([0.0, 1.5, 0.0, 0.0]), shared=0.5)
    blind = [
        RunNumbers(one.run, one.side, np.where(np.arange(COUNT) == 0, np.nan, one.values), one.covariance)
        if one.side == AFTER
        else one
        for one in runs
    ]

    found = compare_sides(blind, USUAL)

    assert found[0].status == "unknown"
    assert np.isfinite(found[0].before)
    assert np.isnan(found[0].after)
    assert list_changed(found) == [1]


def test_units_do_not_matter() -> None:
    draw = np.random.default_rng(14)
    runs = draw_runs(draw, 3, shift=np.array([0.5, 0.0, 0.2, 0.0]), shared=0.5)
    unit = np.array([1e-4, 1.0, 1e5, 10.0])
    scaled = [
        RunNumbers(one.run, one.side, one.values * unit, one.covariance * np.outer(unit, unit))
        for one in runs
    ]

    plain, other = compare_sides(runs, USUAL), compare_sides(scaled, USUAL * unit)

    for one, two, size in zip(plain, other, unit.tolist(), strict=True):
        assert two.status == one.status
        assert two.p == pytest.approx(one.p, rel=1e-6)
        assert two.smallest == pytest.approx(one.smallest * size, rel=1e-6)


def test_other_runs_of_the_robot_decide_what_a_pair_alone_does_not() -> None:
    draw = np.random.default_rng(12)
    shift = np.array([0.6, 0.0, 0.0, 0.0])
    pair = draw_runs(draw, 1, shift=shift, error=0.02, spread=0.05)
    others = {"grass": draw_runs(draw, 8, error=0.02, spread=0.05)}

    alone, *_ = compare_sides(pair, USUAL)
    known, *_ = compare_sides(pair, USUAL, others=others)

    assert (alone.status, alone.freedom) == ("differs", 0)
    # Sixteen runs of one ground: fifteen degrees of freedom, whatever side they are drawn for.
    assert (known.status, known.freedom) == ("changed", 15)
    assert known.spread < 0.1 < alone.spread
    assert known.smallest < 0.5 * alone.smallest
    assert known.p_alone < alone.p_alone


def test_other_runs_that_differ_much_keep_a_pair_undecided() -> None:
    draw = np.random.default_rng(13)
    pair = draw_runs(draw, 1, shift=np.array([0.6, 0.0, 0.0, 0.0]), error=0.02)
    wide = {"grass": draw_runs(draw, 8, error=0.02, spread=0.6)}

    assert compare_sides(pair, USUAL, others=wide)[0].status == "differs"


def test_pairs_beside_other_runs_raise_few_alarms() -> None:
    draw = np.random.default_rng(14)
    alarms = 0
    for _ in range(200):
        spread = 0.3 * abs(float(draw.normal()))
        others = {"grass": draw_runs(draw, 4, spread=spread)}
        alarms += bool(list_changed(compare_sides(draw_runs(draw, 1, spread=spread), USUAL, others=others)))

    # 2.5 % of 200 are 5; nine or more come by chance once in thirty such tests.
    assert alarms <= 8
