"""Figures of a session and of a stretch of its run, complete or only the rows that a change affects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import polars as pl

from pipeline.core import number_in, read_object
from pipeline.report import theme
from pipeline.report.figures import draw_figure, slip_figures
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections import list_figures
from pipeline.report.theme import build_spec, pack_rows, share_rows
from pipeline.results import RunDiagnosis
from pipeline.stages import find_residual_modulus

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from pipeline.core import Floats
    from pipeline.report.motion_view import MotionView
    from pipeline.results import SlipBudget
    from pipeline.store import Manifest

TABS: Mapping[str, tuple[str, ...]] = {
    "first": ("paths", "stretch"),
    "where": ("trajectory", "command_space", "reach", "velocities"),
    "effects": ("ladder", "step_response", "signature"),
    "residual": ("residuals",),
    "budget": ("budget",),
}
"""Figures of every tab, in order."""
_COLOURED = {"trajectory": slip_figures.format_map, "command_space": slip_figures.format_cells}
_LEFT = "Colours: residual slip of the model."


@dataclass(frozen=True)
class Shown:
    """A model on a run, as it is shown.

    Attributes:
        view: rows to draw.
        where: regions with most of its error, as text of `slip diagnose`.
        largest: span with the largest part of its squared error over 2 s [s]; None without predictions.
        predict: function for its body velocities at times of aligned poses [s], shape (n, 3).
        apportion: function for its budgets by cause, given the length scale of the slip modulus [m].
    """

    view: MotionView
    where: list[str]
    largest: tuple[float, float] | None
    predict: Callable[[Floats], Floats]
    apportion: Callable[[float], Sequence[SlipBudget]]


class Figures:
    """Figures of models of one run, whose tables are read once.

    Args:
        manifest: the run.
        source: input of the models.
    """

    def __init__(self, manifest: Manifest, source: str) -> None:
        wanted = ("velocities", "slip", "windows", "aggregates")
        self._tables = {name: manifest.read(name) for name in wanted if name in manifest.tables}
        self._summary = {**read_object(manifest.path("summary.json")), "input": source}
        self._length = number_in(self._summary, "length_scale_m") or 1.0
        self._cap = Scene(RunReport(self._summary, self._tables)).modulus_cap

    def draw(self, shown: Shown, tab: str, stretch: int) -> dict[str, object]:
        """Specifications, rows, titles and texts of the figures of a tab.

        Args:
            shown: the model.
            tab: one of `TABS`; empty for all of them.
            stretch: index of the enlarged stretch, 0 for the one with the largest error.
        """
        ids = [name for key, names in TABS.items() if tab in ("", key) for name in names]
        scene = self._scene(shown, stretch, with_budget="budget" in ids)
        known = {figure.id: figure for figure in list_figures()}
        pictures = [(name, one) for name in ids for one in draw_figure(known[name], scene)]
        at, spans = scene.stretch, scene.stretches if scene.stretch else ()
        return {
            "figures": {one.id: build_spec(one.drawing) for _, one in pictures},
            "rows": share_rows(one.drawing for _, one in pictures),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
            "largest": shown.largest,
            "stretch": at
            and {"place": scene.stretch_number % len(spans), "spans": spans, "from": at[0], "to": at[1]},
            "shown": [
                {
                    "id": one.id,
                    "title": one.title,
                    "width": one.width,
                    "words": one.drawing.words,
                    "note": f"{_LEFT} {one.drawing.note}" if name in _COLOURED else one.drawing.note,
                }
                for name, one in pictures
            ],
        }

    def redraw(self, shown: Shown, stretch: int) -> dict[str, object]:
        """The rows and texts that depend on the model."""
        scene = self._scene(shown, stretch)
        rows: dict[str, pl.DataFrame] = {}
        for known in list_figures():
            rows.update(known.live(scene) if known.live else {})
        if scene.track is not None:
            rows["track"] = scene.track.frame
        words = {name: format_words(scene) for name, format_words in _COLOURED.items()}
        return {"rows": pack_rows(rows), "where": shown.where, "largest": shown.largest, "words": words}

    def _scene(self, shown: Shown, stretch: int, *, with_budget: bool = False) -> Scene:
        """Data of the figures of the run; the table `slip` has the modulus of the model's residual."""
        tables, source = dict(self._tables), shown.view.input
        if "slip" in tables and shown.view.effects:
            followed = pl.col("input").cast(pl.String) == source
            part, rest = tables["slip"].filter(followed), tables["slip"].filter(~followed)
            modulus = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
            part = part.with_columns(pl.Series("modulus", modulus).fill_nan(None))
            tables["slip"] = pl.concat([part.filter(pl.col("modulus").is_not_null()), rest])
        budget = tuple(shown.apportion(self._length)) if with_budget else ()
        diagnosis = RunDiagnosis(input=source, budget=budget)
        report = RunReport(self._summary, tables, diagnosis, motion=shown.view)
        return Scene(report, stretch, self._cap)
