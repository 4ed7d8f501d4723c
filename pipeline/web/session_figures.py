"""Figures of a session and of a stretch of its run, complete or only the rows that a change affects."""

from collections.abc import Collection, Mapping

import polars as pl

from pipeline.core import number_in
from pipeline.report import theme
from pipeline.report.figures import draw_figure, slip_figures
from pipeline.report.scene import RunReport, Scene
from pipeline.report.sections import list_figures
from pipeline.report.theme import build_spec, pack_rows, share_rows
from pipeline.results import RunDiagnosis
from pipeline.stages import find_residual_modulus
from pipeline.store import Manifest
from pipeline.web import WorkbenchError
from pipeline.web.actions import Shown
from pipeline.web.stored_runs import read_summary

TABS: Mapping[str, tuple[str, ...]] = {
    "first": ("paths", "stretch"),
    "where": ("trajectory", "command_space", "reach", "velocities"),
    "effects": ("ladder", "step_response", "signature"),
    "residual": ("residuals",),
    "budget": ("budget",),
}
"""Figures of every tab, in order."""
BUDGET = "budget"
_COLOURED = {"trajectory": slip_figures.format_map, "command_space": slip_figures.format_cells}
_LEFT = "Colours: residual slip of the model."


class FigureCache:
    """Figures of models of one run, whose tables are read once.

    Args:
        manifest: the run.
    """

    def __init__(self, manifest: Manifest) -> None:
        wanted = ("velocities", "slip", "windows", "aggregates")
        self._tables = {name: manifest.read(name) for name in wanted if name in manifest.tables}
        self._summary = read_summary(manifest)
        self._length = number_in(self._summary, "length_scale_m") or 1.0
        self._caps: dict[str, float] = {}

    def draw(self, shown: Shown, tab: str, stretch: int) -> dict[str, object]:
        """Specifications, rows, titles and texts of the figures of a tab.

        Args:
            shown: the model.
            tab: one of `TABS`; empty for all of them.
            stretch: index of the enlarged stretch, 0 for the one with the largest error.

        Raises:
            WorkbenchError: ``bad_request``, there is no such tab.
        """
        ids = _list_ids(tab)
        scene = self._scene(shown, stretch, with_budget=BUDGET in ids)
        known = {figure.id: figure for figure in list_figures()}
        pictures = [(name, one) for name in ids for one in draw_figure(known[name], scene)]
        return {
            "figures": {one.id: build_spec(one.drawing) for _, one in pictures},
            "rows": share_rows(one.drawing for _, one in pictures),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
            "largest": shown.largest,
            "stretch": _show_stretch(scene),
            "tabs": TABS,
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
        summary = {"where": shown.where, "largest": shown.largest, "words": words}
        return {"rows": pack_rows(rows), **summary}

    def _scene(self, shown: Shown, stretch: int, *, with_budget: bool = False) -> Scene:
        """Data of the figures of the run, with the input of the model."""
        source = shown.view.input
        summary = {**self._summary, "input": source}
        if source not in self._caps:
            self._caps[source] = Scene(RunReport(summary, self._tables)).modulus_cap
        tables = {**self._tables, "slip": self._leave(shown)} if "slip" in self._tables else self._tables
        budget = tuple(shown.apportion(self._length)) if with_budget else ()
        report = RunReport(summary, tables, RunDiagnosis(input=source, budget=budget), motion=shown.view)
        return Scene(report, stretch, self._caps[source])

    def _leave(self, shown: Shown) -> pl.DataFrame:
        """The table `slip` with the modulus of the model's residual."""
        slip = self._tables["slip"]
        if not shown.view.effects:
            return slip
        followed = pl.col("input").cast(pl.String) == shown.view.input
        part, rest = slip.filter(followed), slip.filter(~followed)
        remaining = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
        column = pl.Series("modulus", remaining).fill_nan(None)
        return pl.concat([part.with_columns(column).filter(pl.col("modulus").is_not_null()), rest])


def _list_ids(tab: str) -> Collection[str]:
    if tab and tab not in TABS:
        raise WorkbenchError("bad_request", f"there is no tab {tab!r}", hint=f"Tabs are {', '.join(TABS)}.")
    if tab:
        return TABS[tab]
    return tuple(name for names in TABS.values() for name in names)


def _show_stretch(scene: Scene) -> dict[str, object] | None:
    """Index and times of the enlarged stretch, and the times of all stretches."""
    if scene.stretch is None:
        return None
    spans = scene.stretches
    start, end = scene.stretch
    return {"place": scene.stretch_number % len(spans), "spans": spans, "from": start, "to": end}
