"""What the room writes: figures for papers, the bundle's cache."""

import os
import time
from pathlib import Path
from typing import Literal

import pytest
from report_synthesis import list_places, make_report

from pipeline.report import ReportError
from pipeline.report.page import write_figures
from pipeline.report.scene import RunReport
from pipeline.report.theme import (
    cache_path,
    load_bundle,
    warm_bundle,
)

START = {"svg": b"<svg", "pdf": b"%PDF", "png": b"\x89PNG"}


@pytest.fixture(scope="module")
def report() -> RunReport:
    return make_report(duration_s=40.0)


@pytest.mark.parametrize(
    "kind", ["svg", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("pdf", "png"))]
)
def test_the_figures_of_the_page_are_written_for_papers(
    report: RunReport, tmp_path: Path, kind: Literal["svg", "pdf", "png"]
) -> None:
    written = write_figures(report, tmp_path / "new" / "figures", kind)
    assert [path.name for path in written] == [f"{name}.{kind}" for name in list_places()]
    assert all(path.read_bytes().startswith(START[kind]) for path in written)


@pytest.mark.long
def test_a_figure_file_does_not_depend_on_when_it_was_written(report: RunReport, tmp_path: Path) -> None:
    first, second = (write_figures(report, tmp_path / name, "svg") for name in "ab")
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_an_unknown_format_and_a_blocked_folder_say_what_to_do(report: RunReport, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="Use one of svg, pdf, png"):
        write_figures(report, tmp_path, "gif")  # type: ignore[arg-type]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ReportError, match="Choose a folder"):
        write_figures(report, tmp_path / "file", "svg")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return cache_path()


def test_the_bundle_is_the_same_with_and_without_its_cache(cache: Path) -> None:
    fresh = load_bundle()
    assert "vegaEmbed" in fresh
    assert "</script" not in fresh.lower()
    assert "<!--" not in fresh
    assert cache.is_file()
    assert load_bundle() == fresh
    cache.write_bytes(cache.read_bytes()[:-10] + b"alert('x')")
    assert load_bundle() == fresh, "a damaged cache is made anew"
    assert [path.name for path in cache.parent.iterdir()] == [cache.name], "nothing half written stays"


@pytest.mark.long
def test_warming_fills_the_cache_without_waiting(cache: Path) -> None:
    start = time.perf_counter()
    warm_bundle()
    assert time.perf_counter() - start < 0.5
    deadline = time.perf_counter() + 30.0
    while not cache.is_file() and time.perf_counter() < deadline:
        time.sleep(0.05)
    assert cache.is_file()
    assert os.access(cache, os.R_OK)
