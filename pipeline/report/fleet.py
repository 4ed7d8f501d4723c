"""The page of `slip fleet fit`: numbers of vehicles by level, and what runs on other grounds would tell."""

from collections.abc import Mapping, Sequence
from typing import cast

from pipeline.report.elements import Cell, Column, Table
from pipeline.report.page import render_figures
from pipeline.report.run import mapping_in, number_in, objects_in, say_ends
from pipeline.report.words import say_number

_LEVELS = (
    Column("number"), Column("whose"), Column("value", number=True), Column("95 %", number=True),
    Column("between terrains", number=True), Column("between runs", number=True),
    Column("reduced chi-square", number=True), Column("named in", "runs", number=True),
)  # fmt: skip
_TERRAINS = (
    Column("number"), Column("terrain"), Column("mean", number=True), Column("95 %", number=True),
    Column("runs", number=True),
)  # fmt: skip


def render_fleet(content: Mapping[str, object]) -> str:
    """The whole page as HTML.

    Args:
        content: the JSON object of `slip fleet fit`, with its `keys`.
    """
    rows = objects_in(content, "parameters")
    runs = mapping_in(content, "runs")
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row["level"] is None:
            reasons.setdefault(f"{row['because']} ({row['vehicle']})", []).append(_label(row))
    vehicles = []
    for number, name in enumerate(runs):
        own = [row for row in rows if row["vehicle"] == name]
        levels = Table(
            f"Numbers of {name}: whose they are, and how much they differ",
            _LEVELS,
            [_list(row) for row in own],
        )
        means = [cells for row in own for cells in _list_terrains(row)]
        vehicles.append(
            (f"vehicle-{number}", name, levels, Table(f"Means of {name} by terrain", _TERRAINS, means))
        )
    keys = cast("Sequence[str]", content["keys"])
    return render_figures(
        "report/templates/fleet.html",
        [],
        title="What is the vehicle's, what the ground's",
        facts=[
            f"{len(found)} {word}{'s' * (len(found) != 1)}"
            for word, found in (("vehicle", runs), ("run", keys), ("number", rows))
        ],
        vehicles=vehicles,
        open=[
            *(f"{why}: {', '.join(labels)}" for why, labels in reasons.items()),
            *cast("Sequence[str]", content["notes"]),
        ],
        runs=keys,
    )


def _label(row: Mapping[str, object]) -> str:
    return f"{row['effect']}.{row['parameter']}"


def _list(row: Mapping[str, object]) -> list[str | Cell]:
    spreads = [say_number(number_in(row, f"spread_{kind}")) for kind in ("terrain", "run")]
    return [
        Cell(str(row["name"]), small=_label(row), notes=[str(row["because"])] if row["level"] else ()),
        str(row["level"] or "open"),
        _say_value(row, row),
        say_ends(row),
        *spreads,
        say_number(number_in(row, "chi_square")),
        f"{row['named']} of {row['runs']}",
    ]


def _list_terrains(row: Mapping[str, object]) -> list[list[str | Cell]]:
    terrains = mapping_in(row, "terrains")
    means = {name: mapping_in(terrains, name) for name in terrains}
    return [
        [
            Cell(small=_label(row)),
            name,
            _say_value(mean, row),
            say_ends(mean),
            str(mean["runs"]),
        ]
        for name, mean in means.items()
    ]


def _say_value(of: Mapping[str, object], row: Mapping[str, object]) -> Cell:
    return Cell(say_number(number_in(of, "value")), small="" if row["unit"] == "1" else str(row["unit"]))
