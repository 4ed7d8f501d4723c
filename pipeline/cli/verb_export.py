"""`slip export`: a run for the viewers people use."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from pipeline.cli.model_trust import TrustCode, open_model
from pipeline.cli.output import print_result
from pipeline.core.paths import resolve_inside

if TYPE_CHECKING:
    from pipeline.models import Model
    from pipeline.store import Manifest

_SUFFIXES = {
    "mcap": "_slip.mcap",
    "csv": "_csv",
    "foxglove-layout": "_foxglove.json",
    "plotjuggler-layout": "_plotjuggler.xml",
}


def export(
    run: Annotated[str, Parameter(help="name of a run, or its log")],
    /,
    *,
    to: Literal["mcap", "csv", "foxglove-layout", "plotjuggler-layout"],
    file: Path | None = None,
    model: Path | None = None,
    input: Literal["command", "measured"] | None = None,  # noqa: A002 - the word people use for it
    frame: str = "map",
    trust_code: TrustCode = False,
    out: Path = Path("results"),
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Export a run: a derived log that opens beside the original, tables as CSV, layouts for viewers.

    Args:
        run: name of a run, or its log.
        to: what to write.
        file: where; by default beside you, named after the run (a folder for csv).
        model: a model file whose velocity and predicted path are exported too (default: what was diagnosed).
        input: what the model is fed with (default: the command where there is one).
        frame: fixed frame of the log's poses.
        trust_code: trust the Python that the model file names, now and later.
        out: results folder.
        json: print one JSON object.
        quiet: print nothing.
    """
    from pipeline.analysis.lookup import find_run  # noqa: PLC0415 - heavy
    from pipeline.report.exports import layouts  # noqa: PLC0415
    from pipeline.report.exports.csv import write_csv  # noqa: PLC0415 - heavy
    from pipeline.report.exports.derived import write_derived_log  # noqa: PLC0415
    from pipeline.report.exports.source import ExportSource  # noqa: PLC0415
    from pipeline.store import Store  # noqa: PLC0415 - heavy

    manifest = find_run(run, Store(out))
    known = None if model is None else open_model(model, trust_code=trust_code)
    chosen, named_on = _find_named(manifest) if known is None else (known.model, None)
    source = ExportSource(manifest, chosen, input or named_on, frame)
    path = file or resolve_inside(Path(), manifest.run.replace("/", "_") + _SUFFIXES[to])
    if to == "csv":
        written = write_csv(source, path)
    else:
        write = {
            "mcap": write_derived_log,
            "foxglove-layout": layouts.write_foxglove_layout,
            "plotjuggler-layout": layouts.write_plotjuggler_layout,
        }[to]
        written = [write(source, path)]
    files = [str(each) for each in written]
    left_out = {"warnings": list(known.warnings)} if known is not None and known.warnings else {}
    content = {"run": manifest.run, "to": to, "files": files, **left_out}
    return print_result(content, lambda: files, json=json, quiet=quiet)


def _find_named(manifest: Manifest) -> tuple[Model | None, str | None]:
    """The model that the run's diagnosis named, and what it is fed with; None where there is none."""
    from pipeline.analysis.diagnosis import DIAGNOSIS  # noqa: PLC0415 - heavy
    from pipeline.report.diagnosed import read_model_text  # noqa: PLC0415 - heavy

    if DIAGNOSIS not in manifest.files:
        return None, None
    diagnosis = manifest.read_json(DIAGNOSIS)
    named_on = diagnosis.get("input")
    usable = named_on if named_on in {"command", "measured"} else None
    file = read_model_text(diagnosis)
    return (None if file is None else file.model), usable
