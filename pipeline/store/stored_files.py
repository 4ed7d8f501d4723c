"""Files of results as data: one reader, which tells in one line which file is not what slip wrote."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal, TypeVar

import msgspec

from pipeline.core import read_bounded, shorten
from pipeline.store.names import StoreError, name_disk_errors

Kind = TypeVar("Kind")

AGAIN: Final = "Analyze the log again with --force; `slip results verify` lists what else is damaged"


def read_stored(path: Path, kind: type[Kind]) -> Kind:
    """The content of a JSON file of results.

    Args:
        path: the file.
        kind: the type of its content.

    Raises:
        StoreError: ``file_damaged``, it is not of that type; ``too_large``, ``no_folder`` and others of
            `name_disk_errors`, it cannot be read.
    """
    with name_disk_errors(path):
        data = read_bounded(path)
    return decode_stored(data, kind, path)


def decode_stored(data: bytes, kind: type[Kind], path: Path) -> Kind:
    """The content of such a file that was read.

    Raises:
        StoreError: ``file_damaged``.
    """
    with _name_damage(path):
        return msgspec.json.decode(data, type=kind)


def convert_stored(content: object, kind: type[Kind], path: Path, *, strict: bool = True) -> Kind:
    """An object of such a file as a type.

    Args:
        content: the object.
        kind: the type.
        path: the file.
        strict: whether a text or a truth value is no number.

    Raises:
        StoreError: ``file_damaged``.
    """
    with _name_damage(path):
        return msgspec.convert(content, kind, strict=strict)


@contextmanager
def _name_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        what = f"the file is not what this version of slip writes: {shorten(' '.join(str(error).split()))}"
        raise StoreError("file_damaged", what, where=str(path), hint=AGAIN) from error


# The shape of a run's stored summary, against which it is held when it is read.

SUMMARY: Final = "summary.json"

Number = float | None


class _Loss(msgspec.Struct):
    """A loss of the log."""

    text: str
    start_s: Number = None
    end_s: Number = None


class _Log(msgspec.Struct):
    """Facts of the recording."""

    path: str
    sha256: str | None = None
    duration_s: Number = None
    complete: bool | None = None
    losses: list[_Loss] = []
    unchecked: str | int | None = None


class _Finding(msgspec.Struct):
    """A finding of the run."""

    id: str
    text: str
    severity: Literal["info", "warning", "error"]
    where: str | None
    t_start: Number
    t_end: Number
    value: Number
    count: int | None
    values: dict[str, object] = {}


class _Source(msgspec.Struct):
    """A topic and why it was chosen, or was not."""

    topic: str
    reason: str


class _Choice(_Source):
    """A topic that was chosen, and the others."""

    others: list[_Source] = []


class _Slip(msgspec.Struct):
    """Slip on one input."""

    median_modulus: Number = None
    median_modulus_low: Number = None
    median_modulus_high: Number = None
    median_window_norm: Number = None
    median_residual_modulus: Number = None
    transitory_median_modulus: Number = None
    steady_median_modulus: Number = None


class _Topics(msgspec.Struct):
    """What served for each role."""

    command: _Source | None = None
    wheels: _Source | None = None
    pose: _Source | None = None
    imu: _Source | None = None
    interval: _Source | None = None
    notes: list[str] = []


class _Split(msgspec.Struct):
    """Shares of the mean square of slip."""

    drivetrain: float
    ground: float
    cross: float


class StoredSummary(msgspec.Struct):
    """What readers of `summary.json` rely on; other keys may be anything."""

    run: str
    vehicle: str
    vehicle_name: str
    terrain: str
    dataset: str
    log: _Log
    by_input: dict[Literal["command", "measured"], _Slip]
    findings: list[_Finding]
    leading_input: Literal["command", "measured"]
    length_scale_m: float
    topics: _Topics
    split: _Split | None = None
    distance_m: Number = None
    duration_s: Number = None
    standing_share: Number = None
    choices: dict[str, _Choice | None] = {}
    vehicle_source: str | None = None
    verdict: str | None = None
    diagnosis: dict[str, object] | None = None
