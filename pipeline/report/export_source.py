"""What exports show of a run: feeds of its tables and of a model, its track and its findings."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl
import pyarrow.parquet as pq

from pipeline.core import Floats, Ints
from pipeline.estimation import Prediction, RunResiduals, choose_input, predict_at_from, predict_from
from pipeline.logs.writer import Given, LogWriter
from pipeline.models import Effect, Model, Timing
from pipeline.report import theme
from pipeline.report.scene import CAP_QUANTILE, INPUTS
from pipeline.run import TABLE_COLUMNS, MotionError, MotionRun, make_motion_run
from pipeline.store import Manifest, check_size, name_damage


class Feed:
    """Rows by time, with only the requested stretch in memory.

    Args:
        batches: batches of a table's rows, by time.
        key: column that orders them.
    """

    def __init__(self, batches: Iterator[pl.DataFrame], key: str) -> None:
        self._batches = batches
        self._key = key
        self._held: list[pl.DataFrame] = []
        self._is_empty = False

    def take(self, low: float, high: float) -> pl.DataFrame | None:
        """Return the rows from ``low`` to before ``high``; earlier rows are discarded.

        Args:
            low: start of the stretch; not before that of the previous call.
            high: its end.

        Returns:
            The rows; None if there are none.
        """
        while not self._is_empty and not (self._held and self._held[-1][self._key][-1] >= high):
            batch = next(self._batches, None)
            if batch is None:
                self._is_empty = True
            elif not batch.is_empty():
                self._held.append(batch)
        self._held = [frame for frame in self._held if frame[self._key][-1] >= low]
        key = pl.col(self._key)
        frames = [frame.filter((key >= low) & (key < high)) for frame in self._held]
        frames = [frame for frame in frames if not frame.is_empty()]
        return pl.concat(frames) if frames else None


BATCH_ROWS = 16_384
STRETCH_ROWS = 18_000
"""Rows of velocities in a stretch: a quarter of an hour at the usual rate."""

_AGREE_NS = 1_000_000_000
_EARLIEST, _LATEST = -(1 << 62), 1 << 62


@dataclass(frozen=True)
class ExportSource:
    """Run to export, optionally with a model of it.

    Attributes:
        manifest: the run's current results.
        model: model whose velocity and predicted path are exported as well; None for none.
        input: `command` or `measured`; None for the command if available.
        frame_id: fixed frame of the original log's poses.
        stretch_rows: rows of velocities processed at a time.
    """

    manifest: Manifest
    model: Model | None = None
    input: str | None = None
    frame_id: str = "map"
    stretch_rows: int = STRETCH_ROWS

    def batches(self, table: str, columns: Sequence[str] | None = None) -> Iterator[pl.DataFrame]:
        """Read a table in batches; yields nothing if the run has no such table."""
        if table not in self.manifest.tables:
            return

        path = self.manifest.path(table)
        check_size(path, self.manifest.count_rows(table))
        with name_damage(path), pq.ParquetFile(path, buffer_size=1 << 16, pre_buffer=False) as file:
            for batch in file.iter_batches(
                BATCH_ROWS, use_threads=False, columns=list(columns) if columns else None
            ):
                frame = pl.from_arrow(batch)
                if isinstance(frame, pl.DataFrame) and not frame.is_empty():
                    yield frame

    def feed(self, table: str, key: str, columns: Sequence[str], only: str | None = None) -> Feed:
        """Return a table as a feed by time.

        Args:
            table: name of the table.
            key: time column, one of ``columns``.
            columns: columns to read.
            only: restriction to rows of this input.
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
                # Stages do not write unsorted tables; sorting only costs memory.
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
        """Inputs with slip, the command first."""
        known: set[str] = set()
        for frame in self.batches("slip", ("input",)):
            known |= set(frame["input"].cast(pl.String).unique())
        return [name for name in INPUTS if name in known]

    @cached_property
    def shift_ns(self) -> int:
        """Offset from stamps to the recorder's clock [ns].

        Zero if both clocks agree to a second: the difference is then the latency of the messages.
        """
        late = [
            frame["log_time"].to_numpy() - frame["stamp"].to_numpy()
            for frame in self.batches("poses", ("log_time", "stamp"))
        ]
        usual = float(np.median(np.concatenate(late))) if late else 0.0
        return 0 if abs(usual) < _AGREE_NS else int(usual)

    @cached_property
    def start_ns(self) -> int:
        """Stamp of the run's time zero [ns]."""
        for table in ("velocities", "slip"):
            for frame in self.batches(table, ("t", "stamp")):
                return int(frame["stamp"][0]) - round(float(frame["t"][0]) * 1e9)
        return 0

    def stamp(self, seconds: Floats) -> Ints:
        """Stamps [ns] of times since the start of the run [s]."""
        stamps: Ints = self.start_ns + np.round(seconds * 1e9).astype(np.int64)
        return stamps

    def thin_velocities(self, columns: Sequence[str], most: int) -> pl.DataFrame:
        """About so many rows of the velocities, evenly chosen; empty if the run has none."""
        every = max((self.manifest.count_rows("velocities") or 0) // most, 1)
        parts = [frame.gather_every(every) for frame in self.batches("velocities", columns)]
        return pl.concat(parts) if parts else pl.DataFrame()

    def log_times(self, stamps: np.ndarray) -> np.ndarray:
        """Stamps [ns] on the recorder's clock."""
        return np.asarray(stamps, dtype=np.int64) + self.shift_ns

    def write_stamped(
        self, writer: LogWriter, topic: str, kind: str, stamps: Ints, fields: Mapping[str, Given]
    ) -> None:
        """Write messages with a header.

        Args:
            writer: writer of the derived log.
            topic: topic of the messages.
            kind: message type.
            stamps: stamps of the headers [ns]; the log times are the same on the recorder's clock.
            fields: columns of the messages; they are in the fixed frame unless a field sets another.
        """
        whole = {"header.frame_id": self.frame_id, **fields}
        writer.write_columns(topic, kind, self.log_times(stamps), whole, header_time=stamps)

    @cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """Stretches in which the run is processed: start and (excluded) end stamps [ns].

        Together they cover all stamps.
        """
        stamps = [frame["stamp"].to_numpy() for frame in self.batches("velocities", ("stamp",))]
        whole = np.sort(np.concatenate(stamps)) if stamps else np.zeros(0, dtype=np.int64)
        inner = whole[self.stretch_rows : -(self.stretch_rows // 2) or None : self.stretch_rows]
        edges = [_EARLIEST, *np.unique(inner).tolist(), _LATEST]
        return list(itertools.pairwise(edges))


# Time after which the states of an effect, a lag or a rate limit, no longer depend on their initial values.
_BEFORE_S = 60.0
_AFTER_S = 10.0


@dataclass(frozen=True)
class Stretch:
    """Model output for a stretch.

    Attributes:
        velocity: velocity at the requested times, as the localization would report it: (v_x [m/s],
            v_y [m/s], v_w [rad/s]), NaN if unknown, shape (n, 3).
        prediction: predicted paths from the poses measured in the stretch.
    """

    velocity: Floats
    prediction: Prediction


class ModelFeed:
    """Model of a stored run, evaluated stretch by stretch.

    Args:
        source: the run.
        model: model with its parameter values.
    """

    def __init__(self, source: ExportSource, model: Model) -> None:
        self._source = source
        self._model = model
        tables = source.manifest.tables
        # Results of an earlier version lack newer columns.
        self._feeds: dict[str, Sequence[Feed]] = {
            name: [source.feed(name, "t", [column for column in columns if column in source.columns(name)])]
            for name, columns in TABLE_COLUMNS.items()
            if name in tables and "t" in columns and name != "slip"
        }
        if "slip" in tables:
            self._feeds["slip"] = [
                source.feed("slip", "t", TABLE_COLUMNS["slip"], name) for name in source.inputs
            ]
        self._duration_s = max(
            (_find_end(source, name) for name in ("poses", "commands", "wheels")), default=0.0
        )
        self._refused: MotionError | None = None
        self._has_answered = False

    def predict(self, low: float, high: float, at: Floats) -> Stretch | None:
        """Return the model output for a stretch.

        Args:
            low: its start [s]; not before that of the previous call.
            high: its end [s].
            at: times in it at which the velocity is requested [s].

        Returns:
            None if the stretch has too little data.
        """
        try:
            run = self._load(low, high)
            source = choose_input([run], self._source.input, self._model).source
            run_residuals = RunResiduals(run, self._model.vehicle, source)
        except MotionError as error:
            self._refused = self._refused or error
            return None
        self._has_answered = True
        timing = Timing()
        velocity = predict_at_from(run_residuals, self._model.effects, timing, at)
        made = _predict_within(run_residuals, self._model.effects, timing, low, high)
        return Stretch(velocity, made)

    def check(self) -> None:
        """Raise an error if no stretch could be predicted.

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
            known = [part for part in parts if part is not None]
            if known:
                tables[name] = pl.concat(known)
        if "poses" not in tables:
            raise MotionError(
                "no_poses",
                "fewer than ten poses carry information",
                where=self._source.manifest.run,
                hint="Check the pose topic with `slip inspect`.",
            )
        run = make_motion_run(self._source.manifest, self._model.vehicle, tables)
        # Effects that vary over the run depend on its total duration.
        return replace(run, duration_s=max(self._duration_s, run.duration_s))


def _predict_within(
    run_residuals: RunResiduals, effects: Sequence[Effect], timing: Timing, low: float, high: float
) -> Prediction:
    """Predictions that start in a stretch, from the measured positions."""
    made = predict_from(run_residuals, effects, timing)
    mask = (made.start_times >= low) & (made.start_times < high)
    track = run_residuals.run.track
    poses = made.poses[mask]
    for axis in range(2):
        at = np.interp(made.start_times[mask], track.times, track.position[:, axis])
        poses[:, :, axis] += (at - poses[:, 0, axis])[:, None]
    return replace(made, start_times=made.start_times[mask], poses=poses)


def _find_end(source: ExportSource, table: str) -> float:
    if table not in source.manifest.tables:
        return 0.0
    end = pl.scan_parquet(source.manifest.path(table), glob=False).select(pl.col("t").max()).collect().item()
    return 0.0 if end is None or not math.isfinite(end) else float(end)


# Export of a run to common viewers: a derived MCAP, CSV, layouts for Foxglove and PlotJuggler.
#
# Tables are read and written in batches, so that memory does not grow with the duration.

MEASURED = "/slip/velocity/measured"
MODEL = "/slip/velocity/model"
RESIDUAL = "/slip/residual_modulus"
POSE = "/slip/pose"
MODEL_POSE = "/slip/pose_model"
IDEAL_POSE = "/slip/pose_ideal"
PATH = "/slip/path"
PREDICTED_PATH = "/slip/predicted_path"
TRAIL = "/slip/trail"
SEGMENT = "/slip/segment"
FINDINGS = "/slip/findings"
FINDING_MARKERS = "/slip/finding_markers"


def name_ideal(input_name: str) -> str:
    """Topic of the ideal velocity on an input."""
    return f"/slip/velocity/ideal_{input_name}"


def name_slip(input_name: str) -> str:
    """Topic of the slip vector on an input."""
    return f"/slip/slip_{input_name}"


def name_modulus(input_name: str) -> str:
    """Topic of the slip modulus on an input."""
    return f"/slip/modulus_{input_name}"


_MARKER = "visualization_msgs/msg/Marker"
_LINE_STRIP, _TEXT = 4, 9
_LEVELS = {"info": 20, "warning": 30, "error": 40}
_COLOURS = {"info": theme.ON_COMMAND, "warning": theme.SLIP_RAMP[1], "error": theme.SLIP_RAMP[3]}
_MOST_POINTS = 20_000
_LIFT_M = 0.4


def write_trail(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """Write one line per segment, coloured by slip modulus on the leading input; grey without slip.

    Args:
        writer: writer of the derived log.
        source: the run.
        track: as from `join_track`.
    """
    if track.is_empty():
        return
    cap = float(track["modulus"].quantile(CAP_QUANTILE) or 1.0) or 1.0
    for (segment,), rows in track.group_by("segment", maintain_order=True):
        ramp = _ramp(rows["modulus"].fill_null(0.0).to_numpy() / cap)
        fields: dict[str, Given] = {
            "ns": "slip",
            "id": int(str(segment)),
            "type": _LINE_STRIP,
            "pose.orientation.w": 1.0,
            "scale.x": 0.08,
            "color.a": 1.0,
            **{f"points[].{axis}": rows[axis].to_numpy()[None, :] for axis in "xyz"},
            **{f"colors[].{name}": ramp[None, :, i] for i, name in enumerate("rgb")},
            "colors[].a": np.ones((1, rows.height), dtype=np.float32),
        }
        source.write_stamped(writer, TRAIL, _MARKER, rows["stamp"].to_numpy()[:1], fields)


def write_findings(writer: LogWriter, source: ExportSource, track: pl.DataFrame) -> None:
    """Write each finding as a line of a log panel, and as a text at its position.

    Args:
        writer: writer of the derived log.
        source: the run.
        track: as from `join_track`.
    """
    places = track.sort("stamp") if track.width else track
    for frame in source.batches("findings"):
        rows = frame.sort(pl.col("t_start").fill_null(0.0), maintain_order=True)
        seconds = rows["t_start"].fill_null(0.0).to_numpy()
        stamps = source.stamp(seconds)
        severities = rows["severity"].cast(pl.String).to_list()
        writer.write_columns(
            FINDINGS,
            "rcl_interfaces/msg/Log",
            source.log_times(stamps),
            {
                "stamp.sec": stamps // 10**9,
                "stamp.nanosec": stamps % 10**9,
                "level": np.array([_LEVELS.get(name, 20) for name in severities], dtype=np.uint8),
                "name": rows["id"].to_list(),
                "msg": rows["text"].to_list(),
            },
        )
        if not places.is_empty():
            _write_texts(writer, source, rows, stamps, places)


def _write_texts(
    writer: LogWriter,
    source: ExportSource,
    rows: pl.DataFrame,
    stamps: Ints,
    places: pl.DataFrame,
) -> None:
    at = np.clip(np.searchsorted(places["stamp"].to_numpy(), stamps), 0, places.height - 1)
    colours = np.array(
        [_rgb(_COLOURS.get(str(name), theme.INK)) for name in rows["severity"].cast(pl.String)]
    )
    fields: dict[str, Given] = {
        "ns": "findings",
        "id": np.arange(rows.height, dtype=np.int32),
        "type": _TEXT,
        "pose.position.x": places["x"].to_numpy()[at],
        "pose.position.y": places["y"].to_numpy()[at],
        "pose.position.z": places["z"].to_numpy()[at] + _LIFT_M,
        "pose.orientation.w": 1.0,
        "scale.z": 0.3,
        **{f"color.{name}": colours[:, i] for i, name in enumerate("rgb")},
        "color.a": 1.0,
        "text": rows["id"].to_list(),
    }
    source.write_stamped(writer, FINDING_MARKERS, _MARKER, stamps, fields)


def join_track(source: ExportSource) -> pl.DataFrame:
    """Thinned ``stamp segment x y z modulus``, by segment and time; the modulus is null without slip."""
    track = source.thin_velocities(("stamp", "segment", "x", "y", "z"), _MOST_POINTS)
    if track.is_empty():
        return track
    leading = source.inputs[0] if source.inputs else ""
    places = track.select("stamp", "segment")
    known = [
        frame.filter(pl.col("input").cast(pl.String) == leading)
        .select("stamp", "segment", "modulus")
        .join(places, on=["stamp", "segment"], how="semi")
        for frame in source.batches("slip", ("input", "stamp", "segment", "modulus"))
    ]
    if not known:
        return track.with_columns(modulus=pl.lit(None, pl.Float64)).sort("segment", "stamp")
    modulus = pl.concat(known).unique(["stamp", "segment"], maintain_order=True, keep="first")
    return track.join(modulus, on=["stamp", "segment"], how="left").sort("segment", "stamp")


def _ramp(share: Floats) -> Floats:
    """Colours of the slip ramp at fractions of its range, shape (n, 3)."""
    stops = np.linspace(0.0, 1.0, len(theme.SLIP_RAMP))
    table = np.array([_rgb(colour) for colour in theme.SLIP_RAMP])
    return np.stack([np.interp(np.clip(share, 0.0, 1.0), stops, column) for column in table.T], axis=1)


def _rgb(colour: str) -> list[float]:
    return [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
