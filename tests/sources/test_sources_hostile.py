"""A configuration that nobody would write is one clear line with the file and the key, at once."""

import os
from pathlib import Path

import pytest

from pipeline.sources import load_configuration


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
