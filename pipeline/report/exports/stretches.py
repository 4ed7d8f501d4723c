"""A model on a run, one stretch of time after the other, so that long runs need no more memory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.core.arrays import Floats
from pipeline.identification import Comparison, Prediction, choose_input, predict_at_from, predict_from
from pipeline.models import Effect, Model, Timing
from pipeline.report.exports.feed import Feed
from pipeline.report.exports.source import ExportSource
from pipeline.report.motion_run import COLUMNS, make_motion_run
from pipeline.runs import MotionError, MotionRun

# States of an effect, a lag or a rate limit, have forgotten how they began after this long.
_BEFORE_S = 60.0
_AFTER_S = 10.0


@dataclass(frozen=True)
class Stretch:
    """What a model says of a stretch.

    Attributes:
        velocity: at the times asked for, as the localization would report it: (v_x [m/s], v_y [m/s],
            v_w [rad/s]), NaN where it is unknown, shape (n, 3).
        prediction: where it goes from the poses measured in the stretch.
    """

    velocity: Floats
    prediction: Prediction


class ModelFeed:
    """A model of a stored run.

    Args:
        source: the run.
        model: with its values.
    """

    def __init__(self, source: ExportSource, model: Model) -> None:
        self._source = source
        self._model = model
        tables = source.manifest.tables
        # Results of an earlier version lack the newer columns.
        self._feeds: dict[str, Sequence[Feed]] = {
            name: [source.feed(name, "t", [column for column in columns if column in source.columns(name)])]
            for name, columns in COLUMNS.items()
            if name in tables and "t" in columns and name != "slip"
        }
        if "slip" in tables:
            self._feeds["slip"] = [source.feed("slip", "t", COLUMNS["slip"], name) for name in source.inputs]
        self._duration_s = max(
            (_find_end(source, name) for name in ("poses", "commands", "wheels")), default=0.0
        )
        self._refused: MotionError | None = None
        self._has_answered = False

    def predict(self, low: float, high: float, at: Floats) -> Stretch | None:
        """What the model says of a stretch.

        Args:
            low: its start [s]; no earlier than at the call before.
            high: its end [s].
            at: times in it at which the velocity is wanted [s].

        Returns:
            None where the stretch has too little to go by.
        """
        try:
            run = self._load(low, high)
            source = choose_input([run], self._source.input, self._model).source
            comparison = Comparison(run, self._model.vehicle, source)
        except MotionError as error:
            self._refused = self._refused or error
            return None
        self._has_answered = True
        timing = Timing()
        velocity = predict_at_from(comparison, self._model.effects, timing, at)
        made = _predict_within(comparison, self._model.effects, timing, low, high)
        return Stretch(velocity, made)

    def check(self) -> None:
        """Complain if no stretch could be predicted.

        Raises:
            MotionError: the run has too little to predict, or lacks the input.
        """
        if not self._has_answered and self._refused is not None:
            raise self._refused

    def _load(self, low: float, high: float) -> MotionRun:
        tables = {}
        if "alignments" in self._source.manifest.tables:
            tables["alignments"] = self._source.manifest.read("alignments")
        for name, feeds in self._feeds.items():
            parts = [feed.take(low - _BEFORE_S, high + _AFTER_S) for feed in feeds]
            found = [part for part in parts if part is not None]
            if found:
                tables[name] = pl.concat(found)
        if "poses" not in tables:
            raise MotionError(
                "no_poses",
                "fewer than ten poses carry information",
                where=self._source.manifest.run,
                hint="Check the pose topic with `slip inspect`.",
            )
        run = make_motion_run(self._source.manifest, self._model.vehicle, tables)
        # Effects that change over the run go by its whole length.
        return replace(run, duration_s=max(self._duration_s, run.duration_s))


def _predict_within(
    comparison: Comparison, effects: Sequence[Effect], timing: Timing, low: float, high: float
) -> Prediction:
    """Predictions that begin in a stretch, from where the localization has the vehicle."""
    made = predict_from(comparison, effects, timing)
    kept = (made.start_times >= low) & (made.start_times < high)
    track = comparison.run.track
    poses = made.poses[kept]
    for axis in range(2):
        at = np.interp(made.start_times[kept], track.times, track.place[:, axis])
        poses[:, :, axis] += (at - poses[:, 0, axis])[:, None]
    return replace(made, start_times=made.start_times[kept], poses=poses)


def _find_end(source: ExportSource, table: str) -> float:
    if table not in source.manifest.tables:
        return 0.0
    end = pl.scan_parquet(source.manifest.path(table), glob=False).select(pl.col("t").max()).collect().item()
    return 0.0 if end is None or not math.isfinite(end) else float(end)
