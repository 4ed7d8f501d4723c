"""Runs for verbs that read: results that are there are read as they are, a new log is analyzed once."""

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from pipeline.analysis.analyze import SUMMARY, analyze_log, update_datasets
from pipeline.analysis.log_setup import name_run, set_up_log
from pipeline.analysis.lookup import find_recorded_log, find_run
from pipeline.analysis.options import INPUTS, Options
from pipeline.analysis.work import Progress, stored_contexts
from pipeline.core.errors import SlipError
from pipeline.logs import hash_log, list_files
from pipeline.store import LogIdentities, Manifest, Store


@dataclass(frozen=True)
class OpenedRun:
    """A run to read.

    Attributes:
        manifest: its results.
        lossy: whether a log was asked for and had losses.
        note: that the log's configuration would give other results than those stored; else empty.
    """

    manifest: Manifest
    lossy: bool = False
    note: str = ""


@contextmanager
def open_run(text: str, options: Options, progress: Progress) -> Iterator[OpenedRun]:
    """The results of a log or of a stored run; what is stored is never changed.

    A log whose content has complete results is read from there, as it was analyzed. Where the user chose
    otherwise (`--vehicle`, `--config`, ...), it is analyzed anew in a folder that is gone afterwards. A log
    without results is analyzed and stored.

    Args:
        text: name of a run, or path of a log.
        options: what the user chose; results have both inputs, whichever is asked about.
        progress: told the name of each stage that is computed.

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
        # Only to complain before anything is computed where the log lacks the input.
        set_up_log(path, options)
    options = replace(options, inputs=INPUTS)
    if stored is None:
        outcome = analyze_log(path, options, progress)
        if outcome.computed:
            update_datasets(store)
        yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    changed = _is_changed(path, stored, options, asked=chosen)
    if changed and chosen:
        with tempfile.TemporaryDirectory(prefix="slip-") as folder:
            aside = replace(options, out=Path(folder), run=stored.run, report=False, diagnosis=False)
            outcome = analyze_log(path, aside, progress)
            yield OpenedRun(outcome.manifest, outcome.lossy)
        return
    note = (
        f"{stored.run} is read as it was analyzed, with another configuration than its log has now; "
        f"slip analyze {text} makes the results anew"
    )
    lossy = bool(stored_contexts(stored).get("extract", {}).get("losses"))
    yield OpenedRun(stored, lossy, note if changed else "")


def _find_stored(path: Path, store: Store) -> Manifest | None:
    """The complete results of a log's content; None where there are none."""
    sha256 = LogIdentities(store).lookup(path)
    if sha256 is None:
        size = sum(part.stat().st_size for part in (list_files(path) if path.is_dir() else [path]))
        # Hashing reads the whole log: only for one that may be known.
        if all(manifest.part("log").get("bytes") != size for manifest in store.survey().manifests):
            return None
        sha256 = hash_log(path)
    manifest = store.manifest(name_run(path, sha256, store))
    if manifest is None or manifest.part("log").get("sha256") != sha256 or SUMMARY not in manifest.files:
        return None
    return manifest


def _find_named(text: str, path: Path, store: Store) -> Manifest | None:
    """The results of that name; None where it is the path of a log that is not there."""
    known = {manifest.run: manifest for manifest in store.survey().manifests}
    if text in known:
        return known[text]
    return None if path.suffix else find_run(text, store)


def _is_changed(path: Path, stored: Manifest, options: Options, *, asked: bool) -> bool:
    """Whether an analysis would be of another vehicle or configuration now."""
    try:
        setup = set_up_log(path, options)
    except SlipError:
        if asked:
            raise
        # The log alone does not say what was said when it was analyzed.
        return False
    now = {
        "configuration": msgspec.to_builtins(setup.configuration),
        "vehicle": msgspec.to_builtins(setup.vehicle),
        "terrain": setup.terrain,
        "dataset": setup.dataset,
        "inputs": options.inputs,
    }
    return any(stored.details.get(key) != value for key, value in json.loads(json.dumps(now)).items())
