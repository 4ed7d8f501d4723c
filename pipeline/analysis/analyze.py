"""One log through all stages: its results, preview and plan; and stored runs, opened by log or name."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec

from pipeline.analysis import STAGES, Options
from pipeline.analysis.summary import diagnose_work, find_peers, judge_run, list_versions, summarize_run
from pipeline.analysis.work import Progress, Work, hash_model, key_stages
from pipeline.core import (
    FIGURES,
    INPUTS,
    PACKAGE,
    FigureFormat,
    SlipError,
    enumerate_texts,
    mapping_in,
    name_first,
    read_version,
    require_compiler,
    require_package,
)
from pipeline.estimation.stored_diagnosis import has_diagnosis, key_diagnosis
from pipeline.logs import LogError, hash_log, list_files, locate_recorded, spell_location
from pipeline.recording.log_setup import LogSetup, set_up_log
from pipeline.results import RunDiagnosis, find_refusal, read_findings, read_result
from pipeline.sources import list_configuration_files
from pipeline.store import (
    DIAGNOSIS,
    JSON,
    REPORT,
    Generation,
    LogIdentities,
    Manifest,
    Store,
    find_recorded_log,
    find_run,
    hash_json,
    name_run,
    see_log,
    stored_contexts,
    stored_keys,
)
from pipeline.words import format_finding

if TYPE_CHECKING:
    from pipeline.report.scene import RunReport

SUMMARY = "summary.json"


@dataclass(frozen=True)
class Outcome:
    """Result of the analysis of one log.

    Attributes:
        summary: the JSON object of the run; empty when a single stage was run.
        manifest: the current generation.
        computed: stages that were computed; empty when nothing had changed.
        twin: another log of the same content, whose run this one shares; empty if there is none.
        made: what the earlier results of the run were made with, where that was something else; empty if no
            other answer was replaced.
        earlier: folder of the earlier results.
    """

    summary: Mapping[str, JSON]
    manifest: Manifest
    computed: tuple[str, ...]
    twin: str = ""
    made: str = ""
    earlier: Path = Path()

    @property
    def replaced(self) -> str:
        """What the earlier results were made with, and where they are kept; empty without others."""
        return describe_replaced(self.made, self.earlier)

    @property
    def lossy(self) -> bool:
        """Whether the log had losses."""
        return bool(stored_contexts(self.manifest).get("extract", {}).get("losses"))

    @property
    def refusal(self) -> str:
        """Reason why slip is not observable in the log; empty if it is."""
        refusal = find_refusal(read_findings(self.summary))
        return "" if refusal is None else format_finding(refusal)


def _ignore(stage: str) -> None:
    del stage


def analyze_log(path: Path, options: Options, progress: Progress = _ignore) -> Outcome:
    """Run the stages on one log, reusing results that have not changed.

    Args:
        path: the recording.
        options: options of the user.
        progress: callback, called with the name of each stage that is computed.

    Raises:
        SlipError: the log, the configuration or a stage fails; the stored run is then unchanged.
    """
    # Before the work, which would be in vain.
    if options.diagnosis:
        require_compiler(otherwise="leave it out with --no-diagnosis")
    if options.report or options.figures:
        require_package("vl_convert", "", "a report", otherwise="leave it out with --no-report")
    store = Store(options.out)
    setup = set_up_log(path, options)
    # The setup restores addresses that the command line altered.
    path = setup.path
    sha256 = _identify(path, setup, store, progress)
    run = options.run or name_run(path, sha256, store)
    keys = key_stages(run, sha256, setup, options.inputs, hash_model(options.model))
    current = store.manifest(run)
    if current is not None and current.again:
        options = _ask_as_before(options, current)
    twin = _find_twin(path, sha256, current, store)
    if current is not None and not options.force and _is_done(current, keys, options):
        current = store.move_log(current, spell_location(path.resolve())) if twin is None else current
        return Outcome(_read_summary(current, options), current, (), twin or "")
    done = keys[options.through]
    with store.open_generation(run, hash_json([done, options.through])) as generation:
        previous = generation.previous
        if previous is not None and not options.force and _is_done(previous, keys, options):
            # Another process has written the requested results in the meantime.
            return Outcome(_read_summary(previous, options), previous, (), twin or "")
        work = Work(run, setup, options, generation, keys, sha256, progress)
        # Keep no reference, so that the stages can free the columns once the tables exist.
        del setup
        work.run_stages()
        log, verdict = _summarize_log(work.setup, sha256, work), ""
        if options.through == STAGES[-1]:
            diagnosis = diagnose_work(work)
            verdict = judge_run(generation.read_table("findings"), diagnosis)
            _write_outputs(work, log, options, progress, diagnosis, verdict)
        manifest = generation.commit({**_details(work, log, sha256), "verdict": verdict})
    summary, computed = _read_summary(manifest, options), tuple(work.computed)
    if previous is None:
        return Outcome(summary, manifest, computed, twin or "")
    made = _find_difference(previous, manifest)
    return Outcome(summary, manifest, computed, twin or "", made, previous.folder)


def describe_replaced(made: str, earlier: Path) -> str:
    """What earlier results were made with, and where they are kept; empty where they were no others."""
    where = f"they are kept in {spell_location(earlier)} until slip batch --prune --keep 0"
    return made and f"{made}; {where if earlier.exists() else 'they were removed'}"


def _find_difference(before: Manifest, now: Manifest) -> str:
    """What made the earlier results others than those that replace them; empty if nothing did."""
    if before.part("log").get("sha256") != now.part("log").get("sha256"):
        # What else differs may follow from what the log holds.
        made = ["made of what the log held before it changed"]
    else:
        differing = _list_changes(*map(_list_choices, (before, now)))
        made = [f"made with {differing}"] if differing else []
    parts = {"diagnosis": DIAGNOSIS, "report": REPORT, "summary": SUMMARY}
    lost = [name for name, file in parts.items() if file in before.files and file not in now.files]
    made += [f"with a {enumerate_texts(lost)}, which the new ones lack"] if lost else []
    return "; ".join(made)


def _list_choices(manifest: Manifest) -> dict[str, object]:
    """What was chosen for the results of a run."""
    keys = ("configuration", "inputs", "vehicle", "terrain", "dataset")
    model = stored_contexts(manifest).get("slip", {}).get("model")
    return {"model": model, **{key: manifest.details.get(key) for key in keys}}


def _list_changes(before: Mapping[str, object], now: Mapping[str, object]) -> str:
    """Choices that differ, as run.toml spells them: ``use_intervals = recorded (now all)``; or empty.

    What follows from the choices, as a vehicle from its preset, is named where no choice differs.
    """
    chosen = ("configuration", "inputs", "model")
    for keys in (chosen, [key for key in now if key not in chosen]):
        was, is_now = (_flatten({key: each.get(key) for key in keys}) for each in (before, now))
        names = [name for name in {**was, **is_now} if was.get(name) != is_now.get(name)]
        if names:
            return name_first(
                [f"{one} = {_spell(was.get(one))} (now {_spell(is_now.get(one))})" for one in names]
            )
    return ""


def _flatten(content: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Values by dotted names, without the name of the whole configuration."""
    flat: dict[str, object] = {}
    for key, value in content.items():
        name = "" if key == "configuration" else f"{prefix}{key}"
        flat |= _flatten(value, f"{name}." if name else "") if isinstance(value, dict) else {name: value}
    return flat


def _spell(value: object) -> str:
    if isinstance(value, list | tuple):
        return " and ".join(map(_spell, value)) or "none"
    return "not set" if value is None else value if isinstance(value, str) else json.dumps(value)


def _ask_as_before(options: Options, damaged: Manifest) -> Options:
    """Options that recompute everything that the damaged results contained."""
    had = damaged.files
    figures = next((kind for kind in FIGURES if any(name.endswith(f".{kind}") for name in had)), None)
    return replace(
        options,
        force=True,
        report=options.report or REPORT in had,
        diagnosis=options.diagnosis or DIAGNOSIS in had,
        figures=options.figures or figures,
    )


def _find_twin(path: Path, sha256: str, current: Manifest | None, store: Store) -> str | None:
    """Log of the existing results, if it is another file of the same content.

    Empty if it is this log or of another content; None if that file is gone or holds something else by now.
    """
    log = current.part("log") if current is not None else {}
    if log.get("sha256") != sha256:
        return ""
    try:
        recorded = locate_recorded(str(log.get("path")))
        if recorded == path.resolve():
            return ""
        held = LogIdentities(store).lookup(recorded) or hash_log(recorded) if recorded.exists() else None
    except (LogError, OSError):
        return ""
    return str(recorded) if held == sha256 else None


def _identify(path: Path, setup: LogSetup, store: Store, progress: Progress) -> str:
    """Hash of the log, cached or computed while it was read."""
    identities = LogIdentities(store)
    known = identities.lookup(path)
    if known is None:
        progress("read")
        known = setup.choice.take_log().data.sha256
        identities.remember(path, known, seen=see_log(path))
    return known


def _is_done(manifest: Manifest, keys: Mapping[str, str], options: Options) -> bool:
    """Whether the existing results contain everything that is requested."""
    wanted = STAGES[: STAGES.index(options.through) + 1]
    stored = stored_keys(manifest)
    if any(stored.get(stage) != keys[stage] for stage in wanted):
        return False
    if options.through != STAGES[-1]:
        return True
    files = set(manifest.files)
    # What another version wrote is drawn again.
    is_drawn = REPORT in files and manifest.part("versions").get(PACKAGE) == read_version()
    has_report = is_drawn or not options.report
    figures = options.figures
    has_figures = figures is None or any(name.endswith(f".{figures}") for name in files)
    diagnosed = not options.diagnosis or has_diagnosis(manifest, key_diagnosis(keys))
    return SUMMARY in files and has_report and has_figures and diagnosed


def _summarize_log(setup: LogSetup, sha256: str, work: Work) -> dict[str, JSON]:
    losses = work.contexts["extract"].get("losses", [])
    paused_s = cast("float", work.contexts["extract"].get("paused_s", 0.0))
    return {
        "path": spell_location(setup.path.resolve()),
        "sha256": sha256,
        "bytes": setup.index.size_bytes,
        "duration_s": round(setup.index.duration_s - paused_s, 6),
        "complete": not losses,
        "losses": losses,
        "unchecked": work.contexts["extract"].get("unchecked"),
        "fetched_bytes": work.contexts["extract"].get("fetched_bytes"),
    }


def _write_outputs(
    work: Work,
    log: Mapping[str, JSON],
    options: Options,
    progress: Progress,
    diagnosis: RunDiagnosis | None,
    verdict: str,
) -> None:
    """Write summary, report and figures of a finished run."""
    summary = summarize_run(work, log)
    summary["verdict"] = verdict
    summary["diagnosis"] = None
    if diagnosis is not None:
        from pipeline.words import diagnosis_as_json  # noqa: PLC0415 - heavy

        summary["diagnosis"] = diagnosis_as_json(diagnosis)
    summary["report"] = REPORT if options.report else None
    summary["provenance"] = {
        "version": read_version(),
        "versions": list_versions(work),
        "keys": dict(work.keys),
        "configuration": _configuration(work),
    }
    generation = work.generation
    if options.report or options.figures:
        # Importing the plotting code is most of the start-up time: only if needed.
        from pipeline.report import lead_up  # noqa: PLC0415
        from pipeline.report.drive_pages import read_preview  # noqa: PLC0415
        from pipeline.report.motion_view import view_diagnosis  # noqa: PLC0415
        from pipeline.report.page import render_report  # noqa: PLC0415
        from pipeline.report.scene import NOT_DIAGNOSED, RunReport  # noqa: PLC0415

        progress("report")
        tables = {name: generation.read_table(name) for name in generation.table_names}
        motion = view_diagnosis(tables, work.vehicle, diagnosis) if diagnosis else None
        peers = find_peers(Store(options.out), summary)
        planned = read_preview(options.out, work.run, generation.key)
        report = RunReport(
            summary, tables, diagnosis or NOT_DIAGNOSED, motion, peers, lead_up(work.run), planned
        )
        if options.report:
            generation.write_text(REPORT, render_report(report))
        if options.figures:
            _write_figures(report, options.figures, generation)
    generation.write_text(SUMMARY, json.dumps(summary, indent=1, sort_keys=False) + "\n")


def _write_figures(report: RunReport, kind: FigureFormat, generation: Generation) -> None:
    from pipeline.report.page import write_figures  # noqa: PLC0415 - heavy

    with tempfile.TemporaryDirectory() as folder:
        for path in write_figures(report, Path(folder), kind):
            generation.write_bytes(f"figures/{path.name}", path.read_bytes())


def _details(work: Work, log: Mapping[str, JSON], sha256: str) -> dict[str, JSON]:
    stages: dict[str, JSON] = {
        stage: {"key": work.keys[stage], "context": dict(context)} for stage, context in work.contexts.items()
    }
    return {
        "log": {**log, "sha256": sha256},
        "stages": stages,
        "inputs": list(work.options.inputs),
        "configuration": _configuration(work),
        "vehicle": msgspec.to_builtins(work.vehicle),
        "terrain": work.setup.terrain,
        "dataset": work.setup.dataset,
        "versions": cast("JSON", list_versions(work)),
        **({"simulated": True} if work.setup.index.is_simulated else {}),
    }


def _configuration(work: Work) -> JSON:
    plain: JSON = msgspec.to_builtins(work.setup.configuration)
    return plain


def _read_summary(manifest: Manifest, options: Options) -> dict[str, JSON]:
    """The stored summary with the path of the report in this results folder."""
    if SUMMARY not in manifest.files or options.through != STAGES[-1]:
        return {}
    summary = manifest.read_json(SUMMARY)
    read_result(mapping_in(summary, "diagnosis"), RunDiagnosis, manifest.path(SUMMARY))
    has_report = REPORT in manifest.files
    summary["report"] = str(manifest.path(REPORT)) if has_report else None
    return summary


def update_datasets(store: Store) -> None:
    """Write the catalogue, and pool the runs into `datasets.parquet`; logs of equal content count once.

    Columns that only `slip compare` computes are null until it has run.
    """
    from pipeline.datasets import find_material, gather_runs, pool_runs  # noqa: PLC0415 - heavy
    from pipeline.report import CATALOGUE, render_catalogue, write_page  # noqa: PLC0415 - heavy

    write_page(store, CATALOGUE, render_catalogue(store))
    compared = find_material(store, ("dataset",), trusted_only=False, tables=("aggregates",))
    if not compared.manifests and not compared.notes:
        return
    pooled = pool_runs(gather_runs(compared.scan("aggregates").collect(), compared.labels), ("dataset",))
    store.write_results_table("datasets", pooled)


@dataclass(frozen=True)
class OpenedRun:
    """An opened run.

    Attributes:
        manifest: its results.
        lossy: whether the run was opened by its log and the log had losses.
        note: warning that the log's current configuration would give other results; else empty.
    """

    manifest: Manifest
    lossy: bool = False
    note: str = ""


@contextmanager
def open_run(text: str, options: Options, progress: Progress) -> Iterator[OpenedRun]:
    """Open the results of a log or of a stored run; stored results are never changed.

    If complete results exist for the content of a log, they are used as they are. With other options
    (`--vehicle`, `--config`, ...), the log is analyzed again in a temporary folder. A log without results is
    analyzed and stored.

    Args:
        text: name of a run, or path of a log.
        options: options of the user; results always have both inputs.
        progress: callback, called with the name of each stage that is computed.

    Raises:
        SlipError: the log cannot be read, or there is no such run.
    """
    store = Store(options.out)
    path = Path(text)
    chosen = bool(options.overrides) or options.config is not None
    if path.exists():
        stored = _find_stored(path, store)
    else:
        stored = _find_named(text, path, store)
        if stored is not None and not chosen:
            yield OpenedRun(stored)
            return
        hint = f"Other choices than the run's need it: give its path, or ask about {text} without them."
        path = path if stored is None else find_recorded_log(stored, hint=hint)
    if stored is None and options.inputs != INPUTS:
        # Raises the error of a missing input before anything is computed.
        set_up_log(path, options)
    options = replace(options, inputs=INPUTS)
    if stored is None:
        outcome = analyze_log(path, options, progress)
        if outcome.computed:
            update_datasets(store)
        yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    changed = _find_changes(path, stored, options, asked=chosen)
    if changed and chosen:
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            aside = replace(options, out=Path(folder), run=stored.run, report=False, diagnosis=False)
            outcome = analyze_log(path, aside, progress)
            yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    note = f"{stored.run} is read as it was analyzed, with {changed}; slip analyze {text} recomputes it"
    lossy = bool(stored_contexts(stored).get("extract", {}).get("losses"))
    yield OpenedRun(stored, lossy, note if changed else "")


def _find_stored(path: Path, store: Store) -> Manifest | None:
    """The complete results of a log's content; None if there are none."""
    sha256 = LogIdentities(store).lookup(path)
    if sha256 is None:
        size = sum(part.stat().st_size for part in (list_files(path) if path.is_dir() else [path]))
        # Hashing reads the whole log: only if a stored log has the same size.
        if all(manifest.part("log").get("bytes") != size for manifest in store.survey().manifests):
            return None
        sha256 = hash_log(path)
    manifest = store.manifest(name_run(path, sha256, store))
    if manifest is None or manifest.part("log").get("sha256") != sha256 or SUMMARY not in manifest.files:
        return None
    return manifest


def _find_named(text: str, path: Path, store: Store) -> Manifest | None:
    """The results of that name; None if it is the path of a log that does not exist."""
    known = {manifest.run: manifest for manifest in store.survey().manifests}
    if text in known:
        return known[text]
    return None if path.suffix else find_run(text, store)


def _find_changes(path: Path, stored: Manifest, options: Options, *, asked: bool) -> str:
    """What an analysis would now use another of: vehicle or configuration; empty if nothing changed."""
    try:
        setup = set_up_log(path, options)
    except SlipError as error:
        # Without the options of its analysis the log may be insufficient; a file beside it may be wrong.
        if asked or any(str(file) in (error.where or "") for file in list_configuration_files(path)):
            raise
        return ""
    now = {
        "configuration": msgspec.to_builtins(setup.configuration),
        "vehicle": msgspec.to_builtins(setup.vehicle),
        "terrain": setup.terrain,
        "dataset": setup.dataset,
        "inputs": options.inputs,
    }
    return _list_changes(stored.details, json.loads(json.dumps(now)))
