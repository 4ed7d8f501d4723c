"""Who carries the slip: one bar from the ideal model's slip down to the floor, effect by effect."""

from collections.abc import Mapping

import polars as pl

from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures import parts
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.run import INPUT_WORDS, mapping_in, number_in, objects_in
from pipeline.report.scene import Scene
from pipeline.report.vega import encode_column, layer
from pipeline.report.words import say_number, say_share

_NUMBERS = dict.fromkeys(("from", "to", "low", "high"), pl.Float64)
_SCHEMA = {"cause": pl.String, **_NUMBERS, "kind": pl.String, "told": pl.String}
_LEFT = {"disturbance": "disturbance", "localization_noise": "localization noise"}
_COLOURS = {"effect": theme.MODEL, "disturbance": theme.GROUND, "localization_noise": theme.CROSS}


def draw(scene: Scene) -> Drawing | None:
    """Steps from the whole of the ideal model's mean square slip down to nothing, one a cause."""
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
    base = parts.name_bars("budget", "cause")
    bars = base.bars.encode(x=x, x2="to:Q", color=colour)
    intervals = base.rules.encode(x="low:Q", x2="high:Q")
    chart = layer(bars, intervals, base.words).properties(
        width=480, height={"step": parts.BAR_STEP}, usermeta={"gutter": 20}
    )
    note = (
        "Numbers: share of the slip, then of the 2 s position error, of the model that the diagnosis names; "
        "fair to the order of its effects. Lines are 95 % intervals. A bar to the right makes slip larger."
    )
    return Drawing(chart, {"budget": rows}, note, _describe(scene, rows))


def list_parts(scene: Scene) -> pl.DataFrame:
    """Rows ``cause from to low high kind told``: where each cause's step begins and ends, and in words."""
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
                "told": f"{say_share(share)} \u00b7 {say_share(errors.get(name))}",
            }
        )
        top -= share
    return pl.DataFrame(rows, schema=_SCHEMA)


def _find_budget(scene: Scene, quantity: str) -> Mapping[str, object]:
    """The budget of a quantity on the leading input; empty without."""
    diagnosis = scene.report.diagnosis
    wanted = (diagnosis.get("input"), quantity)
    found = objects_in(diagnosis, "budget")
    return next((one for one in found if (one.get("input"), one.get("quantity")) == wanted), {})


def _describe(scene: Scene, rows: pl.DataFrame) -> str:
    """Every cause with its share."""
    slip = _find_budget(scene, "slip")
    total = number_in(slip, "total")
    told = "; ".join(f"{row['cause']}: {row['told']}" for row in rows.iter_rows(named=True))
    words = INPUT_WORDS.get(str(slip.get("input")), "")
    size = f"{say_number(total)} m\u00b2/s\u00b2"
    return (
        f"Mean square slip {words}, {size} over half a second by cause, shares of it and of the 2 s error. "
        f"{told}."
    )


FIGURE = Figure("The budget: who carries the slip", Section.WHY, draw, order=1)
