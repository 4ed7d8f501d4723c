"""Figures of the model: ladder of steps, and sufficiency of the log."""

from collections.abc import Iterator, Mapping, Sequence

import polars as pl

from pipeline.core.json_objects import mapping_in, number_in, numbers_in, objects_in
from pipeline.core.program import INPUT_WORDS
from pipeline.estimation.acceptance import LEAST_T
from pipeline.estimation.describe import format_rises
from pipeline.estimation.error_regions import format_angle, format_length
from pipeline.estimation.learning import INTERVAL_SHARE, find_goal
from pipeline.report import theme
from pipeline.report.figures import figure
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import Scene
from pipeline.report.templating import begin_large
from pipeline.report.theme import Channel, Chart, encode_column, layer, make_axis, stack

_SCHEMA = {"rung": pl.Int64, "step": pl.String, "t": pl.Float64, "told": pl.String, "series": pl.String}
_BOUND = {"t": pl.Float64, "told": pl.String, "label": pl.String, "right": pl.Boolean, "raised": pl.Boolean}
_BOUNDS = ("ceiling", "floor")
_ROOM = 1.04
_FAR = 0.6


def draw_ladder(scene: Scene) -> Drawing | None:
    """Draw one bar per step of the ladder, the longest on top, with ceiling and floor as dashed lines.

    The ceiling is the error of the ideal model, the floor the repeatability of the motion. Effects can
    explain the error between them; `explained_share` is relative to this difference.
    """
    rows = list_ladder_steps(scene)
    if rows["ladder"].is_empty():
        return None
    colour = theme.INPUT_COLOURS.get(name_input(scene), theme.QUIET)
    scale = {"domain": ["ideal", "model"], "range": [colour, theme.MODEL]}
    top = float(rows["ladder"]["t"].max() or 1.0)  # type: ignore[arg-type]
    title = "held-out error over 2 s [m]"
    x = make_axis("t", title, (0.0, top * _ROOM), tickCount=5, grid=False)
    base = figure.name_bars("ladder", "step")
    bars = base.bars.encode(x=x, color=encode_column("series:N", scale=scale, legend=None))
    # One line per bar, so that it crosses no text.
    bounds = [
        base.ticks.encode(x=f"{word}:Q", tooltip=[encode_column(f"{word}:Q", title=f"{word} [m]")])
        for word in _BOUNDS
    ]
    names = [_name_bound(f"ladder_{word}") for word in _BOUNDS]
    chart = layer(bars, *bounds, base.words, *names).properties(
        width=480, height={"step": figure.BAR_STEP}, usermeta={"gutter": 10}
    )
    note = "Ceiling: the error of the ideal model."
    if rows["ladder_floor"].height:
        note += " Noise floor: the repeatability of the motion. Effects can remove the error between the two."
    return Drawing(chart, rows, note, _format_ladder(scene, rows))


def _name_bound(name: str) -> Chart:
    """Label of a bound above all bars, at the position of its line."""
    mark = Chart.of_rows(name).mark(
        "text",
        align={"expr": "datum.right ? 'right' : 'left'"},
        dy={"expr": "datum.raised ? -22 : -8"},
        fontSize=11,
    )
    named: Chart = mark.encode(x="t:Q", y={"value": 0}, text="label:N")
    return named


def list_ladder_steps(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of the ladder: ``rung step t told series``; of ceiling and floor: ``t told label``."""
    rungs, floor = _find_ladder(scene)
    rows = []
    before: Sequence[object] = ()
    for number, step in enumerate(rungs):
        size = number_in(step, "t_mrmse_m")
        effects = step.get("effects")
        effects = effects if isinstance(effects, list | tuple) else []
        added = [str(name) for name in effects if name not in before]
        before = effects
        if size is None:
            continue
        rises = format_rises(rungs[max(number - 1, 0)], step)
        rows.append(
            {
                "rung": number,
                "step": "ideal" if number == 0 else f"+ {', '.join(added)}{rises and f' ({rises})'}",
                "t": size,
                "told": " \u00b7 ".join([format_length(size), *_list_degrees(step)]),
                "series": "model" if effects else "ideal",
            }
        )
    highest = number_in(rungs[0], "t_mrmse_m") if rungs else None
    bounds = {"ceiling": highest, "floor": number_in(floor, "t_mrmse_m")}
    columns = [pl.lit(size, pl.Float64).alias(word) for word, size in bounds.items()]
    most = max((float(str(row["t"])) for row in rows), default=0.0)
    return {
        "ladder": pl.DataFrame(rows, schema=_SCHEMA).with_columns(columns),
        **{f"ladder_{word}": _list_bound(word, size, most) for word, size in bounds.items()},
    }


def _list_degrees(step: Mapping[str, object]) -> list[str]:
    """Heading error, if known, in short form for the label above a bar."""
    angle = number_in(step, "r_mrmse_rad")
    return [] if angle is None else [f"{format_angle(angle).partition(' ')[0]}\u00b0"]


def _list_bound(word: str, size: float | None, most: float) -> pl.DataFrame:
    """Rows of a bound with its label, which ends at the line if there is no room behind it.

    If the floor's label would overlap the ceiling's, it is one row higher.
    """
    size_text, far = format_length(size or 0.0), size is not None and size > _FAR * most
    row = (size, size_text, f"{word} {size_text}", far, far and word == "floor")
    return pl.DataFrame([] if size is None else [row], schema=_BOUND, orient="row")


def name_input(scene: Scene) -> str:
    """Input of the ladder's models."""
    motion = scene.report.motion
    if motion is not None:
        return motion.input
    source = scene.report.diagnosis.get("input")
    return source if isinstance(source, str) else scene.report.main_input


def _find_ladder(scene: Scene) -> tuple[Sequence[Mapping[str, object]], Mapping[str, object]]:
    motion = scene.report.motion
    if motion is not None:
        return motion.ladder, motion.floor or {}
    return objects_in(scene.report.diagnosis, "ladder"), mapping_in(scene.report.diagnosis, "noise_floor")


def _format_ladder(scene: Scene, rows: Mapping[str, pl.DataFrame]) -> str:
    """Format every step with its errors."""
    sentence = "; ".join(f"{row['step']}: {row['told']}" for row in rows["ladder"].iter_rows(named=True))
    bounds = "".join(
        f" The {word} is {row['told']}."
        for word, name in (("ceiling, the ideal model,", "ladder_ceiling"), ("noise floor", "ladder_floor"))
        for row in rows[name].iter_rows(named=True)
    )
    words = INPUT_WORDS.get(name_input(scene), "")
    return f"Error of two-second predictions {words} on held-out data. {sentence}.{bounds}"


LADDER = Figure(
    "The ladder: error after each effect",
    Section.WHY,
    draw_ladder,
    order=0,
    live=list_ladder_steps,
    id="ladder",
)


_SCHEMA_ENOUGH = {"effect": pl.String, "number": pl.String, "seconds": pl.Float64, "value": pl.Float64}
_COLOURS = (
    theme.ON_COMMAND, theme.SLIP, theme.ON_MEASURED, theme.MODEL, theme.GROUND, theme.DRIVETRAIN, theme.CROSS,
)  # fmt: skip
# Above four colours, dashes distinguish the lines as well.
_DASHES = ([1, 0], [1, 0], [1, 0], [1, 0], [8, 3], [3, 3], [8, 3, 2, 3])
# Relative half-widths above this are not drawn: the interval is wider than the value itself.
_WIDEST = 1.0


def draw_enough(scene: Scene) -> Drawing | None:
    """Draw the relative half-width of every interval, and below it t of every effect."""
    rows = list_growth(scene)
    if rows["enough_width"].is_empty():
        return None
    names = pl.concat(list(rows.values()))["effect"].unique(maintain_order=True).to_list()
    colours = [_COLOURS[index % len(_COLOURS)] for index in range(len(names))]
    dashes = [_DASHES[index % len(_DASHES)] for index in range(len(names))]
    legend = {"title": None, "symbolType": "stroke", "symbolSize": 220, "orient": "top", "columns": 4}
    colour = encode_column("effect:N", scale={"domain": names, "range": colours}, legend=legend)
    dash = encode_column("effect:N", scale={"domain": names, "range": dashes}, legend=legend)
    end = float(pl.concat(list(rows.values()))["seconds"].max() or 1.0)  # type: ignore[arg-type]
    panels = [
        _draw_panel("enough_width", "relative half-width of the 95 % interval", colour, dash, end),
        _draw_panel("enough_evidence", "evidence for the effect [t]", colour, dash, end),
    ]
    bounds = {"enough_width_bound": INTERVAL_SHARE, "enough_evidence_bound": LEAST_T}
    shown = rows | {name: pl.DataFrame({"value": [value]}) for name, value in bounds.items()}
    sentence = str(scene.report.diagnosis.get("enough") or "")
    note = f"{begin_large(sentence)}. " if sentence else ""
    note += "Lines: 5 %, and the detection threshold in t."
    words = f"Data: {sentence}." if sentence else "No effect has an interval that narrows with driving."
    return Drawing(stack(*panels).properties(usermeta={"gutter": figure.GUTTER}), shown, note, words)


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
                axis={"title": None if wide else "driving used [s]", "grid": False},
            ),
            y=make_axis("value", None, scale=scale, minExtent=figure.GUTTER - 10, **ticks),
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
    return layer(line, bound).properties(width=figure.WIDTH, height=120, title=title)


def list_growth(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``effect number seconds value`` of relative half-widths, and of evidence."""
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
        "enough_width": pl.DataFrame(widths, schema=_SCHEMA_ENOUGH, orient="row"),
        "enough_evidence": pl.DataFrame(evidence, schema=_SCHEMA_ENOUGH, orient="row"),
    }


def _list_points(curve: Mapping[str, object], key: str) -> Iterator[tuple[float, float]]:
    for second, value in zip(numbers_in(curve, "seconds"), numbers_in(curve, key), strict=False):
        if second is not None and value is not None:
            yield second, value


ENOUGH = Figure("Is the log long enough", Section.WHY, draw_enough, order=6, width="full", id="enough")
