"""Is the log long enough: how narrow the intervals are, and how sure the names, by seconds of driving."""

from collections.abc import Iterator, Mapping

import polars as pl

from pipeline.estimation.acceptance import LEAST_T
from pipeline.identification.growth import INTERVAL_SHARE, find_goal
from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import mapping_in, number_in, numbers_in, objects_in
from pipeline.report.scene import Scene
from pipeline.report.vega import Channel, Chart, encode_column, layer, stack
from pipeline.report.words import begin_large

_SCHEMA = {"effect": pl.String, "number": pl.String, "seconds": pl.Float64, "value": pl.Float64}
_COLOURS = (
    theme.ON_COMMAND, theme.SLIP, theme.ON_MEASURED, theme.MODEL, theme.GROUND, theme.DRIVETRAIN, theme.CROSS,
)  # fmt: skip
# Beyond the fourth, colours are told apart by their dashes as well.
_DASHES = ([1, 0], [1, 0], [1, 0], [1, 0], [8, 3], [3, 3], [8, 3, 2, 3])
# Half of an interval is not drawn where it is wider than the number itself.
_WIDEST = 1.0


def draw(scene: Scene) -> Drawing | None:
    """Half-width of every interval as a share of its number, and below it t of every name."""
    rows = list_growth(scene)
    if rows["enough_width"].is_empty():
        return None
    names = pl.concat(list(rows.values()))["effect"].unique(maintain_order=True).to_list()
    colours = [_COLOURS[place % len(_COLOURS)] for place in range(len(names))]
    dashes = [_DASHES[place % len(_DASHES)] for place in range(len(names))]
    legend = {"title": None, "symbolType": "stroke", "symbolSize": 220, "orient": "top", "columns": 4}
    colour = encode_column("effect:N", scale={"domain": names, "range": colours}, legend=legend)
    dash = encode_column("effect:N", scale={"domain": names, "range": dashes}, legend=legend)
    end = float(pl.concat(list(rows.values()))["seconds"].max() or 1.0)  # type: ignore[arg-type]
    panels = [
        _draw_panel("enough_width", "half of the 95 % interval, of the number", colour, dash, end),
        _draw_panel("enough_evidence", "evidence for the name [t]", colour, dash, end),
    ]
    bounds = {"enough_width_bound": INTERVAL_SHARE, "enough_evidence_bound": LEAST_T}
    shown = rows | {name: pl.DataFrame({"value": [value]}) for name, value in bounds.items()}
    told = str(scene.report.diagnosis.get("enough") or "")
    note = f"{begin_large(told)}. " if told else ""
    note += "Level: 5 %, and the t from which a name is given."
    words = f"Is the log long enough: {told}." if told else "Nothing was named that grows with driving."
    return Drawing(stack(*panels).properties(usermeta={"gutter": parts.GUTTER}), shown, note, words)


def _draw_panel(name: str, title: str, colour: Channel, dash: Channel, end: float) -> Chart:
    wide = name == "enough_width"
    scale = {"type": "log", "domain": [0.002, _WIDEST]} if wide else {"zero": True}
    ticks = {"values": [0.01, INTERVAL_SHARE, 0.2, 1.0], "format": "~%"} if wide else {"tickCount": 4}
    line = (
        Chart.of_rows(name)
        .mark("line", clip=True)
        .encode(
            x=encode_column(
                "seconds:Q",
                scale={"domain": [0.0, end], "nice": False},
                axis={"title": None if wide else "seconds of driving that were used", "grid": False},
            ),
            y=make_axis("value", None, scale=scale, minExtent=parts.GUTTER - 10, **ticks),
            color=colour,
            strokeDash=dash,
            detail="number:N",
            tooltip=[
                "number:N",
                encode_column("seconds:Q", format=".0f"),
                encode_column("value:Q", format=".3"),
            ],
        )
    )
    bound = Chart.of_rows(f"{name}_bound").mark("rule", color=theme.INK, strokeDash=[4, 3])
    bound = bound.encode(y="value:Q")
    return layer(line, bound).properties(width=parts.WIDTH, height=120, title=title)


def list_growth(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``effect number seconds value`` of widths, as shares of their numbers, and of evidence."""
    widths: list[tuple[str, str, float, float]] = []
    evidence: list[tuple[str, str, float, float]] = []
    for effect in objects_in(scene.report.diagnosis, "effects"):
        name, growth = str(effect.get("id")), mapping_in(effect, "growth")
        curves, values = mapping_in(growth, "parameters"), mapping_in(effect, "parameters")
        for key in curves:
            value = number_in(mapping_in(values, key), "value")
            points = _list_points(mapping_in(curves, key), "half_width")
            if value is not None:
                goal = find_goal(name, key, value) / INTERVAL_SHARE
                widths += [(name, f"{name}.{key}", second, half / goal) for second, half in points]
        points = _list_points(mapping_in(growth, "evidence"), "t")
        evidence += [(name, name, second, t) for second, t in points]
    return {
        "enough_width": pl.DataFrame(widths, schema=_SCHEMA, orient="row"),
        "enough_evidence": pl.DataFrame(evidence, schema=_SCHEMA, orient="row"),
    }


def _list_points(curve: Mapping[str, object], key: str) -> Iterator[tuple[float, float]]:
    for second, value in zip(numbers_in(curve, "seconds"), numbers_in(curve, key), strict=False):
        if second is not None and value is not None:
            yield second, value


FIGURE = Figure("Is the log long enough", Section.WHY, draw, order=6, width="full")
