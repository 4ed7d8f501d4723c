"""`slip export`: a run for the viewers people use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from pipeline.cli.output import CLEAN, print_json

_SUFFIXES = {
    "mcap": "_slip.mcap",
    "csv": "_csv",
    "foxglove-layout": "_foxglove.json",
    "plotjuggler-layout": "_plotjuggler.xml",
}


def register(app: App) -> None:
    """Add the verb."""
    app.command(export)


def export(
    run: Annotated[str, Parameter(help="name of a run, or its log")],
    /,
    *,
    to: Literal["mcap", "csv", "foxglove-layout", "plotjuggler-layout"],
    file: Path | None = None,
    model: Path | None = None,
    input: Literal["command", "measured"] | None = None,  # noqa: A002 - the word people use for it
    frame: str = "map",
    out: Path = Path("results"),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Export a run: a derived log that opens beside the original, tables as CSV, layouts for viewers.

    Args:
        run: name of a run, or its log.
        to: what to write.
        file: where; by default beside you, named after the run (a folder for csv).
        model: a model file; its velocity and its predicted path are exported too.
        input: what the model is fed with (default: the command where there is one).
        frame: fixed frame of the log's poses.
        out: results folder.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.job.lookup import find_run  # noqa: PLC0415 - heavy
    from pipeline.motion import read_model  # noqa: PLC0415 - heavy
    from pipeline.report import exports  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    manifest = find_run(run, Store(out))
    chosen = read_model(model).model if model is not None else None
    source = exports.ExportSource(manifest, chosen, input, frame)
    path = file or Path(manifest.run.replace("/", "_") + _SUFFIXES[to])
    if to == "csv":
        written = exports.write_csv(source, path)
    else:
        write = {
            "mcap": exports.write_derived_log,
            "foxglove-layout": exports.write_foxglove_layout,
            "plotjuggler-layout": exports.write_plotjuggler_layout,
        }[to]
        written = [write(source, path)]
    if json:
        print_json({"run": manifest.run, "to": to, "files": [str(each) for each in written]})
    elif not quiet:
        print("\n".join(str(each) for each in written))
    return CLEAN
