"""The verbs as scripts use them: JSON, exit codes, one clear line."""

from pathlib import Path

import pytest
from verbs import run_slip

from pipeline.batch.batch_run import Line
from pipeline.cli.screen import LineWatch

INLINE = ("--executor", "inline", "--settle", "0")


def test_a_name_that_begins_with_a_dash_goes_behind_two(
    season: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (season / "a.mcap").rename(season / "-a.mcap")
    monkeypatch.chdir(season)
    assert run_slip("batch", "-a.mcap", "--results", tmp_path / "out", *INLINE)[0] == 2
    assert run_slip("batch", "--results", tmp_path / "out", *INLINE, "--", "-a.mcap")[0] == 0
    assert "--" in run_slip("batch", "--help")[1].split("dash")[0][-60:]


def test_estimates_do_without_sizes() -> None:
    watch = LineWatch()
    watch.plan(4, 0, 1000)
    watch.notify(Line(path="empty", state="failed"), 0)
    assert 0.0 <= watch.estimate_rest() < 10.0
    watch.notify(Line(path="large", state="done"), 1000)
    assert watch.estimate_rest() == 0.0
