"""Paths that tests of every room share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is slow, not wrong: properties are checked, not timed.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"


@pytest.fixture(scope="session")
def samples() -> Path:
    return ROOT / "data_samples"


@pytest.fixture(scope="session")
def shared_logs() -> Path:
    folder = SHARED / "logs"
    if not folder.is_dir():
        pytest.skip("../shared/logs is not here: the real recordings are not part of the repository")
    return folder


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pictures of pages are kept: SLIP_PICTURES, or the tests' own folder."""
    kept = os.environ.get("SLIP_PICTURES")
    return Path(kept).resolve() if kept else tmp_path_factory.mktemp("pictures")
