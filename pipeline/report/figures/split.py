"""What the drivetrain does to the command, and what the ground does to the wheels' motion."""

import polars as pl

from pipeline.report import theme
from pipeline.report.axes import make_axis
from pipeline.report.figures.figure import Drawing, Figure, Section
from pipeline.report.scene import Scene
from pipeline.report.vega import Chart, encode_column, layer
from pipeline.report.words import say_split

_PARTS = {
    "drivetrain": "drivetrain (command to wheels)",
    "ground": "ground (wheels to body)",
    "cross": "cross term",
}
_COLOURS = {"drivetrain": theme.DRIVETRAIN, "ground": theme.GROUND, "cross": theme.CROSS}
_SUBSETS = ("all", "transitory", "steady")


def draw(scene: Scene) -> Drawing | None:
    """Mean squares of the two parts of slip on the command, for all, transitory and steady samples."""
    rows = _list_parts(scene)
    if rows is None:
        return None
    scale = {"domain": list(_PARTS), "range": list(_COLOURS.values())}
    label = " : ".join(f"datum.value === '{name}' ? '{words}'" for name, words in _PARTS.items())
    legend = {"title": None, "labelExpr": f"{label} : datum.value", "symbolType": "square"}
    span = [min(0.0, float(rows["mean_square"].min())), max(0.0, float(rows["mean_square"].max()))]  # type: ignore[arg-type]
    room = 0.12 * (span[1] - span[0] or 1.0)
    title = "mean square of slip on command [m²/s²]"
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
    right = base.filter("datum.mean_square >= 0").mark("text", align="left", dx=5)
    left = base.filter("datum.mean_square < 0").mark("text", align="right", dx=-5)
    words = [side.encode(text="label:N") for side in (right, left)]
    chart = layer(bars, *words).properties(
        width=640, height=34 * 3 * rows["subset"].n_unique() // 2 + 40, usermeta={"gutter": 60}
    )
    note = "Vectors add, moduli do not: shares of the mean square; the cross term is twice the mean product."
    first = rows.filter(pl.col("subset") == rows["subset"][0])
    shares = say_split(**dict(zip(first["part"], first["share"], strict=True)))
    return Drawing(chart, {"split": rows}, note, f"Mean square of the slip on the command: {shares}.")


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
        # A part larger than the whole is no share of it: its bar says how large it is.
        .with_columns(
            label=pl.when((pl.col("share") > 1.0).any().over("subset"))
            .then(pl.lit(""))
            .otherwise((pl.col("share") * 100.0).round(0).cast(pl.Int64).cast(pl.String) + "%")
        )
        .drop("total")
        .sort(
            pl.col("subset").replace_strict({name: i for i, name in enumerate(_SUBSETS)}), maintain_order=True
        )
    )


FIGURE = Figure("Drivetrain and ground", Section.WHY, draw, order=10, width="full")
