"""Parameters of a vehicle over dates: when they changed, whatever ground each run was on."""

from collections.abc import Sequence

import numpy as np
import polars as pl
import pytest

from pipeline.datasets.trend import ParameterTrend, follow_parameters, format_change

GROUNDS = {"asphalt": 1.76, "gravel": 1.7, "sand": 1.92}


def make_season(
    rng: np.random.Generator,
    grounds: Sequence[str],
    *,
    spread: float = 0.02,
    step: float = 0.0,
    since: int = 0,
    numbers: Sequence[tuple[str, str]] = (("effective_track", "k"),),
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Estimates of runs on successive days, and their days."""
    days = pl.DataFrame(
        {
            "run": [f"r{i:02d}" for i in range(len(grounds))],
            "day": [f"2026-05-{i + 1:02d}" for i in range(len(grounds))],
        }
    ).with_row_index("order")
    rows = []
    for effect, parameter in numbers:
        for i, ground in enumerate(grounds):
            error = float(rng.uniform(0.005, 0.03))
            value = GROUNDS[ground] + step * (i >= since) + float(np.hypot(spread, error) * rng.normal())
            rows.append(
                {
                    "run": f"r{i:02d}", "dataset": "w", "vehicle": "warthog", "terrain": ground,
                    "input": "command", "effect": effect, "parameter": parameter, "unit": "1", "value": value,
                    "standard_error": error, "named": True, "at_bound": False,
                }
            )  # fmt: skip
    return pl.DataFrame(rows), days.with_columns(pl.col("order").cast(pl.Int64))


def follow_one(season: tuple[pl.DataFrame, pl.DataFrame]) -> ParameterTrend:
    (trend,) = follow_parameters(*season, level=0.05)
    return trend


def test_a_change_is_found_across_grounds_that_differ_more() -> None:
    rng = np.random.default_rng(1)
    grounds = rng.choice(list(GROUNDS), 16).tolist()
    trend = follow_one(make_season(rng, grounds, step=0.15, since=9))
    (change,) = trend.changes
    assert change.since == "2026-05-10"
    assert change.after - change.before == pytest.approx(0.15, abs=0.04)
    # Seen on several grounds alike: the vehicle changed, no ground did.
    assert format_change(trend, change).endswith("likely a change of tyre pressure or load")
    inside = (pl.col("value") > pl.col("limit_low")) & (pl.col("value") < pl.col("limit_high"))
    assert trend.points.select(inside.all()).item()


def test_other_ground_is_no_change_of_the_vehicle() -> None:
    rng = np.random.default_rng(2)
    trend = follow_one(make_season(rng, ["asphalt"] * 8 + ["sand"] * 8))
    assert trend.changes == ()


def test_on_one_ground_the_ground_may_have_changed() -> None:
    trend = follow_one(make_season(np.random.default_rng(3), ["asphalt"] * 12, step=0.2, since=6))
    (change,) = trend.changes
    assert change.likely == "a change of tyre pressure or load, or other terrain"


def test_a_run_that_stands_apart_is_no_change_and_hides_none() -> None:
    estimates, days = make_season(np.random.default_rng(4), ["asphalt"] * 16, step=0.15, since=9)
    odd = estimates.with_columns(pl.when(pl.col("run") == "r04").then(3.0).otherwise("value").alias("value"))
    trend = follow_one((odd, days))
    assert trend.odd == ("r04",)
    assert [change.run for change in trend.changes] == ["r09"]


def test_runs_say_what_change_they_would_tell() -> None:
    few, many = (follow_one(make_season(np.random.default_rng(5), ["asphalt"] * runs)) for runs in (5, 20))
    assert not few.need
    assert 0.02 < many.least < few.least
    told = [
        bool(
            follow_one(
                make_season(np.random.default_rng([6, i]), ["asphalt"] * 20, step=many.least * 1.5, since=10)
            ).changes
        )
        for i in range(20)
    ]
    assert sum(told) >= 15


def test_runs_that_agree_exactly_tell_no_change_below_their_own_errors() -> None:
    estimates, days = make_season(np.random.default_rng(7), ["asphalt"] * 8)
    equal = follow_one((estimates.with_columns(value=pl.lit(1.5)), days))
    assert equal.least > estimates["standard_error"].min()


def test_a_run_that_does_not_determine_a_number_sets_no_scale() -> None:
    estimates, days = make_season(np.random.default_rng(8), ["asphalt"] * 12)
    is_last = pl.col("run") == "r11"
    others = follow_one((estimates.filter(~is_last), days))
    wide = estimates.with_columns(standard_error=pl.when(is_last).then(4e5).otherwise("standard_error"))
    bound = estimates.with_columns(at_bound=is_last)
    for season in (wide, bound):
        trend = follow_one((season, days))
        assert trend.undetermined == ("r11",)
        assert "r11" not in trend.points["run"].to_list()
        assert trend.least == others.least < 0.1
        assert trend.shown_latest.endswith(" (undetermined)")
    alone = follow_parameters(wide.filter(is_last), days, level=0.05)
    assert alone == ()


@pytest.mark.long
@pytest.mark.parametrize("runs", [5, 9, 20])
def test_seasons_without_a_change_seldom_raise_an_alert(runs: int) -> None:
    numbers = [("effective_track", "k"), ("wheel_radius", "k"), ("lateral_skid", "c")]
    wrong, seasons = 0, 400
    for number in range(seasons):
        rng = np.random.default_rng([runs, number])
        grounds = rng.choice(list(GROUNDS)[: 1 + runs // 8], runs).tolist()
        season = make_season(rng, grounds, spread=float(rng.choice([0.0, 0.02, 0.1])), numbers=numbers)
        wrong += any(trend.changes for trend in follow_parameters(*season, level=0.05))
    # Three deviations of a count at 5 %.
    assert wrong <= 0.05 * seasons + 3.0 * (0.05 * 0.95 * seasons) ** 0.5
