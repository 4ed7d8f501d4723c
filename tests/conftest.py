"""Paths that tests of every room share."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from chrome import BROWSER, Browser, Chrome
from deep_folders import dig  # noqa: F401
from golden import check_golden  # noqa: F401
from hypothesis import settings
from known_misses import MISSES
from stored import diagnosed_results, place, recorded_results, stored_run  # noqa: F401

# A busy machine is slow, not wrong: properties are not timed. `--hypothesis-profile many` draws more.
settings.register_profile("few", deadline=None, max_examples=30)
settings.register_profile("many", deadline=None, max_examples=500)
settings.load_profile("few")
# Lines are whole where nobody looks; a worker of pytest-xdist is told the width of the terminal.
os.environ.pop("COLUMNS", None)

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is known to be missed; a test that passes again fails until it leaves the list."""
    for item in items:
        reason = MISSES.get(item.nodeid)
        if reason is not None:
            item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--golden", action="store_true", help="write the files of tests/golden anew")


_CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


@pytest.fixture(scope="session", autouse=True)
def own_core() -> None:
    """Each worker of pytest-xdist has a core of its own: tests beside it would only slow a second process."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker and _CORES:
        os.sched_setaffinity(0, {_CORES[int(worker[2:]) % len(_CORES)]})


@pytest.fixture
def every_core() -> Iterator[None]:
    """A test of what runs on several cores has them all."""
    if not _CORES:
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, _CORES)
    yield
    os.sched_setaffinity(0, own)


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
def foreign_logs() -> Path:
    folder = SHARED / "foreign"
    if not folder.is_dir():
        pytest.skip("../shared/foreign is not here: others' recordings are not part of the repository")
    return folder


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pictures of pages are kept: SLIP_PICTURES, or the tests' own folder."""
    kept = os.environ.get("SLIP_PICTURES")
    return Path(kept).resolve() if kept else tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all tests of a worker: to start it takes a second."""
    if BROWSER is None:
        pytest.skip("no Chromium here to look at the pages with (`make browser` installs one)")
    browser = Browser(tmp_path_factory.mktemp("browser") / "profile")
    yield browser
    browser.close()


@pytest.fixture
def chrome(browser: Browser) -> Iterator[Chrome]:
    """A page that nobody has opened before; the test is left out, saying so, where there is no browser."""
    page = Chrome(browser)
    yield page
    page.close()
