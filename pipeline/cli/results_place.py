"""Results where the user says: in a folder, or on an object store behind a mirror."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from pipeline.store import Mirror, Store


@dataclass(frozen=True)
class ResultsPlace:
    """Where results are.

    Attributes:
        root: their folder, or that of their mirror.
        mirror: the mirror; None for a folder.
    """

    root: Path
    mirror: Mirror | None = None

    def open_store(self) -> Store:
        """The results, with the newest index where they are on an object store.

        Raises:
            StoreError: ``no_results``, there is no such folder; or the object store does not answer.
        """
        from pipeline.store import Store, StoreError  # noqa: PLC0415 - verbs that only help need none

        if self.mirror is None:
            if not self.root.is_dir():
                hint = "Say where they are, or make them with `slip analyze` or `slip batch`"
                raise StoreError(
                    "no_results", "there are no results: it is no folder", where=str(self.root), hint=hint
                )
            return Store(self.root)
        self.mirror.pull_index()
        return self.mirror.store


def open_results(out: Path) -> ResultsPlace:
    """Results at a path, or at an address such as ``s3://bucket/results``.

    Raises:
        StoreError: ``no_object_store``.
    """
    from pipeline.logs import RemotePath, to_location  # noqa: PLC0415 - verbs that only help need none
    from pipeline.store import Mirror  # noqa: PLC0415 - likewise

    place = to_location(out)
    if not isinstance(place, RemotePath):
        return ResultsPlace(place)
    mirror = Mirror(str(place))
    return ResultsPlace(mirror.store.root, mirror)
