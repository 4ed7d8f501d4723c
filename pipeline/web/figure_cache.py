"""The figures of the report, for one session: whole, or only the rows that a change of the model moves."""

from dataclasses import dataclass
from functools import cached_property

import polars as pl

from pipeline.analysis.diagnosis import DIAGNOSIS
from pipeline.analysis.relative import find_residual_modulus
from pipeline.report import theme
from pipeline.report.figures import command_space, list_figures, trajectory
from pipeline.report.run import RunReport, number_in
from pipeline.report.scene import Scene
from pipeline.report.specs import build_spec, pack_rows, share_rows
from pipeline.store import Manifest
from pipeline.web.run_cache import Shown
from pipeline.web.runs import read_summary

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
_COLOURED = {"trajectory": trajectory.describe, "command_space": command_space.describe}
_LEFT = "Colours: what the model leaves of the slip."


@dataclass(frozen=True)
class _ModelScene(Scene):
    """A run's tables with the slip that a model leaves, on the scale of the ideal model's.

    Attributes:
        ideal_cap: where the colour ramp ends [m/s], the same for every model.
    """

    ideal_cap: float

    @cached_property
    def modulus_cap(self) -> float:
        return self.ideal_cap


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
        self._length = number_in(self._summary, "length_scale_m") or 1.0
        self._caps: dict[str, float] = {}

    def draw(self, shown: Shown) -> dict[str, object]:
        """Specifications, rows, titles and words of all figures."""
        scene = self._scene(shown)
        drawn = [(figure, figure.draw(scene)) for figure in list_figures() if figure.id in FIGURES]
        there = {figure.id: (figure, drawing) for figure, drawing in drawn if drawing is not None}
        ordered = [there[name] for name in FIGURES if name in there]
        return {
            "figures": {figure.id: build_spec(drawing) for figure, drawing in ordered},
            "rows": share_rows(drawing for _, drawing in ordered),
            "dark": dict(theme.DARK_TWINS),
            "where": shown.where,
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

    def redraw(self, shown: Shown) -> dict[str, object]:
        """The rows and words that differ from model to model."""
        scene = self._scene(shown)
        rows: dict[str, pl.DataFrame] = {}
        for figure in list_figures():
            rows.update(figure.live(scene) if figure.live else {})
        if scene.track is not None:
            rows["track"] = scene.track.frame
        words = {name: describe(scene) for name, describe in _COLOURED.items()}
        return {"rows": pack_rows(rows), "where": shown.where, "words": words}

    def _scene(self, shown: Shown) -> Scene:
        """The run as figures need it, fed with what the model is fed with."""
        source = shown.view.input
        summary = {**self._summary, "input": source}
        if source not in self._caps:
            self._caps[source] = Scene(RunReport(summary, self._tables)).modulus_cap
        tables = {**self._tables, "slip": self._leave(shown)} if "slip" in self._tables else self._tables
        report = RunReport(summary, tables, self._diagnosis, motion=shown.view)
        return _ModelScene(report, self._caps[source])

    def _leave(self, shown: Shown) -> pl.DataFrame:
        """The table `slip` with the modulus of what a model leaves of it."""
        slip = self._tables["slip"]
        if not shown.view.effects:
            return slip
        followed = pl.col("input").cast(pl.String) == shown.view.input
        part, rest = slip.filter(followed), slip.filter(~followed)
        left = find_residual_modulus(shown.predict(part["t"].to_numpy()), part, length=self._length)
        kept = pl.Series("modulus", left).fill_nan(None)
        return pl.concat([part.with_columns(kept).filter(pl.col("modulus").is_not_null()), rest])
