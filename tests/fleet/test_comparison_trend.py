"""`slip trend`: what moved over the runs of a vehicle."""

from __future__ import annotations

import json
from datetime import UTC, date, datetime, timedelta
from typing import TYPE_CHECKING

import pytest
from comparison_store import Run, write_run

from pipeline.analysis.errors import JobError
from pipeline.analysis.trend import Trend, follow_trend, write_trend
from pipeline.cli.app import main
from pipeline.fleet import read_day
from pipeline.fleet.trend import describe_quiet
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path

FIRST = date(2026, 4, 20)


def stamp_of(day: date) -> int:
    return int(datetime(day.year, day.month, day.day, 12, tzinfo=UTC).timestamp()) * 1_000_000_000


def drive_a_season(store: Store, tracks: list[float], *, median: float = 1.0) -> None:
    for i, track in enumerate(tracks):
        day = FIRST + timedelta(days=i)
        write_run(
            store,
            Run(
                # Names out of order: dates must come from the clock.
                name=f"run_{(7 * i) % len(tracks):02d}",
                dataset="warthog-2_gravel",
                vehicle="warthog-2",
                median=median,
                seconds=30.0,
                start_ns=stamp_of(day),
                findings=[("heading_skew", "warning", 0.1)],
                parameters=[("effective_track", "k", track, "1")],
            ),
        )


def follow(store: Store, **asked: object) -> Trend:
    options = {"by": ("vehicle",), "threshold": 0.1, "limits": {}, **asked}
    return follow_trend(store, **options)  # type: ignore[arg-type]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def test_a_track_that_moved_is_said_with_its_day(store: Store) -> None:
    wobble = [0.01, -0.02, 0.015, -0.01, 0.02, -0.015, 0.0]
    tracks = [1.8 + wobble[i % 7] for i in range(13)] + [2.1 + wobble[i % 7] for i in range(6)]
    drive_a_season(store, tracks)
    found = follow(store)
    (alert,) = [alert for alert in found.alerts if alert.quantity.startswith("effective_track")]
    assert alert.text.startswith(
        "effective_track.k (measured) of warthog-2 moved from 1.8 to 2.1 since 2026-05-03 "
        "(13 runs before, 6 since"
    )
    quantities = {one.quantity for one in found.series}
    assert {"median_modulus (command)", "finding heading_skew", "warnings", "suspect share"} <= quantities
    page = write_trend(store, found).read_text(encoding="utf-8")
    assert "moved from 1.8 to 2.1" in page


def test_small_steps_raise_no_alert_and_few_runs_are_said(store: Store) -> None:
    drive_a_season(store, [1.8] * 6 + [1.85] * 6)
    found = follow(store)
    steady = next(one for one in found.series if one.quantity.startswith("effective_track"))
    assert [step.after for step in steady.steps] == pytest.approx([1.85])
    assert not [alert for alert in found.alerts if alert.quantity == steady.quantity]


def test_where_all_stands_still_nothing_moved(store: Store) -> None:
    drive_a_season(store, [1.8] * 8)
    found = follow(store)
    assert not found.alerts
    assert describe_quiet(found.series) == "nothing moved beyond the threshold"
    assert "Nothing moved beyond the threshold" in write_trend(store, found).read_text(encoding="utf-8")


def test_too_few_runs_are_said(store: Store) -> None:
    drive_a_season(store, [1.8, 1.8, 1.8, 2.4, 2.4, 2.4])
    found = follow(store)
    assert not found.alerts
    assert any("too few runs to find a change, 8 are needed: warthog-2" in note for note in found.notes)


def test_where_no_group_has_enough_runs_nothing_is_said_to_stand_still(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    drive_a_season(store, [1.8])
    with pytest.raises(SystemExit) as ended:
        main(["trend", str(store.root), "--by", "vehicle"])
    assert ended.value.code == 0
    said = "nothing could be tested: a change of level takes 8 runs, the most of a group is 1"
    spoken = capsys.readouterr().out
    assert spoken.startswith(said)
    assert "nothing moved" not in spoken
    page = (store.root / "trend.html").read_text(encoding="utf-8")
    assert said[1:] in page
    assert "Nothing moved" not in page


def test_the_exit_code_serves_a_nightly_job(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    drive_a_season(store, [1.8, 1.8], median=1.0)
    for limit, code in (("median_modulus=9.0", 0), ("median_modulus=0.1", 4), ("nonsense", 1)):
        with pytest.raises(SystemExit) as ended:
            main(["trend", str(store.root), "--by", "vehicle", "--limit", limit, "--json"])
        assert ended.value.code == code
        spoken = capsys.readouterr().out
        if code != 1:
            assert bool(json.loads(spoken)["alerts"]) == (code == 4)


def test_several_limits_and_unknown_ones(store: Store) -> None:
    drive_a_season(store, [1.8, 1.8])
    found = follow(store, limits={"warnings": 0.0, "beauty": 1.0})
    assert [alert.quantity for alert in found.alerts] == ["warnings"]
    assert any("'beauty'" in note for note in found.notes)


def test_runs_without_a_date_are_left_out_and_said(store: Store) -> None:
    write_run(store, Run(name="undated", start_ns=0))
    with pytest.raises(JobError, match="no run with a date; left out, because no date is known: undated"):
        follow(store)


@pytest.mark.parametrize(
    ("name", "day"),
    [
        ("warthog_2024_8_7_11h30s30", "2024-08-07"),
        ("2026-05-03_gravel", "2026-05-03"),
        ("run_2024_13_40", None),
        ("run_7", None),
    ],
)
def test_dates_in_names_are_read(name: str, day: str | None) -> None:
    assert read_day(name) == day
