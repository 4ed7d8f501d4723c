"""Runs: analyzed, loaded, diagnosed and checked, as objects with the numbers of the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, overload

import polars as pl
from threadpoolctl import threadpool_limits

from pipeline.analysis import Options
from pipeline.analysis.analyze import SUMMARY, analyze_log, update_datasets
from pipeline.analysis.summary import find_peers
from pipeline.api.diagnoses import diagnose_together, parse_budget
from pipeline.api.fitted_model import (
    Model,
    StoredRun,
    tabulate_ladder,
    tabulate_parameters,
    take_file,
    write_html,
)
from pipeline.api.model_changes import contest_models
from pipeline.api.opening import Opener, open_quietly, read_run
from pipeline.batch.recordings import list_named
from pipeline.core import (
    INPUTS,
    SlipError,
    format_recorded,
    mapping_in,
    number_in,
    objects_in,
    require_package,
)
from pipeline.datasets import (
    RunsCheck,
    check_runs,
    read_limits,
)
from pipeline.estimation.stored_diagnosis import find_diagnosis
from pipeline.models import ModelFile, read_model
from pipeline.report import format_distance
from pipeline.report.motion_view import MotionView, view_diagnosis
from pipeline.report.page import ShownFigure, show_figures
from pipeline.report.scene import RunReport
from pipeline.results import ERRORS_OVER_2S, RunDiagnosis, read_result, read_suggestion
from pipeline.results import read_model as read_diagnosed_model
from pipeline.sources import Owner, load_vehicle
from pipeline.store import REPORT, Manifest, Store, find_run, read_choices, to_arrow
from pipeline.words import (
    check_as_json,
    diagnosis_as_json,
    format_junit,
    format_markdown,
    format_verdict,
    list_check_lines,
)
from pipeline.words import diagnosis as words
from schemas import contract_of

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray

    Content = Mapping[str, object]
    Given: TypeAlias = "str | Path | Run | Iterable[str | Path | Run]"


@overload
def analyze(
    log: str | Path,
    *,
    results: str | Path = ...,
    settings: Content | None = ...,
    report: bool = ...,
    diagnosis: bool = ...,
    force: bool = ...,
) -> Run: ...


@overload
def analyze(
    log: list[str | Path],
    *,
    results: str | Path = ...,
    settings: Content | None = ...,
    report: bool = ...,
    diagnosis: bool = ...,
    force: bool = ...,
) -> list[Run]: ...


def analyze(
    log: str | Path | list[str | Path],
    *,
    results: str | Path = "results",
    settings: Content | None = None,
    report: bool = True,
    diagnosis: bool = True,
    force: bool = False,
) -> Run | list[Run]:
    """Analyze a log, or several, as `slip analyze` does; what has not changed is not computed again.

    Args:
        log: an MCAP file, or a folder of a split recording; a list of them gives a list of runs.
        results: folder of results.
        settings: what a `run.toml` would say, for example ``{"vehicle": {"preset": "husky_a200"}}``.
        report: write `report.html`.
        diagnosis: identify the effects that the model lacks.
        force: compute again what is there.
    """
    options = Options(
        out=Path(results), overrides=settings or {}, report=report, diagnosis=diagnosis, force=force
    )
    store = Store(options.out)
    with threadpool_limits(1):
        outcomes = [analyze_log(Path(one), options) for one in (log if isinstance(log, list) else [log])]
    if any(outcome.computed for outcome in outcomes):
        update_datasets(store)
    runs = [Run(outcome.manifest, store) for outcome in outcomes]
    return runs if isinstance(log, list) else runs[0]


def load(run: str, *, results: str | Path = "results") -> Run:
    """A run that is analyzed already, by its name or the path of its log."""
    store = Store(Path(results))
    return Run(find_run(run, store), store)


def table(name: str, *, results: str | Path = "results") -> pl.LazyFrame:
    """A table over all runs of a results folder; of the table ``runs`` each row is one."""
    return Store(Path(results)).scan(name)


class Run(StoredRun):
    """An analyzed log.

    Attributes:
        name: of the run, unique in its results folder.
        summary: the JSON object of `slip analyze --json`.
        verdict: one to three sentences for people; empty where it was not diagnosed.
        vehicle: the vehicle it was analyzed with.
        duration_s: what was driven and compared [s]; None where nothing was.
        distance_m: way of the body [m]; None where nothing was compared.
        findings: what was noticed: id, severity, text, where, t_start and t_end [s]; gravest first.
        report: the offline page; None where it was not asked for.
        tables: names of its tables; the page Tables of the handbook tells units and frames.
    """

    def __init__(self, manifest: Manifest, store: Store) -> None:
        super().__init__(manifest, store)
        self.name = manifest.run
        self.summary: Content = manifest.read_json(SUMMARY)
        self.verdict = str(self.summary.get("verdict") or "")
        # One of `slip diagnose` is beside the results of the analysis.
        if not self.verdict and (stored := find_diagnosis(store.root, manifest)) is not None:
            self.verdict = format_verdict(stored)
        self.vehicle = load_vehicle(manifest)
        self.duration_s = number_in(self.summary, "duration_s")
        self.distance_m = number_in(self.summary, "distance_m")
        self.findings = objects_in(self.summary, "findings")
        self.report = manifest.path(REPORT) if REPORT in manifest.files else None
        self.tables = tuple(sorted(manifest.tables))

    def to_xarray(self) -> xarray.Dataset:
        """`slip` as an ``xarray.Dataset``: a variable a column, over ``input`` and ``t``, with units.

        Raises:
            SlipError: ``no_xarray``, xarray is not installed.
        """
        try:
            import xarray  # noqa: PLC0415 - not among the dependencies
        except ImportError as error:
            what = "xarray is not installed"
            hint = "Install xarray, or use `slip`, the same as a table of Polars."
            raise SlipError("no_xarray", what, where=self.name, hint=hint) from error
        slip, contract = self.slip.collect(), contract_of("slip")
        inputs, times = slip["input"].unique(maintain_order=True), slip.select(pl.col("t").unique().sort())
        parts = [times.join(slip.filter(pl.col("input") == one), on="t", how="left") for one in inputs]
        numbers = [name for name in slip.columns if name != "t" and slip[name].dtype.is_float()]
        return xarray.Dataset(
            {
                name: (
                    ("input", "t"),
                    [part[name].to_numpy() for part in parts],
                    contract.metadata_of(name),
                )
                for name in numbers
            },
            {"input": inputs.to_list(), "t": ("t", times["t"].to_numpy(), contract.metadata_of("t"))},
            {"run": self.name},
        )

    def to_arrow(self, table: str = "slip") -> pa.Table:
        """A table as a ``pyarrow.Table`` whose fields have ``unit``, ``frame`` and ``description``.

        Args:
            table: one of `tables`.
        """
        return to_arrow(contract_of(table), self.manifest.read(table))

    def to_pandas(self, table: str = "slip") -> pd.DataFrame:
        """A table as a frame of pandas.

        Args:
            table: one of `tables`.

        Raises:
            SlipError: ``no_pandas``, the extra ``pandas`` is not installed.
        """
        require_package("pandas", "pandas", "a frame of pandas", otherwise="use `to_arrow`")
        return self.manifest.read(table).to_pandas()

    def plot(self, figure: str = "trajectory", *, model: Model | None = None) -> ShownFigure:
        """One figure of its report, which a notebook shows.

        Args:
            figure: its id, one of `figures`, or the beginning of one: `path` is the measured path and where
                the model goes, over the half minute in which the ideal model is worst.
            model: a model to draw, with its values as they are, in place of the one that was diagnosed.

        Raises:
            SlipError: ``no_figure``, the report of this run has none of that id.
        """
        figures = self.figures(model=model)
        chosen = (
            figure if figure in figures else next((name for name in figures if name.startswith(figure)), "")
        )
        if not chosen:
            what = f"the report has no figure {figure!r}"
            raise SlipError("no_figure", what, where=self.name, hint=f"It has {', '.join(figures)}.")
        return figures[chosen]

    def figures(self, *, model: Model | None = None) -> dict[str, ShownFigure]:
        """The figures of its report by id; with a model, those of the model and of the data."""
        if model is None:
            return self._draw(self._read_diagnosis())
        take_file(model)
        return self._draw(RunDiagnosis(), model.view(self))

    def diagnose(
        self,
        *others: Run,
        input: Literal["command", "measured", "both"] = "both",
        model: Model | None = None,
        vehicle_of: Owner | None = None,
        budget: str | None = None,
    ) -> Diagnosis:
        """Name what is missing from the model, as `slip diagnose` does.

        Args:
            others: runs of the same vehicle, to be judged together with it.
            input: `command` or `measured`; of both the command leads.
            model: model that is known: only effects beyond it are estimated.
            vehicle_of: whose geometry counts where the run is of another vehicle than the model.
            budget: CPU time that a search may take, for example ``60s``.
        """
        with threadpool_limits(1):
            diagnosis = diagnose_together(
                [read_run(run.manifest) for run in (self, *others)],
                self._store.root,
                inputs=INPUTS if input == "both" else (input,),
                known=None if model is None else take_file(model),
                owner=vehicle_of,
                budget_s=None if budget is None else parse_budget(budget),
            )[0]
        return Diagnosis(diagnosis, read_choices(self.manifest), lambda: self._draw(diagnosis))

    def compare_models(
        self,
        models: Mapping[str, Model] | None = None,
        *,
        input: Literal["command", "measured"] | None = None,
        vehicle_of: Owner | None = None,
    ) -> pl.DataFrame:
        """Fit models and those of the literature to the run, and score them on data not seen.

        Args:
            models: models of one's own by name.
            input: what they are fed with; None as at the models' last fit, else as their effects need it.
            vehicle_of: whose geometry counts where the run is of another vehicle than the models.

        Returns:
            A row a model: ``model numbers t_mrmse_m r_mrmse_rad t_is_best r_is_best fit_s``. The best is the
            smallest error, and what is larger by no more than chance.
        """
        files = {name: take_file(model) for name, model in (models or {}).items()}
        with threadpool_limits(1):
            compared, _ = contest_models(files, [self.manifest], source=input, owner=vehicle_of)
        contest = compared.contest
        return pl.DataFrame(
            [
                {
                    "model": rival.name,
                    "numbers": rival.numbers,
                    **{metric: rival.read(metric) for metric in ERRORS_OVER_2S},
                    **{f"{metric[0]}_is_best": contest.is_best(rival, metric) for metric in ERRORS_OVER_2S},
                    "fit_s": rival.fit_s,
                }
                for rival in contest.rivals
            ]
        )

    def _read_diagnosis(self) -> RunDiagnosis:
        content = mapping_in(self.summary, "diagnosis")
        return read_result(content, RunDiagnosis, self.manifest.path(SUMMARY))

    def _draw(self, diagnosis: RunDiagnosis, motion: MotionView | None = None) -> dict[str, ShownFigure]:
        tables = {name: self.manifest.read(name) for name in self.tables}
        motion = motion or view_diagnosis(tables, self.vehicle, diagnosis)
        peers = find_peers(self._store, dict(self.manifest.read_json(SUMMARY)))
        return show_figures(RunReport(self.summary, tables, diagnosis, motion, peers))

    def __repr__(self) -> str:
        log = mapping_in(self.summary, "log")
        facts = [self.name, self.vehicle.name, str(self.summary["terrain"])]
        duration, distance = number_in(log, "duration_s"), self.distance_m
        facts += [] if duration is None else [format_recorded(duration, self.duration_s)]
        facts += [] if distance is None else [format_distance(distance)]
        return ", ".join(facts if log.get("complete") else [*facts, "the log has losses"])

    def _repr_html_(self) -> str:
        slip = mapping_in(self.summary, "by_input")
        keys = {"median slip modulus [m/s]": "median_modulus", "2 s window norm": "median_window_norm"}
        rows = [
            {"slip on": name, **{head: number_in(mapping_in(slip, name), key) for head, key in keys.items()}}
            for name in slip
        ]
        notes = [self.verdict] if self.verdict else []
        notes += [f"! {one['text']}" for one in self.findings if one.get("severity") != "info"]
        notes += [] if self.report is None else [f"report: {self.report}"]
        return write_html(repr(self), pl.DataFrame(rows), notes)


class Diagnosis:
    """The effects that the ideal model of a run lacks. As text it is what `slip diagnose` prints.

    Attributes:
        verdict: one to three sentences for people.
        effects: one row each: ``effect sentence``.
        parameters: their numbers: ``parameter value low high unit doubt run``, a 95 % interval; one row a
            run where runs have their own.
        ladder: held-out errors over 2 s, effect by effect: ``added t_mrmse_m r_mrmse_rad explained_share``.
        model: the model with these effects; None where nothing could be judged.
        suggestion: a formula as an effect, for what no effect explains; None without one.
    """

    def __init__(
        self, diagnosis: RunDiagnosis, choices: Content, draw: Callable[[], dict[str, ShownFigure]]
    ) -> None:
        self._diagnosis, self._choices, self._draw = diagnosis, choices, draw
        self._lines = words.list_lines(diagnosis)
        content = self.to_json()
        self.verdict = str(content["verdict"])
        effects = {str(one["id"]): one for one in objects_in(content, "effects")}
        self.effects = pl.DataFrame(
            {
                "effect": list(effects),
                "sentence": [str(one["sentence"]) for one in effects.values()],
            },
            schema={"effect": pl.String, "sentence": pl.String},
        )
        self.parameters = tabulate_parameters(
            {
                f"{one.id}.{name}": number
                for one in diagnosis.effects
                for name, number in one.parameters.items()
            },
            diagnosis.list_own(),
        )
        self.ladder = tabulate_ladder(content)
        file = read_diagnosed_model(diagnosis)
        self.model = None if file is None else Model.of(file)
        vehicle = diagnosis.vehicle
        self.suggestion = None if vehicle is None else next(iter(read_suggestion(diagnosis, vehicle)), None)

    def to_json(self) -> dict[str, object]:
        """The object of one run of `slip diagnose --json`."""
        return {**diagnosis_as_json(self._diagnosis), **self._choices}

    def figures(self) -> dict[str, ShownFigure]:
        """The figures of the run with the model that was named, by id: ladder, residuals, budget, ..."""
        return self._draw()

    def __repr__(self) -> str:
        return "\n".join(words.format_lines(self._lines))

    def _repr_html_(self) -> str:
        sentences = dict(self.effects.select("effect", "sentence").iter_rows())
        texts = [sentences[label.partition(".")[0]] for label in self.parameters["parameter"]]
        notes, part = [self.verdict], ""
        for label, text in self._lines:
            part = label or part
            if part in {"remaining", "findings"}:
                notes.append(f"{part}: {text}")
        title = f"{self._diagnosis.run}: {', '.join(self.effects['effect']) or 'no significant effect'}"
        return write_html(
            title, self.parameters.with_columns(sentence=pl.Series(texts, dtype=pl.String)), notes
        )


_TEXTS = ("number", "unit", "status", "change_is")
_NUMBERS = (
    "before",
    "after",
    "difference",
    "low",
    "high",
    "spread",
    "freedom",
    "p",
    "p_adjusted",
    "smallest",
)
_COLUMNS = {**dict.fromkeys(_TEXTS, pl.String), **dict.fromkeys(_NUMBERS, pl.Float64)}


def check(
    before: Given | Model,
    after: Given,
    *,
    results: str | Path = "results",
    limits: str | Path | None = None,
    simulated: bool = False,
    input: Literal["command", "measured"] | None = None,
    vehicle_of: Owner | None = None,
    opened: Opener = open_quietly,
) -> Check:
    """Check what changed between two drives, by cause, as `slip check` does.

    Args:
        before: runs, logs, folders of logs, or a list of them; a model or its file.
        after: runs, logs, folders of logs, or a list of them.
        results: folder of results, where logs are analyzed once.
        limits: file of limits.
        simulated: BEFORE is a simulation, whose runs do not differ.
        input: `command` or `measured`; None chooses.
        vehicle_of: geometry to use where vehicles differ.
        opened: how logs and runs are opened, for example with progress.
    """
    bounds = None if limits is None else read_limits(Path(limits))
    store = Store(Path(results))
    known = _open_known(before)
    with threadpool_limits(1):
        first = _open_runs(before, store, opened, diagnosed=True) if known is None else known
        second = _open_runs(after, store, opened, diagnosed=known is None)
        checked = check_runs(
            first, second, store, source=input, owner=vehicle_of, limits=bounds, simulated=simulated
        )
    return Check(checked)


def _open_known(given: object) -> ModelFile | None:
    if isinstance(given, Model):
        return given.file
    path = Path(given) if isinstance(given, str | Path) else Path()
    return read_model(path) if path.suffix == ".toml" else None


def _open_runs(given: object, store: Store, opened: Opener, *, diagnosed: bool) -> list[Manifest]:
    if isinstance(given, Run):
        return [given.manifest]
    if not isinstance(given, str | Path):
        if not isinstance(given, list | tuple):
            raise SlipError(
                "no_runs", f"{given!r} is not a run", hint="Give a run, a path, or a list of them."
            )
        listed = [
            manifest for one in given for manifest in _open_runs(one, store, opened, diagnosed=diagnosed)
        ]
        return list({manifest.run: manifest for manifest in listed}.values())
    manifests = []
    options = Options(out=store.root, report=False, diagnosis=diagnosed)
    for name in list_named(str(given)):
        with opened(name, options) as one:
            manifests.append(one.manifest)
    return list({one.run: one for one in manifests}.values())


class Check:
    """What changed between two drives. As text it is what `slip check` prints.

    Attributes:
        verdict: what changed, and whether it is more than runs differ anyway.
        numbers: one row each: ``number unit status change_is before after difference low high spread freedom
            p p_adjusted smallest``; status is ``changed``, ``differs``, ``not shown``, ``unchanged`` or
            ``unknown``.
        limits: one row each: ``name limit measured outcome``.
        code: 0 kept, 4 changed or broken, 3 undetermined.
    """

    def __init__(self, checked: RunsCheck) -> None:
        self._checked = checked
        content = check_as_json(checked)
        self.verdict, self.code = str(content["verdict"]), checked.code
        rows = [{key: row[key] for key in _COLUMNS} for row in objects_in(content, "numbers")]
        self.numbers = pl.DataFrame(rows, schema=_COLUMNS)
        names = ("name", "limit", "measured", "outcome")
        limits = [dict(row) for row in objects_in(content, "limits")]
        self.limits = pl.DataFrame(limits, schema=dict.fromkeys(names, pl.String))

    def to_json(self) -> dict[str, object]:
        """The object of `slip check --json`."""
        return check_as_json(self._checked)

    def to_markdown(self) -> str:
        """The text of `slip check --to markdown`."""
        return format_markdown(self._checked)

    def to_junit(self) -> str:
        """The text of `slip check --to junit`."""
        return format_junit(self._checked)

    def to_html(self) -> str:
        """The page of `slip check --to html`."""
        from pipeline.report.datasets_page import render_check  # noqa: PLC0415 - only for this format

        return render_check(self._checked)

    def __repr__(self) -> str:
        return "\n".join(words.format_lines(list_check_lines(self._checked)))

    def _repr_html_(self) -> str:
        shown = self.numbers.select("number", "unit", "status", "before", "after", "spread", "p_adjusted")
        return write_html(self.verdict, shown, list(self._checked.sides.notes))
