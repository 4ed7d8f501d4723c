"""The whole run in a strip, over which the stretch is dragged that other figures draw large."""

import polars as pl

from pipeline.report import theme
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import INPUT_WORDS
from pipeline.report.scene import Scene
from pipeline.report.thinning import break_lines, thin_to_peaks
from pipeline.report.vega import Chart, encode_column, layer

_BINS = 600


def draw(scene: Scene) -> Drawing | None:
    """Slip modulus over the whole run, and the stretch that is shown; None where the run is short."""
    slip, span = scene.main_slip, scene.worst_span
    if slip is None or span is None:
        return None
    peaks = thin_to_peaks(slip.select("t", "piece", "modulus"), "modulus", bins=_BINS)
    x = parts.time_axis(scene)
    y = encode_column("modulus:Q", scale={"domain": [0.0, scene.modulus_cap], "nice": False}, axis=None)
    area = Chart.of_rows("navigator").mark("area", color=theme.CROSS, opacity=0.6, clip=True, order=False)
    window = Chart.of_rows(parts.SHOWN_SPAN).mark("rect", color=theme.MARK, opacity=0.35)
    chart = layer(area.encode(x=x, y=y), window.encode(x="t_start:Q", x2="t_end:Q")).properties(
        width=parts.WIDTH, height=44, usermeta={"brush": "zoom", "gutter": 4}
    )
    rows = {
        "navigator": break_lines(peaks, "modulus"),
        parts.SHOWN_SPAN: pl.DataFrame({"t_start": [span[0]], "t_end": [span[1]]}),
    }
    length = span[1] - span[0]
    note = f"Drawn large below: the {length:g} s with the most slip. Drag over the strip to draw others."
    words = (
        f"Slip modulus {INPUT_WORDS[scene.report.main_input]} over the whole run. It is highest between "
        f"{span[0]:.0f} s and {span[1]:.0f} s, which the figure below draws large; "
        "arrow keys move the stretch."
    )
    return Drawing(chart, rows, note, words)


FIGURE = Figure("The whole run", Section.WHERE, draw, order=29, width="full")
