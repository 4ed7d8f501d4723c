"""`slip share`: features of deployments, for a database of many."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from pipeline.cli.output import print_result


def share(  # noqa: D417 - arguments document themselves
    results: Annotated[Path, Parameter(help="results folder")] = Path("results"),
    /,
    *,
    to: Annotated[Path, Parameter(help="file to write")] = Path("features.parquet"),
    out: Annotated[Path | None, Parameter(help="the same as RESULTS")] = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Write features of every run to one file that may be given away: no data, no names of files, no places.

    `slip map merge` puts such files together, `slip map --shared` draws them.

    Args:
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.share import gather_features  # noqa: PLC0415 - heavy
    from pipeline.fleet.features import write_features  # noqa: PLC0415 - heavy
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    features, notes = gather_features(Store(out or results))
    write_features(features, to)
    runs = features["sha256"].n_unique()
    content = {"file": str(to), "runs": runs, "rows": features.height, "notes": list(notes)}
    lines = [f"{to}: {runs} runs, {features.height} rows", *(f"! {note}" for note in notes)]
    return print_result(content, lambda: lines, json=json, quiet=quiet)
