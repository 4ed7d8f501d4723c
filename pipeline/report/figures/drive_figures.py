"""Figures of the drive: slip budget, drivetrain and ground, steps of commands."""

from collections.abc import Mapping

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.core.json_objects import mapping_in, number_in, objects_in
from pipeline.core.program import INPUT_WORDS, format_share
from pipeline.report import theme
from pipeline.report.figures import figure
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import Scene
from pipeline.report.templating import format_known_share, format_number, format_split
from pipeline.report.theme import Chart, encode_column, layer, make_axis, stack

_NUMBERS = dict.fromkeys(("from", "to", "low", "high"), pl.Float64)
_SCHEMA = {"cause": pl.String, **_NUMBERS, "kind": pl.String, "told": pl.String}
_LEFT = {"disturbance": "disturbance", "localization_noise": "localization noise"}
_COLOURS = {"effect": theme.MODEL, "disturbance": theme.GROUND, "localization_noise": theme.CROSS}


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
        "kind:N", scale={"domain": list(_COLOURS), "range": list(_COLOURS.values())}, legend=None
    )
    base = figure.name_bars("budget", "cause")
    bars = base.bars.encode(x=x, x2="to:Q", color=colour)
    intervals = base.rules.encode(x="low:Q", x2="high:Q")
    chart = layer(bars, intervals, base.words).properties(
        width=480, height={"step": figure.BAR_STEP}, usermeta={"gutter": 20}
    )
    note = (
        "Bars: share of the mean square slip; the 2 s error is the mean square error of position. "
        "Shapley shares (independent of order). Lines are 95 % intervals. "
        "A bar to the right makes slip larger."
    )
    return Drawing(chart, {"budget": rows}, note, _format_split(scene, rows))


def list_parts(scene: Scene) -> pl.DataFrame:
    """Rows ``cause from to low high kind told``: start and end of each cause's step, and its text."""
    slip, position = _find_budget(scene, "slip"), _find_budget(scene, "position")
    errors = {str(part.get("effect")): number_in(part, "share") for part in objects_in(position, "shares")}
    errors |= {kind: number_in(mapping_in(position, kind), "share") for kind in _LEFT}
    parts = [("effect", str(part.get("effect")), part) for part in objects_in(slip, "shares")]
    parts += [(kind, kind, mapping_in(slip, kind)) for kind in _LEFT if mapping_in(slip, kind)]
    rows, top = [], 1.0
    for kind, name, part in parts:
        share = number_in(part, "share") or 0.0
        low, high = number_in(part, "low"), number_in(part, "high")
        rows.append(
            {
                "cause": _LEFT.get(name, name),
                "from": top,
                "to": top - share,
                "low": None if high is None else top - high,
                "high": None if low is None else top - low,
                "kind": kind,
                "told": f"slip {format_known_share(share)}, 2 s error {format_known_share(errors.get(name))}",
            }
        )
        top -= share
    return pl.DataFrame(rows, schema=_SCHEMA)


def _find_budget(scene: Scene, quantity: str) -> Mapping[str, object]:
    """Budget of a quantity on the leading input; empty without one."""
    diagnosis = scene.report.diagnosis
    wanted = (diagnosis.get("input"), quantity)
    budgets = objects_in(diagnosis, "budget")
    return next((one for one in budgets if (one.get("input"), one.get("quantity")) == wanted), {})


def _format_split(scene: Scene, rows: pl.DataFrame) -> str:
    """Format every cause with its share."""
    slip = _find_budget(scene, "slip")
    total = number_in(slip, "total")
    sentence = "; ".join(f"{row['cause']}: {row['told']}" for row in rows.iter_rows(named=True))
    words = INPUT_WORDS.get(str(slip.get("input")), "")
    size = f"{format_number(total)} m\u00b2/s\u00b2"
    return (
        f"Mean square slip {words}, {size} over half a second by cause, shares of it and of the 2 s error. "
        f"{sentence}."
    )


BUDGET = Figure("Error budget by cause", Section.WHY, draw_budget, order=1, id="budget")


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
    wanted = table.filter(
        (pl.col("input").cast(pl.String) == "command")
        & pl.col("drivetrain_mean_square").is_not_null()
        & (pl.col("mean_square") > 0.0)
    )
    if wanted.is_empty():
        return None
    return (
        wanted.select(
            pl.col("subset").cast(pl.String),
            pl.col("mean_square").alias("total"),
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


SPLIT = Figure("Drivetrain and ground", Section.WHY, draw_split, order=10, width="full", id="split")


_CHANNELS = {"x": ("forward velocity", 0.15), "w": ("yaw rate", 0.15)}
_BEFORE_S, _AFTER_S, _RATE_HZ = 0.5, 3.0, 20.0
_FEWEST = 2
_WORDS = {"command": "command", "velocity": "measured", "model": "model"}


def draw_step_response(scene: Scene) -> Drawing | None:
    """Draw a panel each for speed and yaw rate; None if too few steps are held for long enough."""
    rows = list_responses(scene)
    panels = [
        _draw_panel(component, list(rows[f"response_{component}"]["series"].unique(maintain_order=True)))
        for component in _CHANNELS
        if f"response_{component}" in rows
    ]
    if not panels:
        return None
    chart = stack(*panels).properties(usermeta={"gutter": figure.GUTTER})
    note = "Median over steps of the command that are held for three seconds; 1 is the command."
    return Drawing(chart, rows, note, _format_step_response(rows))


def list_responses(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows ``t value series`` of each channel with steps; empty without any."""
    slip = scene.slip.get("command")
    if slip is None:
        return {}
    motion = scene.report.motion
    tables = {}
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
        tables[f"response_{component}"] = pl.concat(frames)
    return tables


def find_steps(t: Floats, asked: Floats, *, smallest: float) -> tuple[Floats, Floats, Floats]:
    """Find steps of a held command.

    Args:
        t: times [s], increasing.
        asked: the command's ideal velocity.
        smallest: minimum height of a step.

    Returns:
        Times of the steps [s], and the values before and after them, each of shape (k,); the command is
        constant for long enough before and after a step.
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
    y = make_axis("value", None, (-0.25, 1.4), values=[0, 0.5, 1], minExtent=figure.GUTTER - 10)
    line = Chart.of_rows(f"response_{component}").mark("line", clip=True, strokeWidth=2)
    drawn = line.encode(x=x, y=y, color=figure.series_colour(series, _WORDS))
    title = {"text": f"{_CHANNELS[component][0]}, share of the step [1]"}
    return layer(drawn).properties(width=480, height=96, title=title)


def _format_step_response(responses: dict[str, pl.DataFrame]) -> str:
    """Time at which the measured response reaches 63 % of the step."""
    sentences = []
    for name, rows in responses.items():
        line = rows.filter(pl.col("series") == "velocity")
        reached = line.filter((pl.col("value") >= 0.632) & (pl.col("t") > 0.0))["t"]  # noqa: PLR2004 - 1 - 1/e
        when = f"63 % after {reached[0]:.2f} s" if reached.len() else "never 63 %"
        ends = float(line["value"].tail(10).median() or 0.0)  # type: ignore[arg-type]
        sentences.append(f"{_CHANNELS[name[-1]][0]}: {when}, {format_share(ends)} in the end")
    return "Median response to a step of the command. " + "; ".join(sentences) + "."


STEP_RESPONSE = Figure(
    "After a step of the command",
    Section.WHY,
    draw_step_response,
    order=3,
    live=list_responses,
    id="step_response",
)
