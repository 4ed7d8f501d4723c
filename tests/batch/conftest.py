import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from multiprocessing import forkserver
from pathlib import Path

import pytest

from pipeline.simulate import simulate_case

if find_spec("s3fs") and find_spec("moto"):
    # Tests that need an object store are left out where there is no library for it.
    from object_store import bucket, server  # noqa: F401


@pytest.fixture(autouse=True)
def fresh_server() -> Iterator[None]:
    """Worker processes have the environment of the test, and not that of the first one."""
    yield
    forkserver._forkserver._stop()


NAMES = ("a", "b", "c", "d")


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short logs with known physics, of two vehicles."""
    folder = tmp_path_factory.mktemp("originals")
    for number, name in enumerate(NAMES):
        case = "warthog_ice" if name == "d" else "husky_tile"
        simulate_case(case, out=folder / f"{name}.mcap", duration_s=12.0 + number, seed=number)
    return folder


@pytest.fixture
def season(originals: Path, tmp_path: Path) -> Path:
    """A folder of logs that a test may change."""
    folder = tmp_path / "season"
    shutil.copytree(originals, folder)
    return folder
