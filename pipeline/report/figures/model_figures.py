"""Figures of the model: velocities, ladder of steps, slip budget, drivetrain and ground, sufficiency."""

import math
from collections.abc import Sequence

import polars as pl

from pipeline.core import INPUT_WORDS, format_angle, format_length
from pipeline.estimation.driving_need import find_goal
from pipeline.models import name_term
from pipeline.report import begin_large, figures, format_known_share, format_number, format_split, theme
from pipeline.report.figures import Figure
from pipeline.report.scene import COMPONENTS, LINE_BINS, Scene, break_lines, drop_flat_rows, thin_series
from pipeline.report.theme import Chart, Drawing, encode_column, layer, make_axis, stack
from pipeline.results import INTERVAL_SHARE, Errors, Growth, Step
from pipeline.words import describe_need, format_rises

_QUANTITIES = {
    "x": ("forward velocity v_x", "m/s"),
    "y": ("lateral velocity v_y, left positive", "m/s"),
    "w": ("yaw rate v_w, left positive", "rad/s"),
}


def draw_velocities(scene: Scene) -> Drawing | None:
    """Draw three panels over one time axis: measured, ideal from commands, ideal from wheel encoders."""
    lines = {component: scene.component_lines(component) for component in COMPONENTS}
    there = {component: line for component, line in lines.items() if line is not None}
    if not there:
        return None
    model = model_rows(scene)
    series = [*scene.slip, "velocity", *(["model"] if model else [])]
    colour = figures.series_colour({name: figures.SERIES_WORDS[name] for name in series})
    panels = [
        figures.draw_lines(
            [f"velocity_{component}", *([f"model_{component}"] if model else [])],
            line.frame,
            line.usual,
            _QUANTITIES[component],
            colour,
            x=figures.time_axis(scene, has_title=component == COMPONENTS[-1]),
            height=118,
        )
        for component, line in there.items()
    ]
    rows = {f"velocity_{component}": line.frame for component, line in there.items()}
    # Initially the page shows only the worst stretch.
    window = {} if scene.worst_span is None else {"window": list(scene.worst_span)}
    words = (
        "Forward velocity, lateral velocity and yaw rate over time in three panels: measured"
        + "".join(f", {figures.SERIES_WORDS[name]}" for name in series if name != "velocity")
        + ". The distance between a line and the measured one is the slip in that direction."
    )
    return Drawing(
        stack(*panels).properties(usermeta=figures.brush_over_time() | window),
        rows | model | figures.span_rows(scene),
        figures.format_bands(scene, *there.values()),
        words,
    )


def model_rows(scene: Scene) -> dict[str, pl.DataFrame]:
    """The model's velocity by component, thinned: ``t value series``; empty without a model."""
    motion = scene.report.motion
    if motion is None:
        return {}
    rows = {}
    for component in COMPONENTS:
        line = motion.velocity.select("t", "piece", value=pl.col(f"v_{component}"))
        thinned = thin_series(drop_flat_rows(line, "value"), "value", bins=LINE_BINS, whole=scene.worst_span)
        rows[f"model_{component}"] = break_lines(thinned, "value").with_columns(series=pl.lit("model"))
    return rows


VELOCITIES = Figure(
    "velocities", "Velocities: measured against ideal", draw_velocities, width="full", live=model_rows
)

_SCHEMA = {"step": pl.String, "t": pl.Float64, "told": pl.String, "series": pl.String}
_ROOM = 1.04
_FAR = 0.6
"""Part of the axis beyond which a label ends at its line: behind it is no room."""


def draw_ladder(scene: Scene) -> Drawing | None:
    """Draw one bar per step of the ladder, the longest on top, and a line at the noise floor.

    Effects can explain the error between the ideal model and the floor, the repeatability of the motion;
    `explained_share` is relative to this difference.
    """
    rows, floor = list_ladder_steps(scene), _find_ladder(scene)[1]
    if rows["ladder"].is_empty():
        return None
    source = name_input(scene)
    colours = [theme.INPUT_COLOURS.get(source, theme.QUIET), theme.MODEL]
    scale = {"domain": ["ideal", "model"], "range": colours}
    top = float(rows["ladder"]["t"].max() or 1.0)  # type: ignore[arg-type]
    x = make_axis("t", "held-out error over 2 s [m]", (0.0, top * _ROOM), tickCount=5, grid=False)
    base, bars, words = figures.name_bars("ladder", "step")
    bars = bars.encode(x=x, color=encode_column("series:N", scale=scale, legend=None))
    numbers = "; ".join(f"{row['step']}: {row['told']}" for row in rows["ladder"].iter_rows(named=True))
    text = f"Error of two-second predictions {INPUT_WORDS.get(source, '')} on held-out data. {numbers}."
    charts, note = [bars, words], ""
    if floor is not None and math.isfinite(floor.t_mrmse_m):
        size = format_length(floor.t_mrmse_m)
        at, far = {"datum": floor.t_mrmse_m}, floor.t_mrmse_m > _FAR * top
        # One line per bar, so that it crosses no text.
        line = base.mark(
            "point", shape="stroke", angle=90, size=18**2, stroke=theme.INK, strokeWidth=1.5, opacity=1,
            yOffset=figures.BAR_BELOW,
        ).encode(x=at)  # fmt: skip
        label = Chart.of_rows("ladder_floor").mark(
            "text", align="right" if far else "left", dy=-8, fontSize=11, text=f"noise floor {size}"
        )
        charts = [bars, line, words, label.encode(x=at, y={"value": 0})]
        rows["ladder_floor"] = pl.DataFrame({"t": [floor.t_mrmse_m]})
        note = (
            "Noise floor: the repeatability of the motion. Effects can remove the error between it and that "
            "of the ideal model."
        )
        text += f" The noise floor is {size}."
    chart = layer(*charts).properties(width=480, height={"step": figures.BAR_STEP}, usermeta={"gutter": 10})
    return Drawing(chart, rows, note, text)


def list_ladder_steps(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of the ladder: ``step t told series``."""
    rungs = _find_ladder(scene)[0]
    rows = []
    for before, step in zip((None, *rungs), rungs, strict=False):
        if not math.isfinite(step.t_mrmse_m):
            continue
        name = "ideal"
        if before is not None:
            rises = format_rises(before, step)
            added = [name_term(one) for one in step.effects if one not in before.effects]
            name = f"+ {', '.join(added)}{rises and f' ({rises})'}"
        angle = step.r_mrmse_rad
        degrees = [] if math.isnan(angle) else [f"{format_angle(angle).partition(' ')[0]}\u00b0"]
        numbers = " \u00b7 ".join([format_length(step.t_mrmse_m), *degrees])
        rows.append((name, step.t_mrmse_m, numbers, "model" if step.effects else "ideal"))
    return {"ladder": pl.DataFrame(rows, schema=_SCHEMA, orient="row")}


def name_input(scene: Scene) -> str:
    """Input of the ladder's models."""
    motion = scene.report.motion
    if motion is not None:
        return motion.input
    return scene.report.diagnosis.input or scene.report.main_input


def _find_ladder(scene: Scene) -> tuple[Sequence[Step], Errors | None]:
    motion, diagnosis = scene.report.motion, scene.report.diagnosis
    return (diagnosis.ladder, diagnosis.noise_floor) if motion is None else (motion.ladder, motion.floor)


LADDER = Figure("ladder", "The error after each effect", draw_ladder, live=list_ladder_steps)

_SCHEMA_ENOUGH = {"number": pl.String, "seconds": pl.Float64, "value": pl.Float64}
_COLOURS = (
    theme.ON_COMMAND, theme.SLIP, theme.ON_MEASURED, theme.MODEL, theme.GROUND, theme.DRIVETRAIN, theme.CROSS,
)  # fmt: skip

# Above four colours, dashes distinguish the lines as well.
_DASHES = ([1, 0], [1, 0], [1, 0], [1, 0], [8, 3], [3, 3], [8, 3, 2, 3])


def draw_enough(scene: Scene) -> Drawing | None:
    """Draw the half-width of every interval over the driving that is used, relative to the value."""
    rows = _list_growth(scene)
    if rows.is_empty():
        return None
    legend = {"title": None, "symbolType": "stroke", "symbolSize": 220, "orient": "top", "columns": 4}
    line = (
        Chart.of_rows("enough")
        .mark("line", clip=True)
        .encode(
            x=make_axis("seconds", "driving used [s]", scale={"nice": False, "zero": True}, grid=False),
            y=make_axis(
                "value",
                None,
                # An interval that is wider than the value itself is not drawn.
                scale={"type": "log", "domain": [0.002, 1.0]},
                values=[0.01, INTERVAL_SHARE, 0.2, 1.0],
                format="~%",
                minExtent=figures.GUTTER - 10,
            ),
            color=encode_column("number:N", sort=None, scale={"range": _COLOURS}, legend=legend),
            strokeDash=encode_column("number:N", sort=None, scale={"range": _DASHES}, legend=legend),
            tooltip=[
                "number:N",
                encode_column("seconds:Q", format=".0f"),
                encode_column("value:Q", format=".3"),
            ],
        )
    )
    bound = Chart.of_rows("enough_bound").mark("rule", color=theme.INK, strokeDash=[4, 3]).encode(y="value:Q")
    title = "relative half-width of the 95 % interval"
    chart = layer(line, bound).properties(
        width=figures.WIDTH, height=120, title=title, usermeta={"gutter": figures.GUTTER}
    )
    sentence = describe_need(scene.report.diagnosis)
    note = f"{begin_large(sentence)}. Dashed: 5 %." if sentence else "Dashed: 5 %."
    words = f"Data: {sentence}." if sentence else "No effect has an interval that narrows with driving."
    bounds = pl.DataFrame({"value": [INTERVAL_SHARE]})
    return Drawing(chart, {"enough": rows, "enough_bound": bounds}, note, words)


def _list_growth(scene: Scene) -> pl.DataFrame:
    """Rows ``number seconds value`` of relative half-widths."""
    rows = [
        (f"{name_term(effect.id)}.{key}", second, half / goal)
        for effect in scene.report.diagnosis.effects
        for key, curve in (effect.growth or Growth()).parameters.items()
        if key in effect.parameters
        for goal in [find_goal(effect.id, key, effect.parameters[key].value) / INTERVAL_SHARE]
        for second, half in zip(curve.seconds, curve.half_width, strict=False)
        if math.isfinite(half)
    ]
    return pl.DataFrame(rows, schema=_SCHEMA_ENOUGH, orient="row")


ENOUGH = Figure("enough", "Is the log long enough", draw_enough, width="full")

_NUMBERS = dict.fromkeys(("from", "to", "low", "high"), pl.Float64)
_SCHEMA_BUDGET = {"cause": pl.String, **_NUMBERS, "kind": pl.String, "told": pl.String}
_COLOURS_BUDGET = {"effect": theme.MODEL, "disturbance": theme.GROUND, "localization_noise": theme.CROSS}


def draw_budget(scene: Scene) -> Drawing | None:
    """Waterfall from the total mean square slip of the ideal model to zero, one step per cause."""
    diagnosis, top, parts = scene.report.diagnosis, 1.0, []
    budgets = {one.quantity: one for one in diagnosis.budget if one.input == diagnosis.input}
    slip, position = budgets.get("slip"), budgets.get("position")
    if slip is None:
        return None
    errors = {} if position is None else {part.effect: part.share for _, part in position.causes}
    for kind, part in slip.causes:
        low, high = (top - end if math.isfinite(end) else None for end in (part.high, part.low))
        numbers = (
            f"slip {format_known_share(part.share)}, 2 s error {format_known_share(errors.get(part.effect))}"
        )
        parts.append((name_term(part.effect), top, top - part.share, low, high, kind, numbers))
        top -= part.share
    rows = pl.DataFrame(parts, schema=_SCHEMA_BUDGET, orient="row")
    if rows.is_empty():
        return None
    x = make_axis(
        "from",
        "share of the mean square slip",
        scale={"nice": False, "zero": True},
        values=[0.0, 0.25, 0.5, 0.75, 1.0],
        format="%",
        grid=False,
    )
    kinds = {"domain": list(_COLOURS_BUDGET), "range": list(_COLOURS_BUDGET.values())}
    base, bars, words = figures.name_bars("budget", "cause")
    bars = bars.encode(x=x, x2="to:Q", color=encode_column("kind:N", scale=kinds, legend=None))
    below = {"yOffset": figures.BAR_BELOW, "y2Offset": figures.BAR_BELOW}
    intervals = base.mark("rule", color=theme.INK, strokeWidth=1.2, **below).encode(x="low:Q", x2="high:Q")
    chart = layer(bars, intervals, words).properties(
        width=480, height={"step": figures.BAR_STEP}, usermeta={"gutter": 20}
    )
    note = (
        "Bars: share of the mean square slip; the 2 s error is the mean square error of position. "
        "Shapley shares (independent of order). Lines are 95 % intervals. "
        "Shares are taken off from 100 %; a negative share is a step to the right: it increases slip."
    )
    causes = "; ".join(f"{cause}: {numbers}" for cause, *_, numbers in rows.iter_rows())
    size = f"{format_number(slip.total)} m\u00b2/s\u00b2"
    text = (
        f"Mean square slip {INPUT_WORDS.get(slip.input, '')}, {size} over half a second by cause, shares of "
        f"it and of the 2 s error. {causes}."
    )
    return Drawing(chart, {"budget": rows}, note, text)


BUDGET = Figure("budget", "Error budget by cause", draw_budget)

_PARTS = {
    "drivetrain": "drivetrain (command to wheels)",
    "ground": "ground (wheels to body)",
    "cross": "cross term",
}
_COLOURS_SPLIT = {"drivetrain": theme.DRIVETRAIN, "ground": theme.GROUND, "cross": theme.CROSS}
_SUBSETS = ("all", "transitory", "steady")


def draw_split(scene: Scene) -> Drawing | None:
    """Mean squares of the two parts of slip from commands, for all, transitory and steady samples."""
    table = scene.report.table("aggregates")
    if table is None:
        return None
    parts = {name: pl.col(f"{name}_mean_square").fill_null(0.0) for name in _PARTS}
    # Parts are known for samples with both inputs, which are fewer than those of the command alone.
    rows = (
        table.filter(
            pl.col("input").cast(pl.String) == "command", pl.col("drivetrain_mean_square").is_not_null()
        )
        .select(pl.col("subset").cast(pl.String), **parts)
        .unpivot(list(_PARTS), index="subset", variable_name="series", value_name="mean_square")
        .filter(pl.col("mean_square").sum().over("subset") > 0.0)
    )
    if rows.is_empty():
        return None
    subset = encode_column(
        "subset:N", sort=list(_SUBSETS), axis={"title": None, "minExtent": 58, "grid": False}
    )
    chart = (
        Chart.of_rows("split")
        .mark("bar", cornerRadiusEnd=2)
        .encode(
            y=subset,
            yOffset=encode_column("series:N", sort=list(_PARTS)),
            x=make_axis("mean_square", "mean square of slip from commands [m²/s²]", tickCount=6),
            color=figures.series_colour(_PARTS, _COLOURS_SPLIT, "square"),
        )
        .properties(width=480, height=180, usermeta={"gutter": 60})
    )
    note = "Vectors add, moduli do not: the cross term is twice the mean product of the two."
    whole = rows.filter(pl.col("subset") == rows["subset"][0])
    total = float(whole["mean_square"].sum())
    shares = {name: size / total for name, size in whole.select("series", "mean_square").iter_rows()}
    return Drawing(
        chart, {"split": rows}, note, f"Mean square of the slip from commands: {format_split(**shares)}."
    )


SPLIT = Figure("split", "Drivetrain and ground", draw_split)
