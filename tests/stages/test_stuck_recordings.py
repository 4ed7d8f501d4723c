"""What is told of a real drive on snow, in which a Husky spins its wheels and turns slowly."""

from pathlib import Path

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log


def test_a_body_that_turned_while_its_wheels_spun_was_not_stuck(shared_logs: Path, tmp_path: Path) -> None:
    """It turned by 200 degrees from 98 to 107 s, by its gyro and by its poses."""
    log = shared_logs / "husky_snow_boreal.mcap"
    if not log.is_file():
        pytest.skip("../shared/logs is not here: the real recordings are not part of the repository")
    manifest = analyze_log(log, Options(out=tmp_path, report=False, diagnosis=False)).manifest
    events = manifest.read("events")
    stuck = events.filter(events["kind"].cast(str) == "stuck")
    assert stuck.filter((stuck["t_start"] < 107.0) & (stuck["t_end"] > 98.0)).is_empty()
    # Where the body did less than a tenth of what its wheels did, it still is.
    assert 3 <= stuck.height <= 5
