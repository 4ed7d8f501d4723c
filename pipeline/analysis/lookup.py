"""From what a user types, a log or a run, to the log or the results."""

from pathlib import Path

from pipeline.analysis.errors import JobError
from pipeline.logs import RemotePath, locate_recorded, spell_location, to_location
from pipeline.store import Manifest, Store


def find_run(text: str, store: Store) -> Manifest:
    """The current results of a run, by its name, its stem, or the path of its log.

    Raises:
        JobError: nothing fits, or several runs do.
    """
    manifests = store.survey().manifests
    path = spell_location(Path(text).resolve())
    fitting = [
        manifest
        for manifest in manifests
        if text in {manifest.run, manifest.run.rsplit("/", 1)[-1]} or recorded_path(manifest) == path
    ]
    if len(fitting) == 1:
        return fitting[0]
    names = ", ".join(manifest.run for manifest in (fitting or manifests)) or "none yet"
    what = f"several runs are called {text!r}" if fitting else f"there is no run {text!r}"
    raise JobError("no_such_run", what, where=str(store.root), hint=f"Say which of: {names}.")


def find_log(text: str, out: Path) -> Path:
    """The log that a user means: a path, or the name of a run that has results.

    Raises:
        JobError: neither fits, or the run's log has gone.
        LogError: as of `find_recorded_log`.
    """
    path = to_location(text)
    if isinstance(path, RemotePath) or path.exists() or path.suffix:
        return path
    return find_recorded_log(find_run(text, Store(out)), hint="Give the path it has now.")


def find_recorded_log(manifest: Manifest, *, hint: str) -> Path:
    """The log that a run was made of.

    Args:
        manifest: the run's.
        hint: what to do where it has gone.

    Raises:
        JobError: ``log_gone``.
        LogError: ``remote_not_followed``, ``no_object_store``.
    """
    log = locate_recorded(recorded_path(manifest))
    if not log.exists():
        raise JobError("log_gone", "the log of this run is not there any more", where=str(log), hint=hint)
    return log


def recorded_path(manifest: Manifest) -> str:
    """Path of the log that a run was made of."""
    return str(manifest.part("log").get("path", ""))
