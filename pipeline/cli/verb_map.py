"""`slip map`: deployments of the literature and own ones, and the table behind them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from pipeline.analysis.options import FigureFormat
from pipeline.cli.choices import KeyFile, use_key
from pipeline.cli.output import print_result
from pipeline.cli.results_place import open_results

if TYPE_CHECKING:
    import polars as pl

_OWN = Path("deployments.csv")
_FEATURES_MEMORY = "2GB"


def build() -> App:
    """The verb and its two commands."""
    verb = App(
        name="map", help="Draw deployments by kinetic energy and terrain complexity, own runs on them."
    )
    verb.default(draw)
    verb.command(add)
    verb.command(merge)
    return verb


def draw(  # noqa: D417 - arguments document themselves
    results: Annotated[Path, Parameter(help="results folder; may be empty")] = Path("results"),
    /,
    *,
    deployments: Annotated[
        Path | None, Parameter(help="table of deployments in place of the project's own")
    ] = None,
    fed: Annotated[
        Literal["command", "measured"] | None,
        Parameter(name="--input", help="what the ideal model was fed with (default: as slip compare)"),
    ] = None,
    show: Annotated[
        Literal["slip", "relative", "energy", "unpredictability", "transitory"],
        Parameter(help="the measure of difficulty that colours own datasets"),
    ] = "slip",
    shared: Annotated[
        Path | None, Parameter(help="features of others, as slip share writes them, to draw as well")
    ] = None,
    figures: FigureFormat | None = None,
    out: Annotated[Path | None, Parameter(help="the same as RESULTS")] = None,
    key: KeyFile = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Write map.html: the literature, with the datasets of the results coloured by their slip.

    Args:
        figures: also write the figure in this format, for papers.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.map import draw_up_map, write_map  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    use_key(key)
    place = out or results
    # Without results of one's own the map is that of the literature; another folder must be there.
    store = Store(place) if place == Path("results") else open_results(place).open_store()
    features = None if shared is None else _read_features(shared)
    drawn = draw_up_map(store, deployments, fed=fed, show=show, shared=features)
    page = write_map(store, drawn, figures)
    content = {
        "deployments": drawn.points.to_dicts(),
        "datasets": drawn.own.to_dicts(),
        "input": drawn.input,
        "measure": vars(drawn.measure),
        "notes": list(drawn.notes),
        "page": str(page),
    }
    lines = [
        f"{row['dataset']:<26}{row['energy']:>9.3g} J   complexity {row['complexity']:.1f}   "
        f"{drawn.measure.name} {_say(row['value'], drawn.measure.unit)}   {row['zone']} risk"
        for row in drawn.own.sort("energy", descending=True).iter_rows(named=True)
    ]
    placed = f"{drawn.points.height} of {drawn.deployments.height} deployments placed"
    fed_words = drawn.input.replace("measured", "measured wheels")
    lines += [f"! {note}" for note in drawn.notes]
    lines.append(f"page    {page}    ({placed}; {drawn.measure.name} on {fed_words})")
    return print_result(content, lambda: lines, json=json, quiet=quiet)


def _say(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g}{'' if unit == '1' else f' {unit}'}"


def add(  # noqa: D417 - arguments document themselves
    entry: Annotated[Path, Parameter(help="TOML file with one deployment: column = value")],
    /,
    *,
    to: Annotated[Path, Parameter(help="table to add it to; made when it is not there")] = _OWN,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Append a deployment to a table, checked against the schema.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.fleet.deployments import add_deployment, write_deployments  # noqa: PLC0415 - heavy

    table = add_deployment(to, entry)
    write_deployments(table, to)
    return _tell(table, to, json=json, quiet=quiet)


def merge(  # noqa: D417 - arguments document themselves
    first: Annotated[Path, Parameter(help="a table of deployments (CSV), or features (Parquet)")],
    second: Annotated[Path, Parameter(help="another")],
    /,
    *,
    to: Annotated[
        Path | None,
        Parameter(help="file to write; may be one of them (default: deployments.csv or features.parquet)"),
    ] = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Merge two tables of deployments, or two files of `slip share`; what stands in both counts once.

    Contradictions are refused, and so is a file that is not what it should be.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    if _are_features(first, second):
        return _merge_features(first, second, to or Path("features.parquet"), json=json, quiet=quiet)
    from pipeline.fleet.deployments import merge_deployments, write_deployments  # noqa: PLC0415 - heavy

    to = to or _OWN
    table = merge_deployments(first, second)
    write_deployments(table, to)
    return _tell(table, to, json=json, quiet=quiet)


def _are_features(*paths: Path) -> bool:
    from pipeline.fleet.features import MAGIC  # noqa: PLC0415 - heavy

    for path in paths:
        if path.is_file():
            with path.open("rb") as file:
                if file.read(len(MAGIC)) == MAGIC:
                    return True
    return False


def _read_features(path: Path) -> pl.DataFrame:
    """As `read_features`, which ends the program where a stranger's file fills the memory."""
    from pipeline.cli.memory_limit import limited_memory  # noqa: PLC0415 - heavy
    from pipeline.fleet.features import read_features  # noqa: PLC0415 - heavy

    with limited_memory(_FEATURES_MEMORY, lambda: str(path), lambda _: None, "Do not trust this file"):
        return read_features(path)


def _merge_features(first: Path, second: Path, to: Path, *, json: bool, quiet: bool) -> int:
    from pipeline.fleet.features import merge_features, write_features  # noqa: PLC0415 - heavy

    merged, twice = merge_features(
        [_read_features(path) for path in (first, second)], f"{first} and {second}"
    )
    write_features(merged, to)
    runs = merged["sha256"].n_unique()
    content = {"file": str(to), "runs": runs, "rows": merged.height, "twice": twice}
    line = f"{to}: {runs} runs, {merged.height} rows, {twice} stood twice"
    return print_result(content, lambda: [line], json=json, quiet=quiet)


def _tell(table: pl.DataFrame, path: Path, *, json: bool, quiet: bool) -> int:
    content = {"table": str(path), "deployments": table.height, "keys": table["key"].to_list()}
    return print_result(content, lambda: [f"{path}: {table.height} deployments"], json=json, quiet=quiet)
