"""How far two-second predictions end from where the vehicle was, over time: the ideal model and the model."""

import polars as pl

from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scales import find_range, usual_ends
from pipeline.report.scene import LINE_BINS, Scene
from pipeline.report.thinning import break_lines, thin_series


def draw(scene: Scene) -> Drawing | None:
    """Two lines over time; None without a model."""
    motion = scene.report.motion
    if motion is None or motion.reach.is_empty():
        return None
    rows = list_reach(scene)
    ends = usual_ends(motion.reach["ideal"], exact=False)
    shown = find_range(rows["reach"], (ends[0], ends[1]))
    colour = parts.before_and_after(motion.input)
    chart = parts.draw_lines(scene, ["reach"], shown, colour).properties(
        height=130,
        title=parts.title_panel("error of a 2 s prediction", "m", shown),
        usermeta=parts.brush_over_time(),
    )
    row = motion.reach.row(motion.reach["model"].arg_max() or 0, named=True)
    medians = [float(motion.reach[name].median() or 0.0) for name in ("ideal", "model")]  # type: ignore[arg-type]
    words = (
        f"Error of two-second predictions over time: median {medians[0]:.3f} m for the ideal model, "
        f"{medians[1]:.3f} m for the model, which is worst, {row['model']:.2f} m, at {row['t']:.0f} s."
    )
    return Drawing(chart, rows | parts.span_rows(scene), words=words)


def list_reach(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``t value series``, thinned to peaks; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    lines = []
    for name in ("ideal", "model"):
        line = motion.reach.select("t", "piece", value=pl.col(name))
        thinned = thin_series(line, "value", bins=LINE_BINS)
        lines.append(break_lines(thinned, "value").with_columns(series=pl.lit(name)))
    return {"reach": pl.concat(lines)}


FIGURE = Figure("Predictions over two seconds", Section.WHY, draw, order=6, width="full", live=list_reach)
