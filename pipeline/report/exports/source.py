"""The stored run that an export is made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.report.motion_run import choose_source, load_motion_run

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pipeline.motion import Model, MotionRun, Prediction
    from pipeline.store import Manifest

BATCH_ROWS = 65_536

_AGREE_NS = 1_000_000_000


@dataclass(frozen=True)
class ExportSource:
    """A run and, where wanted, a model of it.

    Attributes:
        manifest: the run's current results.
        model: whose velocity and predicted path are exported too; None for none.
        input: what the model is fed with, `command` or `measured`; None is the command where there is one.
        frame_id: the fixed frame that the original log's poses stand in.
    """

    manifest: Manifest
    model: Model | None = None
    input: str | None = None
    frame_id: str = "map"

    def batches(self, table: str, columns: Sequence[str] | None = None) -> Iterator[pl.DataFrame]:
        """A table in pieces; nothing where the run has no such table."""
        import pyarrow.parquet as pq  # noqa: PLC0415 - heavy

        if table not in self.manifest.tables:
            return
        with pq.ParquetFile(self.manifest.path(table)) as file:
            for batch in file.iter_batches(BATCH_ROWS, columns=list(columns) if columns else None):
                frame = pl.from_arrow(batch)
                if isinstance(frame, pl.DataFrame) and not frame.is_empty():
                    yield frame

    def columns(self, table: str) -> list[str]:
        """Names of a table's columns."""
        return pl.scan_parquet(self.manifest.path(table), glob=False).collect_schema().names()

    @cached_property
    def shift_ns(self) -> int:
        """What is added to stamps so that they stand on the recorder's clock [ns].

        Zero where both clocks agree to a second: the difference is then the messages' own latency.
        """
        if "poses" not in self.manifest.tables:
            return 0
        late = (
            pl.scan_parquet(self.manifest.path("poses"), glob=False)
            .select((pl.col("log_time") - pl.col("stamp")).median())
            .collect()
            .item()
        )
        return 0 if late is None or abs(late) < _AGREE_NS else int(late)

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

    @cached_property
    def _motion_run(self) -> MotionRun | None:
        return None if self.model is None else load_motion_run(self.manifest, self.model.vehicle)

    @cached_property
    def prediction(self) -> Prediction | None:
        """Where the model goes from measured poses; None without one.

        Raises:
            MotionError: the run has too little to predict, or lacks the input.
        """
        from pipeline.motion import predict  # noqa: PLC0415 - heavy

        run = self._motion_run
        if self.model is None or run is None:
            return None
        return predict(self.model, run, choose_source(run, self.input))

    @cached_property
    def model_velocity(self) -> pl.DataFrame | None:
        """The model's velocity at the stamps of the measured one: ``stamp v_x v_y v_w``; None without one.

        Raises:
            MotionError: the run has too little to predict, or lacks the input.
        """
        from pipeline.motion import predict_at  # noqa: PLC0415 - heavy

        run, parts = self._motion_run, list(self.batches("velocities", ("t", "stamp")))
        if self.model is None or run is None or not parts:
            return None
        at = pl.concat(parts)
        found = predict_at(self.model, run, choose_source(run, self.input), at["t"].to_numpy())
        columns = {f"v_{axis}": found[:, i] for i, axis in enumerate("xyw")}
        return at.select("stamp").with_columns(**columns).filter(pl.col("v_x").is_finite())
