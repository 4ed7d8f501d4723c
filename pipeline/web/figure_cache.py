"""The figures of the report, for one session: whole, or only the rows that a change of a value moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.analysis.diagnosis import DIAGNOSIS
from pipeline.report import RunReport, theme
from pipeline.report.figures import list_figures
from pipeline.report.figures.autocorrelation import list_autocorrelations
from pipeline.report.figures.ladder import list_rungs
from pipeline.report.figures.reach import list_reach
from pipeline.report.figures.residuals import list_residuals
from pipeline.report.figures.signature import list_signatures
from pipeline.report.figures.step_response import list_responses
from pipeline.report.figures.trajectory import list_arcs
from pipeline.report.figures.velocities import model_rows
from pipeline.report.scene import Scene
from pipeline.report.sections.where import VERBS, find_regions
from pipeline.report.specs import build_spec, pack_rows, share_rows
from pipeline.web.runs import read_summary

if TYPE_CHECKING:
    from pipeline.report.motion_view import MotionView
    from pipeline.store import Manifest

FIGURES = (
    "ladder",
    "budget",
    "trajectory",
    "residuals",
    "signature",
    "reach",
    "velocities",
    "autocorrelation",
    "step_response",
    "command_space",
)
_LIVE = (
    list_rungs,
    list_arcs,
    list_reach,
    list_residuals,
    list_autocorrelations,
    list_responses,
    model_rows,
    list_signatures,
)


class FigureCache:
    """The tables of one run, read once, and the figures of any model of it.

    Args:
        manifest: the run.
    """

    def __init__(self, manifest: Manifest) -> None:
        wanted = ("velocities", "slip", "windows", "aggregates")
        self._tables = {name: manifest.read(name) for name in wanted if name in manifest.tables}
        self._summary = read_summary(manifest)
        told = manifest.read_json(DIAGNOSIS) if DIAGNOSIS in manifest.files else {}
        self._diagnosis: dict[str, object] = {key: told[key] for key in ("input", "budget") if key in told}

    def draw(self, view: MotionView) -> dict[str, object]:
        """Specifications, rows, titles and words of all figures."""
        scene = self._scene(view)
        drawn = [(figure, figure.draw(scene)) for figure in list_figures() if figure.id in FIGURES]
        there = {figure.id: (figure, drawing) for figure, drawing in drawn if drawing is not None}
        ordered = [there[name] for name in FIGURES if name in there]
        return {
            "figures": {figure.id: build_spec(drawing) for figure, drawing in ordered},
            "rows": share_rows(drawing for _, drawing in ordered),
            "dark": dict(theme.DARK_TWINS),
            "where": self._where(scene),
            "shown": [
                {
                    "id": figure.id,
                    "title": figure.title,
                    "width": figure.width.value,
                    "words": figure.describe(scene),
                    "note": drawing.note,
                }
                for figure, drawing in ordered
            ],
        }

    def redraw(self, view: MotionView) -> dict[str, object]:
        """The rows that differ from model to model."""
        scene = self._scene(view)
        rows = {}
        for gather in _LIVE:
            rows.update(gather(scene))
        return {"rows": pack_rows(rows)}

    @staticmethod
    def _where(scene: Scene) -> list[dict[str, object]]:
        """The regions of driving that carry more slip than their share of the time."""
        name = scene.report.main_input
        found = find_regions(scene.sound_slip.get(name), VERBS[name])
        return [{"words": words, "slip": slip, "time": time} for words, slip, time in found]

    def _scene(self, view: MotionView) -> Scene:
        return Scene(RunReport(self._summary, self._tables, self._diagnosis, motion=view))
