"""The ladder: how the error on data not seen falls, effect by effect, down to the floor."""

from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.identification.ladder import ERRORS_OVER_2S, list_rises
from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import INPUT_WORDS, mapping_in, number_in, objects_in
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer
from pipeline.report.words import say_number

_SCHEMA = {"rung": pl.Int64, "step": pl.String, "t": pl.Float64, "told": pl.String, "series": pl.String}
_BOUND = {"t": pl.Float64, "told": pl.String, "label": pl.String, "right": pl.Boolean, "raised": pl.Boolean}
_BOUNDS = ("ceiling", "floor")
_ROOM = 1.04
_FAR = 0.6


def draw(scene: Scene) -> Drawing | None:
    """A staircase: one bar a rung, the longest on top, between the ceiling and the floor as dashed lines.

    The ceiling is the error of the ideal model, the floor how well motion repeats itself: what can be
    explained lies between them, and `explained_share` counts from the one to the other.
    """
    rows = list_rungs(scene)
    if rows["ladder"].is_empty():
        return None
    colour = theme.INPUT_COLOURS.get(name_input(scene), theme.QUIET)
    scale = {"domain": ["ideal", "model"], "range": [colour, theme.MODEL]}
    top = float(rows["ladder"]["t"].max() or 1.0)  # type: ignore[arg-type]
    title = "error over 2 s on data not seen [m]"
    x = make_axis("t", title, (0.0, top * _ROOM), tickCount=5, grid=False)
    base = parts.name_bars("ladder", "step")
    bars = base.bars.encode(x=x, color=encode_column("series:N", scale=scale, legend=None))
    # A line through each bar alone, so that it crosses no words.
    bounds = [
        base.ticks.encode(x=f"{word}:Q", tooltip=[encode_column(f"{word}:Q", title=f"{word} [m]")])
        for word in _BOUNDS
    ]
    names = [_name_bound(f"ladder_{word}") for word in _BOUNDS]
    chart = layer(bars, *bounds, base.words, *names).properties(
        width=480, height={"step": parts.BAR_STEP}, usermeta={"gutter": 10}
    )
    note = "Ceiling: the ideal model."
    if rows["ladder_floor"].height:
        note += " Floor: how well motion repeats itself. What can be explained lies between them."
    return Drawing(chart, rows, note, _describe(scene, rows))


def _name_bound(name: str) -> Chart:
    """The name of a bound above all bars, where its line is."""
    mark = Chart.of_rows(name).mark(
        "text",
        align={"expr": "datum.right ? 'right' : 'left'"},
        dy={"expr": "datum.raised ? -22 : -8"},
        fontSize=11,
    )
    named: Chart = mark.encode(x="t:Q", y={"value": 0}, text="label:N")
    return named


def list_rungs(scene: Scene) -> dict[str, pl.DataFrame]:
    """Rows of the staircase: ``rung step t told series``; the ceiling's and the floor's ``t told label``."""
    rungs, floor = _find_ladder(scene)
    rows = []
    before: Sequence[object] = ()
    for number, rung in enumerate(rungs):
        size = number_in(rung, "t_mrmse_m")
        effects = rung.get("effects")
        effects = effects if isinstance(effects, list | tuple) else []
        added = [str(name) for name in effects if name not in before]
        before = effects
        if size is None:
            continue
        rises = _describe_rises(rungs[max(number - 1, 0)], rung)
        rows.append(
            {
                "rung": number,
                "step": "ideal" if number == 0 else "+ " + ", ".join(added) + rises,
                "t": size,
                "told": f"{say_number(size)} m \u00b7 {say_number(number_in(rung, 'r_mrmse_rad'))} rad",
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


def _describe_rises(below: Mapping[str, object], rung: Mapping[str, object]) -> str:
    """What must not pass for progress: which error is higher than one rung below."""
    risen = [ERRORS_OVER_2S[key][0] for key in list_rises(below, rung)]
    return f" ({' and '.join(risen)} error rises)" if risen else ""


def _list_bound(word: str, size: float | None, most: float) -> pl.DataFrame:
    """A bound with its name, which ends at the line where there is no room behind it.

    A floor so high that its name would meet the ceiling's is named one row higher.
    """
    told, far = f"{say_number(size)} m", size is not None and size > _FAR * most
    row = (size, told, f"{word} {told}", far, far and word == "floor")
    return pl.DataFrame([] if size is None else [row], schema=_BOUND, orient="row")


def name_input(scene: Scene) -> str:
    """What the ladder's models are fed with."""
    motion = scene.report.motion
    if motion is not None:
        return motion.input
    found = scene.report.diagnosis.get("input")
    return found if isinstance(found, str) else scene.report.main_input


def _find_ladder(scene: Scene) -> tuple[Sequence[Mapping[str, object]], Mapping[str, object]]:
    motion = scene.report.motion
    if motion is not None:
        return motion.ladder, motion.floor or {}
    return objects_in(scene.report.diagnosis, "ladder"), mapping_in(scene.report.diagnosis, "noise_floor")


def _describe(scene: Scene, rows: Mapping[str, pl.DataFrame]) -> str:
    """Every rung with its errors."""
    told = "; ".join(f"{row['step']}: {row['told']}" for row in rows["ladder"].iter_rows(named=True))
    bounds = "".join(
        f" The {word} is {row['told']}."
        for word, name in (("ceiling, the ideal model,", "ladder_ceiling"), ("noise floor", "ladder_floor"))
        for row in rows[name].iter_rows(named=True)
    )
    words = INPUT_WORDS.get(name_input(scene), "")
    return f"Error of two-second predictions {words} on data not seen. {told}.{bounds}"


FIGURE = Figure("The ladder: error after each effect", Section.WHY, draw, order=0, live=list_rungs)
