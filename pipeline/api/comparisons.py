"""Runs together: datasets side by side, causes, a fleet by level, trends, the map; each with its page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

from pipeline import datasets
from pipeline.core import FigureFormat
from pipeline.datasets import Answer, Causes, DeploymentMap, Fleet, Question, Trend
from pipeline.report import datasets_page
from pipeline.store import Store

Compared = TypeVar("Compared")


@dataclass(frozen=True)
class Written(Generic[Compared]):
    """A result of runs together, and where it was written.

    Attributes:
        result: as data.
        files: what was written, by name.
    """

    result: Compared
    files: Mapping[str, Path]

    @property
    def page(self) -> Path | None:
        """Its page; None where pages cannot be drawn."""
        return next((path for name, path in self.files.items() if name.endswith(".html")), None)


def compare_datasets(
    results: str | Path, question: Question, figures: FigureFormat | None = None
) -> Written[Answer]:
    """Compare datasets, as `slip compare` does, and write tables and page.

    Args:
        results: folder of results.
        question: which datasets, by which columns and of which input.
        figures: format of figures to be written beside the page.
    """
    store = Store(Path(results))
    answer = datasets.compare_results(store, question)
    return Written(answer, datasets_page.write_answer(store, answer, figures))


def compare_causes(
    results: str | Path, question: Question, figures: FigureFormat | None = None
) -> Written[Causes]:
    """Compare what causes contribute to the slip of datasets, as `slip compare --causes` does.

    Args:
        results: folder of results.
        question: which datasets, by which columns and of which input.
        figures: format of figures to be written beside the page.
    """
    store = Store(Path(results))
    causes = datasets.find_causes(store, question)
    return Written(causes, datasets_page.write_causes(store, causes, figures))


def read_fleet(results: str | Path) -> Fleet:
    """Parameters by vehicle, terrain and run, as `slip fleet show` prints them."""
    return datasets.fit_results(Store(Path(results)))


def write_fleet(results: str | Path) -> Written[Fleet]:
    """What `read_fleet` finds, written as `slip fleet fit` does."""
    fleet = read_fleet(results)
    return Written(fleet, datasets_page.write_fleet(Store(Path(results)), fleet))


def follow_trend(results: str | Path, by: str = "dataset") -> Written[Trend]:
    """Follow slip and parameters over dates, as `slip fleet trend` does.

    Args:
        results: folder of results.
        by: groups for slip: dataset, vehicle, terrain, or several with commas.
    """
    store = Store(Path(results))
    trend = datasets.follow_trend(store, split_names(by))
    return Written(trend, datasets_page.write_trend(store, trend))


def draw_map(
    results: str | Path,
    deployments: Path | None = None,
    *,
    fed: Literal["command", "measured"] | None = None,
    show: str = "slip",
    figures: FigureFormat | None = None,
) -> Written[DeploymentMap]:
    """Map the deployments of the literature and own datasets, as `slip fleet map` does.

    Args:
        results: folder of results; it may be missing.
        deployments: table of deployments (CSV) in place of the project's own.
        fed: input of the ideal model; None chooses.
        show: the measure that colours own datasets.
        figures: format of figures to be written beside the page.
    """
    store = Store(Path(results))
    drawn = datasets.draw_up_map(store, deployments, fed=fed, show=show)
    return Written(drawn, datasets_page.write_map(store, drawn, figures))


def split_names(text: str) -> tuple[str, ...]:
    """The names in a text with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
