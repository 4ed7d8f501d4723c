"""A configuration that nobody would write is one clear line with the file and the key, at once."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING

import pytest

from pipeline.sources import ConfigurationError, load_configuration

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("[velocity]\nrate_hz = inf\n", 2, "velocity.rate_hz = inf is not a finite number"),
        ("[slip]\nlength_scale_m = nan\n", 2, "slip.length_scale_m = nan"),
        ("[vehicle]\nwheel_radius_m = +inf\n", 2, "vehicle.wheel_radius_m"),
        ("[vehicle]\nbase_to_rear_axle_m = -nan\n", 2, "vehicle.base_to_rear_axle_m"),
        ("[[interval]]\nstart_s = -inf\n", 2, "interval.start_s"),
        (f"[slip]\nlength_scale_m = 1{'0' * 400}\n", 2, "more than 64 bits"),
        (f"[slip]\nlength_scale_m = 1{'0' * 5000}\n", None, "thousands of digits"),
        ("a = " + "[" * 100_000, None, "deep"),
        ("a = " + "[" * 50 + "]" * 50, 1, "deep"),
        ("[slip]\n" + "a." * 100_000 + "b = 1\n", 2, "parts"),
        ("[slip]\n" + '"a" . ' * 100_000 + "b = 1\n", 2, "parts"),
        ("[" + "a." * 100_000 + "b]\n", 1, "parts"),
        ("a = 1\n" * 500_000, None, "longer than"),
        ("[slip]\nlength_scale_m = 0xzz\n", 2, "not a valid TOML"),
    ],
)
def test_one_line_names_the_file_and_the_key(tmp_path: Path, text: str, line: int | None, says: str) -> None:
    path = tmp_path / "run.toml"
    path.write_text(text, encoding="utf-8")
    begin = time.monotonic()
    with pytest.raises(ConfigurationError) as caught:
        load_configuration(tmp_path / "log.mcap")
    assert time.monotonic() - begin < 2.0
    assert says in caught.value.what
    assert caught.value.where == (f"{path}, line {line}" if line else str(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files away")
def test_a_strangers_fleet_file_above_a_log_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").mkdir()
    fleet = tmp_path / "fleet.toml"
    fleet.write_text('[[match]]\nglob = "*"\n[match.run]\nterrain = "lava"\n')
    log = tmp_path / "mine" / "run.mcap"
    assert load_configuration(log).run.terrain == "lava"
    user = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: user)
    os.chown(tmp_path / "mine", user, -1)
    os.chown(fleet, user + 1, -1)
    assert load_configuration(log).run.terrain is None
    # In a folder of somebody's, that one's fleet file counts, and so does one that is named.
    os.chown(tmp_path / "mine", user + 1, -1)
    assert load_configuration(log).run.terrain == "lava"
    os.chown(tmp_path / "mine", user, -1)
    assert load_configuration(log, fleet=fleet).run.terrain == "lava"
