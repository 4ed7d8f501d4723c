"""Paths that tests of every room share."""

from __future__ import annotations

from pathlib import Path

import pytest

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
