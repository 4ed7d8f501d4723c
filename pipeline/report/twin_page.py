"""The page of a replay: measured motion, ideal model, kinematic model and twin over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import polars as pl

from pipeline.report import theme
from pipeline.report.figures import Drawing
from pipeline.report.page import render_figures
from pipeline.report.scene import break_lines
from pipeline.report.templating import Picture
from pipeline.report.theme import Chart, encode_column, layer, make_axis, stack

if TYPE_CHECKING:
    from pipeline.report.theme import Channel

_COLOURS = {
    "measured": theme.MEASURED,
    "ideal": theme.INPUT_COLOURS["command"],
    "model": theme.MODEL,
    "twin": theme.GROUND,
}
_DASHES = {"measured": [1, 0], "ideal": [1, 0], "model": [1, 0], "twin": [6, 5]}
"""The twin is dashed, so that the model is seen below it where they agree."""
_WIDTHS = {"measured": 5.0, "ideal": 1.6, "model": 3.0, "twin": 1.6}
_SHOWN_S = 40.0
"""How much of the path is shown closely [s]: predictions of 2 s are as long as a finger there."""


def render_twin(
    content: Mapping[str, object], lines: Sequence[str], paths: pl.DataFrame, horizon_errors: pl.DataFrame
) -> str:
    """The whole page as HTML.

    Args:
        content: the JSON object of the replay.
        lines: what the terminal says.
        paths: rows ``t piece x y series``.
        horizon_errors: rows ``t value series``.
    """
    return render_figures(
        "report/templates/twin.html",
        [draw_twin_path(paths, horizon_errors), draw_twin_errors(horizon_errors)],
        title="Twin beside the robot",
        facts=[str(content["run"]), str(content["vehicle"])],
        lines=lines,
    )


def draw_twin_path(paths: pl.DataFrame, horizon_errors: pl.DataFrame) -> Picture:
    """The measured path where the ideal model errs most, and predictions over 2 s that begin on it."""
    worst = horizon_errors.filter(pl.col("series") == "ideal").sort("value")["t"]
    middle = float(worst[-1]) if worst.len() else 0.0
    shown = paths.filter((pl.col("t") - middle).abs() <= 0.5 * _SHOWN_S)
    rows = {
        f"twin_{series}": break_lines(shown.filter(pl.col("series") == series), "x", "y")
        for series in _COLOURS
    }
    x, y = (make_axis(name, f"{name} [m]", scale={"zero": False}) for name in ("x", "y"))
    lines = [
        Chart.of_rows(name).mark("line", order=False, **_look(name)).encode(x=x, y=y, color=_colour())
        for name in rows
    ]
    low, high = ([float(edge(shown[name])) for name in ("x", "y")] for edge in (_lowest, _highest))
    meta = {"equal": {"x": [low[0], high[0]], "y": [low[1], high[1]], "lowest": 240, "highest": 640}}
    chart = layer(*lines).properties(width=640, height=480, usermeta=meta)
    note = f"{_SHOWN_S:g} s about the moment at which the ideal model errs most; the twin is dashed."
    words = (
        "The measured path, and where ideal model, kinematic model and twin go in 2 s from measured poses."
    )
    return Picture("twin-path", "Path", Drawing(chart, rows, note, words))


def draw_twin_errors(horizon_errors: pl.DataFrame) -> Picture:
    """The error of every prediction over time."""
    rows = {
        f"reach_{series}": horizon_errors.filter(pl.col("series") == series)
        for series in _COLOURS
        if series != "measured"
    }
    charts = [
        Chart.of_rows(name)
        .mark("line", **_look(name))
        .encode(x=make_axis("t", "time [s]"), y=make_axis("value", "error of 2 s [m]"), color=_colour())
        for name in rows
    ]
    chart = stack(layer(*charts).properties(width=640, height=180))
    medians = {name: float(frame["value"].median() or 0.0) for name, frame in rows.items()}  # type: ignore[arg-type]
    errors = ", ".join(f"{name.partition('_')[2]} {size:.3f} m" for name, size in medians.items())
    return Picture("twin-errors", "Errors", Drawing(chart, rows, "", f"Median error over 2 s: {errors}."))


def _colour() -> Channel:
    scale = {"domain": list(_COLOURS), "range": list(_COLOURS.values())}
    return encode_column("series:N", scale=scale, legend={"title": None, "orient": "top"})


def _look(name: str) -> dict[str, object]:
    series = name.partition("_")[2]
    return {"strokeDash": _DASHES[series], "strokeWidth": _WIDTHS[series]}


def _lowest(values: pl.Series) -> float:
    return float(values.min() or 0.0)  # type: ignore[arg-type]


def _highest(values: pl.Series) -> float:
    return float(values.max() or 0.0)  # type: ignore[arg-type]
