"""Which runs a question is about, told from their manifests alone."""

from dataclasses import dataclass
from datetime import UTC, datetime

from pipeline.store.manifest import JSON, Manifest


@dataclass(frozen=True, kw_only=True)
class Partition:
    """The part of the runs that a question is about; what is not said is not asked.

    Attributes:
        vehicle: id of the vehicle.
        terrain: name of the terrain.
        dataset: name of the dataset.
        day: UTC day of the log's start, ``2026-07-31``; a beginning such as ``2026-07`` stands for all in it.
    """

    vehicle: str | None = None
    terrain: str | None = None
    dataset: str | None = None
    day: str | None = None

    def holds(self, manifest: Manifest) -> bool:
        """Whether a run belongs to it."""
        found = describe_run(manifest)
        plain = {"vehicle": self.vehicle, "terrain": self.terrain, "dataset": self.dataset}
        is_like = all(wanted is None or found[name] == wanted for name, wanted in plain.items())
        return is_like and (self.day is None or str(found["day"] or "").startswith(self.day))


def describe_run(manifest: Manifest) -> dict[str, JSON]:
    """The row of a run in the table ``runs``."""
    details, log = manifest.details, manifest.part("log")
    start = manifest.part("stages", "extract", "context").get("start_ns")
    stamp = start if isinstance(start, int) and start > 0 else None
    return {
        "run": manifest.run,
        "dataset": _text(details.get("dataset")),
        "vehicle": _text(manifest.part("vehicle").get("id")),
        "terrain": _text(details.get("terrain")),
        "day": None if stamp is None else f"{datetime.fromtimestamp(stamp // 10**9, UTC):%Y-%m-%d}",
        "start_ns": stamp,
        "duration_s": log.get("duration_s"),
        "complete": log.get("complete"),
        "bytes": log.get("bytes"),
        "sha256": log.get("sha256"),
        "log": log.get("path"),
        "key": manifest.key,
        "folder": str(manifest.folder),
    }


def _text(content: object) -> str | None:
    return content if isinstance(content, str) else None
