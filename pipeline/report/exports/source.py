"""The stored run that an export is made of."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core.arrays import Ints
from pipeline.logs import LogWriter
from pipeline.logs.normalize import Given
from pipeline.models import Model
from pipeline.report.exports.feed import Feed
from pipeline.report.run import INPUTS
from pipeline.store import Manifest
from pipeline.store.manifest import name_damage

BATCH_ROWS = 16_384
STRETCH_ROWS = 18_000
"""Rows of velocities in a stretch: a quarter of an hour at the usual rate."""

_AGREE_NS = 1_000_000_000
_EARLIEST, _LATEST = -(1 << 62), 1 << 62


@dataclass(frozen=True)
class ExportSource:
    """A run and, where wanted, a model of it.

    Attributes:
        manifest: the run's current results.
        model: whose velocity and predicted path are exported too; None for none.
        input: what the model is fed with, `command` or `measured`; None is the command where there is one.
        frame_id: the fixed frame that the original log's poses stand in.
        stretch_rows: rows of velocities that are worked on at a time.
    """

    manifest: Manifest
    model: Model | None = None
    input: str | None = None
    frame_id: str = "map"
    stretch_rows: int = STRETCH_ROWS

    def batches(self, table: str, columns: Sequence[str] | None = None) -> Iterator[pl.DataFrame]:
        """A table in pieces; nothing where the run has no such table."""
        import pyarrow.parquet as pq  # noqa: PLC0415 - heavy

        if table not in self.manifest.tables:
            return
        from pipeline.store.tables import check_rows  # noqa: PLC0415 - heavy

        path = self.manifest.path(table)
        check_rows(path, self.manifest.count_rows(table))
        with name_damage(path), pq.ParquetFile(path, buffer_size=1 << 16, pre_buffer=False) as file:
            for batch in file.iter_batches(
                BATCH_ROWS, use_threads=False, columns=list(columns) if columns else None
            ):
                frame = pl.from_arrow(batch)
                if isinstance(frame, pl.DataFrame) and not frame.is_empty():
                    yield frame

    def feed(self, table: str, key: str, columns: Sequence[str], only: str | None = None) -> Feed:
        """A table by time, stretch after stretch.

        Args:
            table: its name.
            key: the column of times, one of ``columns``.
            columns: what to read.
            only: rows of this input alone.
        """
        return Feed(self._read_in_order(table, key, columns, only), key)

    def _read_in_order(
        self, table: str, key: str, columns: Sequence[str], only: str | None
    ) -> Iterator[pl.DataFrame]:
        def choose(frame: pl.DataFrame) -> pl.DataFrame:
            return frame if only is None else frame.filter(pl.col("input").cast(pl.String) == only)

        wanted = list(dict.fromkeys((*columns, "input"))) if only is not None else list(columns)
        last: float | None = None
        for frame in self.batches(table, [key, "input"] if only is not None else [key]):
            times = choose(frame)[key]
            if times.is_empty():
                continue
            if not times.is_sorted() or (last is not None and times[0] < last):
                # Such a table is not what stages write; it costs memory, nothing else.
                yield choose(self.manifest.read(table).select(wanted)).sort(key, maintain_order=True)
                return
            last = times[-1]
        for frame in self.batches(table, wanted):
            yield choose(frame)

    def columns(self, table: str) -> list[str]:
        """Names of a table's columns."""
        path = self.manifest.path(table)
        with name_damage(path):
            return pl.scan_parquet(path, glob=False).collect_schema().names()

    @cached_property
    def inputs(self) -> list[str]:
        """Inputs that the run has slip for, the command first."""
        known: set[str] = set()
        for frame in self.batches("slip", ("input",)):
            known |= set(frame["input"].cast(pl.String).unique())
        return [name for name in INPUTS if name in known]

    @cached_property
    def shift_ns(self) -> int:
        """What is added to stamps so that they stand on the recorder's clock [ns].

        Zero where both clocks agree to a second: the difference is then the messages' own latency.
        """
        late = [
            frame["log_time"].to_numpy() - frame["stamp"].to_numpy()
            for frame in self.batches("poses", ("log_time", "stamp"))
        ]
        usual = float(np.median(np.concatenate(late))) if late else 0.0
        return 0 if abs(usual) < _AGREE_NS else int(usual)

    @cached_property
    def start_ns(self) -> int:
        """Stamp of time zero of the run [ns]."""
        for table in ("velocities", "slip"):
            for frame in self.batches(table, ("t", "stamp")):
                return int(frame["stamp"][0]) - round(float(frame["t"][0]) * 1e9)
        return 0

    def log_times(self, stamps: np.ndarray) -> np.ndarray:
        """Stamps [ns] on the recorder's clock."""
        return np.asarray(stamps, dtype=np.int64) + self.shift_ns

    def write_stamped(
        self, writer: LogWriter, topic: str, kind: str, stamps: Ints, fields: Mapping[str, Given]
    ) -> None:
        """Write messages with a header.

        Args:
            writer: of the derived log.
            topic: of the messages.
            kind: their type.
            stamps: of their headers [ns]; they are logged at the same times on the recorder's clock.
            fields: their columns; they are in the fixed frame where these name no other.
        """
        whole = {"header.frame_id": self.frame_id, **fields}
        writer.write_columns(topic, kind, self.log_times(stamps), whole, header_time=stamps)

    @cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """Stamps [ns] between which the run is worked on at a time: each start, and the end before which.

        Together they hold every stamp there is.
        """
        stamps = [frame["stamp"].to_numpy() for frame in self.batches("velocities", ("stamp",))]
        whole = np.sort(np.concatenate(stamps)) if stamps else np.zeros(0, dtype=np.int64)
        inner = whole[self.stretch_rows : -(self.stretch_rows // 2) or None : self.stretch_rows]
        edges = [_EARLIEST, *np.unique(inner).tolist(), _LATEST]
        return list(itertools.pairwise(edges))
