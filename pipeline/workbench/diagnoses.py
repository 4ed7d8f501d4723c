"""What a diagnosis says of a run: kept with its results, or beside them where it was asked for here.

It works for many seconds at full power, so it runs in a process of its own and the page stays quick.
"""

from __future__ import annotations

import json
import subprocess
from typing import TYPE_CHECKING

from pipeline.core.interpreter import slip_command
from pipeline.job.diagnosis import DIAGNOSIS
from pipeline.store.files import make_folder, replace_file
from pipeline.store.names import encode_run
from pipeline.workbench.desk import FOLDER
from pipeline.workbench.errors import WorkbenchError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from pipeline.store import Manifest

_LONGEST_S = 1800.0


def read_diagnosis(results: Path, manifest: Manifest) -> Mapping[str, object] | None:
    """What is known of a run's missing effects; None where nobody has asked yet."""
    if DIAGNOSIS in manifest.files:
        content = json.loads(manifest.path(DIAGNOSIS).read_text(encoding="utf-8"))
        return content if isinstance(content, dict) else None
    try:
        kept = json.loads(_path_of(results, manifest).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    found = kept.get("diagnosis") if isinstance(kept, dict) and kept.get("key") == manifest.key else None
    return found if isinstance(found, dict) else None


def write_diagnosis(results: Path, manifest: Manifest) -> None:
    """Diagnose a stored run and keep what comes of it beside the results.

    Raises:
        WorkbenchError: ``diagnosis_failed``.
    """
    command = slip_command("diagnose", "--out", str(results.resolve()), "--json")
    try:
        done = subprocess.run(  # noqa: S603 - our own program, its words as separate arguments
            [*command, "--", manifest.run],
            capture_output=True,
            text=True,
            check=False,
            timeout=_LONGEST_S,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise _failed(manifest, str(error)) from error
    try:
        (found,) = json.loads(done.stdout)["runs"]
    except (ValueError, KeyError, TypeError) as error:
        told = done.stderr.strip().splitlines()
        raise _failed(manifest, told[-1] if told else "it ended without an answer") from error
    path = _path_of(results, manifest)
    make_folder(path.parent)
    replace_file(path, json.dumps({"key": manifest.key, "diagnosis": found}).encode())


def _path_of(results: Path, manifest: Manifest) -> Path:
    place = encode_run(manifest.run)
    return results / FOLDER / "diagnoses" / place.with_name(f"{place.name}.json")


def _failed(manifest: Manifest, why: str) -> WorkbenchError:
    return WorkbenchError(
        "diagnosis_failed",
        f"the diagnosis failed: {why}",
        where=manifest.run,
        hint="Try `slip diagnose` in a terminal.",
    )
