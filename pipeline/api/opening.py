"""How logs and stored runs are opened, and how what is at work is shown: a face may bring its own way."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import TypeAlias

from pipeline.analysis import Options
from pipeline.analysis.analyze import OpenedRun, open_run
from pipeline.estimation import DiagnosisInput
from pipeline.estimation.stored_diagnosis import read_recording
from pipeline.sources import Vehicle
from pipeline.store import Manifest

Opener: TypeAlias = Callable[[str, Options], AbstractContextManager[OpenedRun]]
"""How the results of a log or of a stored run are opened."""
Progress: TypeAlias = Callable[[str], AbstractContextManager[Callable[[str], None]]]
"""How the stages of what is at work, by its name, are shown."""


def open_quietly(name: str, options: Options) -> AbstractContextManager[OpenedRun]:
    """The results of a log, analyzed where there are none, or of a stored run."""
    return open_run(name, options, lambda _stage: None)


def show_nothing(_name: str) -> AbstractContextManager[Callable[[str], None]]:
    """No progress is shown."""
    return nullcontext(lambda _stage: None)


@dataclass(frozen=True)
class ReadRun:
    """A run whose tables were read for a diagnosis.

    Attributes:
        manifest: its results.
        vehicle: that it was analyzed with.
        recording: its tables.
    """

    manifest: Manifest
    vehicle: Vehicle
    recording: DiagnosisInput


def read_run(manifest: Manifest) -> ReadRun:
    """Read the tables of a run for a diagnosis.

    Raises:
        SlipError: the results do not contain the vehicle, or a table cannot be read.
    """
    return ReadRun(manifest, *read_recording(manifest))
