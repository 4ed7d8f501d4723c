"""Runs together: parameters of a fleet by level, their course over dates, the map."""

from pipeline.core import INPUT_WORDS, format_count, format_digits, suffix_unit
from pipeline.datasets import Band, DeploymentMap, Fleet, Series, Trend
from pipeline.models import name_number
from pipeline.words.tables import NOTHING, Cell, Column, Table

_MOST_NUMBERS = 8
"""Parameters of a vehicle on a screen of 24 lines, those of most runs first."""


def tabulate_fleet(fleet: Fleet, *, everything: bool = True) -> list[Table]:
    """Parameters by vehicle, each with the bands of another run, and of its terrains.

    Args:
        fleet: the parameters of all runs.
        everything: also all terrains, and parameters of few runs.
    """
    tables = []
    for vehicle, runs in fleet.runs.items():
        own = [one for one in fleet.numbers if one.vehicle == vehicle]
        shown = own if everything else own[:_MOST_NUMBERS]
        rows: list[list[str | Cell]] = []
        for one in shown:
            spreads = [_format(spread) for spread in (one.spread_terrain, one.spread_run)]
            unit, level = suffix_unit(one.unit).strip(), one.level or "open"
            whole = [*_format_band(one.whole), unit, level]
            if one.disagreeing:
                # A mean of values that disagree is a property of nothing.
                ends = f"{one.disagreeing[0]:.3g} to {one.disagreeing[-1]:.3g}"
                whole = [ends, NOTHING, NOTHING, unit, "runs disagree"]
            elif one.level == "terrain":
                whole[:2] = "by terrain", NOTHING
            rows.append(
                [Cell(one.label, strong=True), *whole, str(one.whole.runs), *spreads, one.name, one.because]
            )
            is_split = everything or one.level == "terrain"
            rows += [
                [f"  on {name}", *_format_band(band), "", "", str(band.runs), *[""] * 4]
                for name, band in one.terrains.items()
                if is_split
            ]
        hidden = len(own) - len(shown)
        note = f"{format_count(hidden, 'more parameter')}: --all, or the page" if hidden else ""
        tables.append(Table(f"{vehicle}: {format_count(len(runs), 'run')}", _FLEET, rows, note))
    return [one.drop_empty() for one in tables if one.rows]


_FLEET = (
    Column("parameter"),
    Column("value", number=True),
    Column("95 %", number=True),
    Column("another run", number=True),
    Column("unit"),
    Column("level"),
    Column("runs", number=True, wide=True),
    Column("spread between terrains", number=True, wide=True),
    Column("between runs", number=True, wide=True),
    Column("name", wide=True),
    Column("because", wide=True),
)


def _format(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.3g}"


def _format_band(band: Band) -> tuple[str, str, str]:
    ends = [(band.low, band.high), (band.another_low, band.another_high)]
    texts = [NOTHING if low is None or high is None else f"{low:.3g} to {high:.3g}" for low, high in ends]
    return _format(band.value), texts[0], texts[1]


def format_fleet(fleet: Fleet, *, everything: bool) -> list[str]:
    """Parameters by vehicle, with the bands of another run, on one screen.

    Args:
        fleet: the parameters of all runs.
        everything: also all terrains, and why each number has its level.
    """
    lines = [fleet.summary]
    for table in tabulate_fleet(fleet, everything=everything):
        lines += ["", table.caption, *table.align(), *([table.note] if table.note else [])]
    lines += [""] * everything
    lines += [f"{one.label}: {one.name}, {one.because}" for one in fleet.numbers if everything]
    return [*lines, *(f"! {note}" for note in fleet.notes)]


def name_series(series: Series) -> str:
    """What a series is of, in words: `median slip modulus from commands`, `effective track (...)`."""
    effect, _, parameter = series.quantity.partition(".")
    if parameter:
        return f"{name_number(effect, parameter)} ({series.quantity})"
    source = series.quantity.removesuffix(")").partition(" (")[2]
    return f"median slip modulus {INPUT_WORDS[source]}"


def tabulate_trend(trend: Trend, *, everything: bool = True) -> Table:
    """Each series with its latest value and its largest step.

    Args:
        trend: the series.
        everything: also those that cannot be tested.
    """
    rows: list[list[str | Cell]] = [
        [name_series(one), one.group, Cell(one.describe(), strong=one.is_changed)]
        for one in trend.series
        if everything or one.step is not None
    ]
    hidden = len(trend.series) - len(rows)
    note = f"{hidden} series cannot be tested: --all, or the page" if hidden else ""
    return Table("All series", (Column("quantity"), Column("of"), Column("course")), rows, note)


def format_trend(trend: Trend, *, everything: bool) -> list[str]:
    """How many series could be tested, each with its largest step, and notes.

    Args:
        trend: the series.
        everything: also those that cannot be tested.
    """
    table = tabulate_trend(trend, everything=everything)
    notes = [f"! {note}" for note in trend.notes]
    return [f"{trend.summary}.", *table.align(), *([table.note] if table.note else []), *notes]


def tabulate_map(drawn: DeploymentMap) -> list[Table]:
    """Own datasets with their energy, complexity and measure, and the deployments of the literature."""
    places = (
        Column("energy", "J", number=True),
        Column("complexity", number=True),
    )
    own: list[list[str | Cell]] = [
        [
            str(row["dataset"]), format_digits(row["energy"], 3), _format(row["complexity"]),
            _format(row["value"]), str(row["vehicle"]), str(row["terrain"]), str(row["runs"]),
        ]
        for row in drawn.own.iter_rows(named=True)
    ]  # fmt: skip
    literature: list[list[str | Cell]] = [
        [
            str(row["key"]), str(row["vehicle"]), str(row["terrain"]), format_digits(row["energy"], 3),
            _format(row["complexity"]), str(row["bound"]), "yes" if row["sure"] else "no", str(row["title"]),
            str(row["year"]),
        ]
        for row in drawn.points.iter_rows(named=True)
    ]  # fmt: skip
    about = f"{drawn.measure.name} {INPUT_WORDS[drawn.input]}"
    measure = Column(drawn.measure.name, drawn.measure.unit, number=True)
    driven = (
        Column("vehicle", wide=True),
        Column("terrain", wide=True),
        Column("runs", number=True, wide=True),
    )
    known = (Column("energy is"), Column("known well"), Column("title"), Column("year", number=True))
    return [
        Table(
            f"Own datasets: largest kinetic energy of a run, {about}",
            (Column("dataset"), *places, measure, *driven),
            own,
        ),
        Table(
            "The literature",
            (Column("key"), Column("vehicle"), Column("terrain"), *places, *known),
            literature,
        ),
    ]


def format_map(drawn: DeploymentMap) -> list[str]:
    """Own datasets with their energy, complexity and measure, and notes."""
    return [*tabulate_map(drawn)[0].align(), *(f"! {note}" for note in drawn.notes)]


def summarize_map(drawn: DeploymentMap) -> str:
    """How many deployments of the literature are on the map, and what colours own datasets."""
    total = drawn.points.height + len(drawn.missing)
    by = f"{drawn.measure.name} {INPUT_WORDS[drawn.input]}"
    return f"{drawn.points.height} of {total} deployments placed; {by}"
