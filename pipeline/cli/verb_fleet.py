"""`slip fleet`: what is the vehicle's, what is the ground's, what changes from run to run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, cast

from cyclopts import App, Parameter

from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import print_result, say_value

_LABEL = 26
_LEVEL = 9
_SPREADS = (
    ("spread_terrain", "between terrains"),
    ("spread_run", "between runs"),
    ("chi_square", "reduced chi-square"),
)

Results = Annotated[Path, Parameter(help="results folder")]
Out = Annotated[Path | None, Parameter(help="the same as RESULTS")]


def build() -> App:
    """The verb and its own verbs."""
    fleet = App(name="fleet", help="Numbers of vehicles by level: the vehicle's, the ground's, a run's own.")
    for command in (fit, show):
        fleet.command(command)
    return fleet


def fit(
    results: Results = Path("results"),
    /,
    *,
    out: Out = None,
    key: KeyFile = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Fit the fleet model to all diagnosed runs: every parameter by vehicle, terrain and run.

    Writes fleet.json, fleet.parquet and fleet.html.

    Args:
        results: results folder.
        out: the same as RESULTS.
        key: file of the key that seals the results (or SLIP_KEY_FILE).
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.fleet import describe_fleet, fit_results, write_fleet  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    use_key(key)
    store = Store(out or results)
    model, keys = fit_results(store)
    path = write_fleet(store, model, keys)
    content = {**describe_fleet(model), "file": str(path)}
    return print_result(content, lambda: _describe(content), json=json, quiet=quiet)


def show(
    results: Results = Path("results"), /, *, out: Out = None, json: bool = False, quiet: bool = False
) -> int:
    """Show the fleet model that was fitted last.

    Args:
        results: results folder.
        out: the same as RESULTS.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.fleet import read_fleet  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    content = read_fleet(Store(out or results))
    return print_result(content, lambda: _describe(content), json=json, quiet=quiet)


def _describe(content: Mapping[str, object]) -> list[str]:
    rows = cast("Sequence[Mapping[str, object]]", content["parameters"])
    runs = cast("Mapping[str, Sequence[str]]", content["runs"])
    lines = []
    for vehicle, names in runs.items():
        own = [row for row in rows if row["vehicle"] == vehicle]
        lines.append(f"{vehicle}: {len(names)} run{'s' * (len(names) != 1)}")
        lines += [line for row in own for line in _describe_number(row)]
        lines += [] if own else ["  no effect is named in any of them"]
    return [*lines, *(f"! {note}" for note in cast("Sequence[str]", content["notes"]))]


def _describe_number(row: Mapping[str, object]) -> list[str]:
    label = f"{row['effect']}.{row['parameter']}"
    unit = "" if row["unit"] == "1" else f" {row['unit']}"
    spreads = [f"{words} {say_value(row[key])}" for key, words in _SPREADS if row[key] is not None]
    value = f"{say_value(row['value'])}{unit}"
    if row["low"] is not None:
        value += f" [{say_value(row['low'])}, {say_value(row['high'])}]"
    told = ", ".join([value, *spreads])
    name = "" if row["name"] == row["effect"] else f": {row['name']}"
    return [
        f"  {row['level'] or 'open':<{_LEVEL}}{label:<{_LABEL}}{told}{name}",
        f"  {'':<{_LEVEL + _LABEL}}{row['because']}",
    ]
