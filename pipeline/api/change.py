"""Checks: what changed between two drives, as `slip check` says it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import polars as pl
from threadpoolctl import threadpool_limits

from pipeline.api.fitted_model import Model, write_html
from pipeline.api.run import Run
from pipeline.batch.recordings import list_named
from pipeline.core.program import SlipError
from pipeline.estimation.diagnosis_lines import format_lines
from pipeline.job.check import check_as_json, check_runs, keep_baseline
from pipeline.job.check_limits import read_limits
from pipeline.job.check_sides import Baseline, read_baseline
from pipeline.job.check_text import format_junit, format_markdown, list_lines
from pipeline.job.options import Options
from pipeline.job.stored import open_run
from pipeline.models.model_file import ModelFile, read_model
from pipeline.report.scene import objects_in
from pipeline.store import Manifest, Store

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pipeline.job.check import Check as RunsCheck
    from pipeline.job.keys import Owner

    Given = str | Path | Run | Iterable[str | Path | Run]

_COLUMNS = {
    **dict.fromkeys(("number", "unit", "status"), pl.String),
    **dict.fromkeys(("before", "after", "low", "high", "p", "p_within_runs", "smallest_found"), pl.Float64),
    "more_runs_a_side": pl.Int64,
}


def check(
    before: Given | Model,
    after: Given,
    *,
    results: str | Path = "results",
    limits: str | Path | None = None,
    simulated: bool = False,
    input: Literal["command", "measured"] | None = None,
    vehicle_of: Owner | None = None,
) -> Check:
    """Check what changed between two drives, by cause, as `slip check` does.

    Args:
        before: runs, logs, folders of logs, or a list of them; a model or its file; a baseline.
        after: runs, logs, folders of logs, or a list of them.
        results: folder of results, where logs are analyzed once.
        limits: file of limits.
        simulated: BEFORE is a simulation: what runs differ by anyway does not count.
        input: what the model is fed with; None chooses.
        vehicle_of: whose geometry counts where vehicles differ.
    """
    bounds = None if limits is None else read_limits(Path(limits))
    store = Store(Path(results))
    known = _open_known(before)
    with threadpool_limits(1):
        first = _open_runs(before, store, diagnosed=True) if known is None else known
        second = _open_runs(after, store, diagnosed=known is None)
        checked = check_runs(
            first, second, store, source=input, owner=vehicle_of, limits=bounds, simulated=simulated
        )
    return Check(checked)


def _open_known(given: object) -> ModelFile | Baseline | None:
    if isinstance(given, Model):
        return given.file
    path = Path(given) if isinstance(given, str | Path) else Path()
    if path.suffix == ".toml":
        return read_model(path)
    return read_baseline(path) if path.suffix == ".json" else None


def _open_runs(given: object, store: Store, *, diagnosed: bool) -> list[Manifest]:
    if isinstance(given, Run):
        return [given.manifest]
    if not isinstance(given, str | Path):
        if not isinstance(given, list | tuple):
            raise SlipError(
                "no_runs", f"{given!r} is not a run", hint="Give a run, a path, or a list of them."
            )
        listed = [manifest for one in given for manifest in _open_runs(one, store, diagnosed=diagnosed)]
        return list({manifest.run: manifest for manifest in listed}.values())
    manifests = []
    options = Options(out=store.root, report=False, diagnosis=diagnosed)
    for name in list_named(str(given)):
        with open_run(name, options, lambda _stage: None) as opened:
            manifests.append(opened.manifest)
    return manifests


class Check:
    """What changed between two drives. As text it is what `slip check` prints.

    Attributes:
        verdict: what changed, and whether it is more than runs differ anyway.
        numbers: one row each: ``number unit status before after low high p p_within_runs smallest_found
            more_runs_a_side``; status is ``changed``, ``differs``, ``unchanged`` or ``unknown``.
        limits: one row each: ``name limit measured outcome``.
        code: 0 kept, 4 changed or broken, 3 cannot tell.
    """

    def __init__(self, checked: RunsCheck) -> None:
        self._checked, self._lines = checked, list_lines(checked)
        content = check_as_json(checked, self._lines)
        self.verdict, self.code = self._lines[0][1], checked.code
        rows = [{key: row[key] for key in _COLUMNS} for row in objects_in(content, "numbers")]
        self.numbers = pl.DataFrame(rows, schema=_COLUMNS)
        names = ("name", "limit", "measured", "outcome")
        limits = [dict(row) for row in objects_in(content, "limits")]
        self.limits = pl.DataFrame(limits, schema=dict.fromkeys(names, pl.String))

    def to_json(self) -> dict[str, object]:
        """The object of `slip check --json`."""
        return check_as_json(self._checked, self._lines)

    def to_markdown(self) -> str:
        """The text of `slip check --to markdown`."""
        return format_markdown(self._checked)

    def to_junit(self) -> str:
        """The text of `slip check --to junit`."""
        return format_junit(self._checked)

    def keep(self, path: str | Path) -> None:
        """Write AFTER as a baseline that later runs are checked against, as `slip check --keep` does."""
        keep_baseline(self._checked, Path(path))

    def __repr__(self) -> str:
        return "\n".join(format_lines(self._lines))

    def _repr_html_(self) -> str:
        shown = self.numbers.select("number", "unit", "status", "before", "after", "p")
        return write_html(self.verdict, shown, [text for label, text in self._lines if label == "note"])
