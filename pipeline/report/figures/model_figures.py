"""Figures of the model: velocities, ladder of steps, slip budget, drivetrain and ground, sufficiency."""

import math
from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.core import INPUT_WORDS, finite_or_none, format_angle, format_length
from pipeline.estimation.decision import LEAST_T
from pipeline.estimation.driving_need import find_goal
from pipeline.models import name_term
from pipeline.report import begin_large, figures, format_known_share, format_number, format_split, theme
from pipeline.report.figures import Figure, Section
from pipeline.report.scene import (
    COMPONENTS,
    LINE_BINS,
    Scene,
    Thinned,
    break_lines,
    drop_flat_rows,
    thin_series,
)
from pipeline.report.theme import Channel, Chart, Drawing, encode_column, find_range, layer, make_axis, stack
from pipeline.results import (
    CHANCE,
    INTERVAL_SHARE,
    Errors,
    Growth,
    SlipBudget,
    Step,
    format_rises,
)
from pipeline.words import describe_need

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
    chart = stack(*(_draw_velocity(scene, component, line) for component, line in there.items()))
    rows = {f"velocity_{component}": line.frame for component, line in there.items()} | model_rows(scene)
    note = figures.format_thinning(*there.values(), rule="first, last, lowest and highest of every bin")
    # Initially the page shows only the worst stretch.
    window = {} if scene.worst_span is None else {"window": list(scene.worst_span)}
    return Drawing(
        chart.properties(usermeta=figures.brush_over_time() | window),
        rows | figures.span_rows(scene),
        f"{figures.format_bands(scene)} {note}".strip(),
        _format_velocities(scene),
    )


def _draw_velocity(scene: Scene, component: str, lines: Thinned) -> Chart:
    shown = find_range(lines.frame, lines.usual)
    title = figures.title_panel(*_QUANTITIES[component], shown)
    last = component == COMPONENTS[-1]
    series = [*scene.slip, "velocity", *(["model"] if scene.report.motion else [])]
    names = [f"velocity_{component}", *([f"model_{component}"] if scene.report.motion else [])]
    colour = figures.series_colour(series, figures.SERIES_WORDS)
    x = figures.time_axis(scene) if last else figures.time_axis(scene, title=None)
    return figures.draw_lines(scene, names, shown, colour, x).properties(height=118, title=title)


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


def _format_velocities(scene: Scene) -> str:
    """Names of the lines and their root mean square distance."""
    words = [figures.SERIES_WORDS[name] for name in scene.slip]
    return (
        "Forward velocity, lateral velocity and yaw rate over time in three panels: measured"
        + "".join(f", {word}" for word in words)
        + (", model" if scene.report.motion else "")
        + ". The distance between a line and the measured one is the slip in that direction."
    )


VELOCITIES = Figure(
    "Velocities: measured against ideal",
    Section.WHERE,
    draw_velocities,
    order=30,
    width="full",
    live=model_rows,
    id="velocities",
)

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
    base = figures.name_bars("ladder", "step")
    bars = base.bars.encode(x=x, color=encode_column("series:N", scale=scale, legend=None))
    # One line per bar, so that it crosses no text.
    bounds = [
        base.ticks.encode(x=f"{word}:Q", tooltip=[encode_column(f"{word}:Q", title=f"{word} [m]")])
        for word in _BOUNDS
    ]
    names = [_name_bound(f"ladder_{word}") for word in _BOUNDS]
    chart = layer(bars, *bounds, base.words, *names).properties(
        width=480, height={"step": figures.BAR_STEP}, usermeta={"gutter": 10}
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
    before: Sequence[str] = ()
    for number, step in enumerate(rungs):
        size, effects = step.t_mrmse_m, step.effects
        added = [name for name in effects if name not in before]
        before = effects
        if not math.isfinite(size):
            continue
        rises = format_rises(rungs[max(number - 1, 0)], step, CHANCE)
        rows.append(
            {
                "rung": number,
                "step": f"+ {', '.join(map(name_term, added))}{rises and f' ({rises})'}"
                if number
                else "ideal",
                "t": size,
                "told": " \u00b7 ".join([format_length(size), *_list_degrees(step)]),
                "series": "model" if effects else "ideal",
            }
        )
    ends = {"ceiling": rungs[0] if rungs else None, "floor": floor}
    bounds = {word: None if one is None else finite_or_none(one.t_mrmse_m) for word, one in ends.items()}
    columns = [pl.lit(size, pl.Float64).alias(word) for word, size in bounds.items()]
    most = max((float(str(row["t"])) for row in rows), default=0.0)
    return {
        "ladder": pl.DataFrame(rows, schema=_SCHEMA).with_columns(columns),
        **{f"ladder_{word}": _list_bound(word, size, most) for word, size in bounds.items()},
    }


def _list_degrees(step: Step) -> list[str]:
    """Heading error, if known, in short form for the label above a bar."""
    angle = step.r_mrmse_rad
    return [] if math.isnan(angle) else [f"{format_angle(angle).partition(' ')[0]}\u00b0"]


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
    return scene.report.diagnosis.input or scene.report.main_input


def _find_ladder(scene: Scene) -> tuple[Sequence[Step], Errors | None]:
    motion, diagnosis = scene.report.motion, scene.report.diagnosis
    return (diagnosis.ladder, diagnosis.noise_floor) if motion is None else (motion.ladder, motion.floor)


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
    "The error after each effect",
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
    sentence = describe_need(scene.report.diagnosis)
    note = f"{begin_large(sentence)}. " if sentence else ""
    note += "Lines: 5 %, and the detection threshold in t."
    words = f"Data: {sentence}." if sentence else "No effect has an interval that narrows with driving."
    return Drawing(stack(*panels).properties(usermeta={"gutter": figures.GUTTER}), shown, note, words)


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
            y=make_axis("value", None, scale=scale, minExtent=figures.GUTTER - 10, **ticks),
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
    return layer(line, bound).properties(width=figures.WIDTH, height=120, title=title)


def list_growth(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``effect number seconds value`` of relative half-widths, and of evidence."""
    widths: list[tuple[str, str, float, float]] = []
    evidence: list[tuple[str, str, float, float]] = []
    for effect in scene.report.diagnosis.effects:
        name, growth = name_term(effect.id), effect.growth or Growth()
        for key, curve in growth.parameters.items():
            if key in effect.parameters:
                goal = find_goal(effect.id, key, effect.parameters[key].value) / INTERVAL_SHARE
                points = _list_points(curve.seconds, curve.half_width)
                widths += [(name, f"{name}.{key}", second, half / goal) for second, half in points]
        if growth.evidence is not None:
            points = _list_points(growth.evidence.seconds, growth.evidence.t)
            evidence += [(name, name, second, t) for second, t in points]
    return {
        "enough_width": pl.DataFrame(widths, schema=_SCHEMA_ENOUGH, orient="row"),
        "enough_evidence": pl.DataFrame(evidence, schema=_SCHEMA_ENOUGH, orient="row"),
    }


def _list_points(seconds: Sequence[float], values: Sequence[float]) -> list[tuple[float, float]]:
    return [point for point in zip(seconds, values, strict=False) if math.isfinite(point[1])]


ENOUGH = Figure("Is the log long enough", Section.REST, draw_enough, order=6, width="full", id="enough")

_NUMBERS = dict.fromkeys(("from", "to", "low", "high"), pl.Float64)
_SCHEMA_BUDGET = {"cause": pl.String, **_NUMBERS, "kind": pl.String, "told": pl.String}
_COLOURS_BUDGET = {"effect": theme.MODEL, "disturbance": theme.GROUND, "localization_noise": theme.CROSS}


def draw_budget(scene: Scene) -> Drawing | None:
    """Waterfall from the total mean square slip of the ideal model to zero, one step per cause."""
    rows = list_parts(scene)
    if rows.is_empty():
        return None
    ends = rows.select(
        low=pl.min_horizontal("from", "to", "low"), high=pl.max_horizontal("from", "to", "high")
    )
    domain = (min(0.0, float(ends["low"].min() or 0.0)), max(1.0, float(ends["high"].max() or 1.0)))  # type: ignore[arg-type]
    ticks = [0.0, 0.25, 0.5, 0.75, 1.0]
    title = "share of the mean square slip"
    x = make_axis("from", title, domain, format="%", grid=False, values=ticks)
    colour = encode_column(
        "kind:N",
        scale={"domain": list(_COLOURS_BUDGET), "range": list(_COLOURS_BUDGET.values())},
        legend=None,
    )
    base = figures.name_bars("budget", "cause")
    bars = base.bars.encode(x=x, x2="to:Q", color=colour)
    intervals = base.rules.encode(x="low:Q", x2="high:Q")
    chart = layer(bars, intervals, base.words).properties(
        width=480, height={"step": figures.BAR_STEP}, usermeta={"gutter": 20}
    )
    note = (
        "Bars: share of the mean square slip; the 2 s error is the mean square error of position. "
        "Shapley shares (independent of order). Lines are 95 % intervals. "
        "Shares are taken off from 100 %; a negative share is a step to the right: it increases slip."
    )
    return Drawing(chart, {"budget": rows}, note, _format_split(scene, rows))


def list_parts(scene: Scene) -> pl.DataFrame:
    """Rows ``cause from to low high kind told``: start and end of each cause's step, and its text."""
    slip, position = _find_budget(scene, "slip"), _find_budget(scene, "position")
    errors = {} if position is None else {part.effect: part.share for _, part in position.causes}
    rows, top = [], 1.0
    for kind, part in [] if slip is None else slip.causes:
        name, share = part.effect, part.share
        low, high = finite_or_none(part.low), finite_or_none(part.high)
        rows.append(
            {
                "cause": name_term(name),
                "from": top,
                "to": top - share,
                "low": None if high is None else top - high,
                "high": None if low is None else top - low,
                "kind": kind,
                "told": f"slip {format_known_share(share)}, 2 s error {format_known_share(errors.get(name))}",
            }
        )
        top -= share
    return pl.DataFrame(rows, schema=_SCHEMA_BUDGET)


def _find_budget(scene: Scene, quantity: str) -> SlipBudget | None:
    """Budget of a quantity on the leading input; None without one."""
    wanted = (scene.report.diagnosis.input, quantity)
    return next((one for one in scene.report.diagnosis.budget if (one.input, one.quantity) == wanted), None)


def _format_split(scene: Scene, rows: pl.DataFrame) -> str:
    """Format every cause with its share."""
    slip = _find_budget(scene, "slip")
    sentence = "; ".join(f"{row['cause']}: {row['told']}" for row in rows.iter_rows(named=True))
    words = "" if slip is None else INPUT_WORDS.get(slip.input, "")
    size = f"{format_number(None if slip is None else slip.total)} m\u00b2/s\u00b2"
    return (
        f"Mean square slip {words}, {size} over half a second by cause, shares of it and of the 2 s error. "
        f"{sentence}."
    )


BUDGET = Figure("Error budget by cause", Section.REST, draw_budget, order=1, id="budget")

_PARTS = {
    "drivetrain": "drivetrain (command to wheels)",
    "ground": "ground (wheels to body)",
    "cross": "cross term",
}
_COLOURS_SPLIT = {"drivetrain": theme.DRIVETRAIN, "ground": theme.GROUND, "cross": theme.CROSS}
_SUBSETS = ("all", "transitory", "steady")


def draw_split(scene: Scene) -> Drawing | None:
    """Mean squares of the two parts of slip from commands, for all, transitory and steady samples."""
    rows = _list_parts(scene)
    if rows is None:
        return None
    scale = {"domain": list(_PARTS), "range": list(_COLOURS_SPLIT.values())}
    label = " : ".join(f"datum.value === '{name}' ? '{words}'" for name, words in _PARTS.items())
    legend = {"title": None, "labelExpr": f"{label} : datum.value", "symbolType": "square"}
    span = [min(0.0, float(rows["mean_square"].min())), max(0.0, float(rows["mean_square"].max()))]  # type: ignore[arg-type]
    room = 0.12 * (span[1] - span[0] or 1.0)
    title = "mean square of slip from commands [m²/s²]"
    shown = (span[0] - (room if span[0] < 0 else 0), span[1] + room)
    base = Chart.of_rows("split").encode(
        y=encode_column(
            "subset:N", sort=list(_SUBSETS), axis={"title": None, "minExtent": 58, "grid": False}
        ),
        yOffset=encode_column("part:N", sort=list(_PARTS)),
        x=make_axis("mean_square", title, shown, tickCount=6),
    )
    bars = base.mark("bar", cornerRadiusEnd=2).encode(
        color=encode_column("part:N", scale=scale, legend=legend)
    )
    positive = base.filter("datum.mean_square >= 0").mark("text", align="left", dx=5)
    negative = base.filter("datum.mean_square < 0").mark("text", align="right", dx=-5)
    words = [side.encode(text="label:N") for side in (positive, negative)]
    chart = layer(bars, *words).properties(
        width=640, height=34 * 3 * rows["subset"].n_unique() // 2 + 40, usermeta={"gutter": 60}
    )
    note = "Vectors add, moduli do not: shares of the mean square; the cross term is twice the mean product."
    first = rows.filter(pl.col("subset") == rows["subset"][0])
    shares = format_split(**dict(zip(first["part"], first["share"], strict=True)))
    return Drawing(chart, {"split": rows}, note, f"Mean square of the slip from commands: {shares}.")


def _list_parts(scene: Scene) -> pl.DataFrame | None:
    """Long rows ``subset part mean_square share label``; None without measured wheels."""
    table = scene.report.table("aggregates")
    if table is None:
        return None
    # Parts are known for samples with both inputs, which are fewer than those of the command alone.
    parts = pl.sum_horizontal(f"{part}_mean_square" for part in _PARTS)
    wanted = table.with_columns(total=parts).filter(
        (pl.col("input").cast(pl.String) == "command")
        & pl.col("drivetrain_mean_square").is_not_null()
        & (pl.col("total") > 0.0)
    )
    if wanted.is_empty():
        return None
    return (
        wanted.select(
            pl.col("subset").cast(pl.String),
            "total",
            *(pl.col(f"{part}_mean_square").fill_null(0.0).alias(part) for part in _PARTS),
        )
        .unpivot(list(_PARTS), index=["subset", "total"], variable_name="part", value_name="mean_square")
        .with_columns(share=pl.col("mean_square") / pl.col("total"))
        # A part larger than the total is not a share of it; the bar shows its size.
        .with_columns(
            label=pl.when((pl.col("share") > 1.0).any().over("subset"))
            .then(pl.lit(""))
            .otherwise((pl.col("share") * 100.0).round(0).cast(pl.Int64).cast(pl.String) + " %")
        )
        .drop("total")
        .sort(
            pl.col("subset").replace_strict({name: i for i, name in enumerate(_SUBSETS)}), maintain_order=True
        )
    )


SPLIT = Figure("Drivetrain and ground", Section.REST, draw_split, order=10, width="full", id="split")
