"""What the body does after a step of the command: the median over all steps, scaled to the step's height."""

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer, stack

_CHANNELS = {"x": ("forward velocity", 0.15), "w": ("yaw rate", 0.15)}
_BEFORE_S, _AFTER_S, _RATE_HZ = 0.5, 3.0, 20.0
_FEWEST = 2
_WORDS = {"command": "command", "velocity": "measured", "model": "model"}


def draw(scene: Scene) -> Drawing | None:
    """A panel each for speed and yaw rate; None where too few steps are held for long enough."""
    rows = list_responses(scene)
    panels = [
        _draw_panel(component, list(rows[f"response_{component}"]["series"].unique(maintain_order=True)))
        for component in _CHANNELS
        if f"response_{component}" in rows
    ]
    if not panels:
        return None
    chart = stack(*panels).properties(usermeta={"gutter": parts.GUTTER})
    note = "Median over steps of the command that are held for three seconds; 1 is what was asked."
    return Drawing(chart, rows, note, _describe(rows))


def list_responses(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``t value series`` of each channel that has steps; empty where there are none."""
    slip = scene.slip.get("command")
    if slip is None:
        return {}
    motion = scene.report.motion
    found = {}
    for component, (_, smallest) in _CHANNELS.items():
        t, asked = slip["t"].to_numpy(), slip[f"f_{component}"].to_numpy()
        starts, low, high = find_steps(t, asked, smallest=smallest)
        if starts.size < _FEWEST:
            continue
        lines = {"command": (t, asked), "velocity": (t, slip[f"v_{component}"].to_numpy())}
        if motion is not None and motion.input == "command":
            lines["model"] = (motion.velocity["t"].to_numpy(), motion.velocity[f"v_{component}"].to_numpy())
        since = np.arange(-_BEFORE_S, _AFTER_S, 1.0 / _RATE_HZ)
        frames = []
        for series, (times, values) in lines.items():
            at = np.interp((starts[:, None] + since).ravel(), times, values).reshape(starts.size, -1)
            middle = np.median((at - low[:, None]) / (high - low)[:, None], axis=0)
            frames.append(pl.DataFrame({"t": since, "value": middle}).with_columns(series=pl.lit(series)))
        found[f"response_{component}"] = pl.concat(frames)
    return found


def find_steps(t: Floats, asked: Floats, *, smallest: float) -> tuple[Floats, Floats, Floats]:
    """Steps of a held command.

    Args:
        t: times [s], increasing.
        asked: the command's ideal velocity.
        smallest: height of a step that counts.

    Returns:
        Times of the steps [s], and the values before and after them, each of shape (k,); before and after a
        step the command stands still long enough.
    """
    jumps = np.flatnonzero(np.abs(np.diff(asked)) > smallest)
    starts, low, high = [], [], []
    for jump in jumps.tolist():
        begin, end = np.searchsorted(t, (t[jump] - _BEFORE_S, t[jump + 1] + _AFTER_S - 0.1))
        whole = t[jump + 1] + _AFTER_S - 0.1 <= t[-1] and t[jump] - _BEFORE_S >= t[0]
        joined = whole and float(np.diff(t[begin:end]).max(initial=0.0)) < 3.0 / _RATE_HZ
        before, after = asked[begin : jump + 1], asked[jump + 1 : end]
        still = joined and np.ptp(before) < 0.1 * smallest and np.ptp(after) < 0.1 * smallest
        if still:
            starts.append(float(t[jump + 1]))
            low.append(float(before[-1]))
            high.append(float(after[0]))
    return np.array(starts), np.array(low), np.array(high)


def _draw_panel(component: str, series: list[str]) -> Chart:
    last = component == list(_CHANNELS)[-1]
    look = {"title": "time since the step [s]" if last else None, "labels": last, "grid": False}
    x = encode_column("t:Q", scale={"domain": [-_BEFORE_S, _AFTER_S], "nice": False}, axis=look)
    y = make_axis("value", None, (-0.25, 1.4), values=[0, 0.5, 1], minExtent=parts.GUTTER - 10)
    line = Chart.of_rows(f"response_{component}").mark("line", clip=True, strokeWidth=2)
    drawn = line.encode(x=x, y=y, color=parts.series_colour(series, _WORDS))
    title = {"text": f"{_CHANNELS[component][0]}, share of the step [1]"}
    return layer(drawn).properties(width=480, height=96, title=title)


def _describe(responses: dict[str, pl.DataFrame]) -> str:
    """When the measured response reaches 63 % of the step."""
    told = []
    for name, rows in responses.items():
        line = rows.filter(pl.col("series") == "velocity")
        reached = line.filter((pl.col("value") >= 0.632) & (pl.col("t") > 0.0))["t"]  # noqa: PLR2004 - 1 - 1/e
        when = f"63 % after {reached[0]:.2f} s" if reached.len() else "never 63 %"
        ends = float(line["value"].tail(10).median() or 0.0)  # type: ignore[arg-type]
        told.append(f"{_CHANNELS[name[-1]][0]}: {when}, {ends:.0%} in the end")
    return "Median response to a step of the command. " + "; ".join(told) + "."


FIGURE = Figure("After a step of the command", Section.WHY, draw, order=3, live=list_responses)
