"""Slip modulus over time, on the command and on the measured wheels."""

from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import INPUT_WORDS
from pipeline.report.scales import find_range
from pipeline.report.scene import Scene
from pipeline.report.words import say_number


def draw(scene: Scene) -> Drawing | None:
    """One line an input; gaps are left open, stretches after a change of command shaded."""
    lines = scene.modulus_lines
    if lines is None:
        return None
    shown = find_range(lines.frame, lines.usual)
    colour = parts.series_colour(list(scene.slip), INPUT_WORDS)
    chart = parts.draw_lines(scene, ["modulus"], shown, colour).properties(
        height=150,
        title=parts.title_panel("slip modulus", "m/s", shown),
        usermeta=parts.brush_over_time(),
    )
    note = parts.tell_thinning(lines, kept="first, last, lowest and highest of every bin")
    rows = {"modulus": lines.frame} | parts.span_rows(scene)
    return Drawing(chart, rows, f"{parts.tell_bands(scene)} {note}".strip(), _describe(scene))


def _describe(scene: Scene) -> str:
    """Median, highest value and its time for each input."""
    told = []
    for name, frame in scene.sound_slip.items():
        row = frame.row(frame["modulus"].arg_max() or 0, named=True)
        told.append(
            f"{INPUT_WORDS[name]} its median is {say_number(scene.median_modulus(name))} m/s "
            f"and it is highest, {row['modulus']:.2f} m/s, at {row['t']:.0f} s"
        )
    return "Slip modulus over time: " + "; ".join(told) + "."


FIGURE = Figure("Slip over time", Section.HOW_BAD, draw, order=10, width="full")
