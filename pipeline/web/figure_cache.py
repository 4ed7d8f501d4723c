"""The figures of a session, whole or only the rows that a change moves."""

from collections.abc import Collection, Mapping

import polars as pl

from pipeline.estimation.diagnosis import budget_as_json
from pipeline.job.work import find_residual_modulus
from pipeline.report import theme
from pipeline.report.figures import list_figures, over_ground
from pipeline.report.figures.figure import Figure
from pipeline.report.scene import RunReport, Scene, number_in
from pipeline.report.theme import build_spec, pack_rows, share_rows
from pipeline.store import Manifest
from pipeline.web.actions import Shown
from pipeline.web.first_view import MOTION, PATHS, StretchScene, rank_stretches
from pipeline.web.stored_runs import read_summary

TABS: Mapping[str, tuple[str, ...]] = {
    "first": (PATHS.id, MOTION.id),
    "where": ("trajectory", "command_space", "reach", "velocities"),
    "effects": ("ladder", "step_response", "signature"),
    "residual": ("residuals", "autocorrelation"),
    "budget": ("budget",),
}
"""Figures of every tab, in their order."""
BUDGET = "budget"
_COLOURED = {"trajectory": over_ground.format_map, "command_space": over_ground.format_cells}
_LEFT = "Colours: residual slip of the model."


class FigureCache:
    """The tables of one run, read once, and the figures of any model of it.

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
        """Specifications, rows, titles and words of the figures of a tab.

        Args:
            shown: the model.
            tab: one of `TABS`; empty for all of them.
            stretch: which stretch is drawn large, 0 the worst.
        """
        ids = _list_ids(tab)
        scene = self._scene(shown, stretch, with_budget=BUDGET in ids)
        there = {}
        for figure in _list_known():
            drawing = figure.draw(scene) if figure.id in ids else None
            if drawing is not None:
                there[figure.id] = (figure, drawing)
        ordered = [there[name] for name in ids if name in there]
        return {
            "figures": {figure.id: build_spec(drawing) for figure, drawing in ordered},
            "rows": share_rows(drawing for _, drawing in ordered),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
            "stretch": _show_stretch(shown, stretch),
            "tabs": TABS,
            "shown": [
                {
                    "id": figure.id,
                    "title": figure.title,
                    "width": figure.width,
                    "words": drawing.words,
                    "note": f"{_LEFT} {drawing.note}" if figure.id in _COLOURED else drawing.note,
                }
                for figure, drawing in ordered
            ],
        }

    def redraw(self, shown: Shown, stretch: int) -> dict[str, object]:
        """The rows and words that differ from model to model."""
        scene = self._scene(shown, stretch)
        rows: dict[str, pl.DataFrame] = {}
        for figure in _list_known():
            rows.update(figure.live(scene) if figure.live else {})
        if scene.track is not None:
            rows["track"] = scene.track.frame
        words = {name: format_words(scene) for name, format_words in _COLOURED.items()}
        return {"rows": pack_rows(rows), "where": shown.where, "words": words}

    def _scene(self, shown: Shown, stretch: int, *, with_budget: bool = False) -> StretchScene:
        """The run as figures need it, fed with what the model is fed with."""
        source = shown.view.input
        summary = {**self._summary, "input": source}
        if source not in self._caps:
            self._caps[source] = Scene(RunReport(summary, self._tables)).modulus_cap
        tables = {**self._tables, "slip": self._leave(shown)} if "slip" in self._tables else self._tables
        budget = [budget_as_json(one) for one in shown.apportion(self._length)] if with_budget else []
        report = RunReport(summary, tables, {"input": source, "budget": budget}, motion=shown.view)
        ranked = rank_stretches(shown.view)
        return StretchScene(report, self._caps[source], ranked[stretch % len(ranked)] if ranked else None)

    def _leave(self, shown: Shown) -> pl.DataFrame:
        """The table `slip` with the modulus of what a model leaves of it."""
        slip = self._tables["slip"]
        if not shown.view.effects:
            return slip
        followed = pl.col("input").cast(pl.String) == shown.view.input
        part, rest = slip.filter(followed), slip.filter(~followed)
        remaining = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
        column = pl.Series("modulus", remaining).fill_nan(None)
        return pl.concat([part.with_columns(column).filter(pl.col("modulus").is_not_null()), rest])


def _list_known() -> tuple[Figure, ...]:
    return (PATHS, MOTION, *list_figures())


def _list_ids(tab: str) -> Collection[str]:
    if tab:
        return TABS.get(tab, ())
    return tuple(name for names in TABS.values() for name in names)


def _show_stretch(shown: Shown, stretch: int) -> dict[str, object] | None:
    """Which stretch is drawn large, of how many."""
    ranked = rank_stretches(shown.view)
    if not ranked:
        return None
    index = stretch % len(ranked)
    return {"place": index, "count": len(ranked), "from": ranked[index][0], "to": ranked[index][1]}
