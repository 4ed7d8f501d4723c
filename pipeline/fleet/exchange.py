"""Exchange with others: features of deployments in one shareable file, and the published chain.

A file from others is not trusted: it is read whole and only if it is small, uncompressed, and has exactly the
columns, types and ranges of its contract. Parquet can expand without compression, too: texts are read as
dictionaries, so that a text shared by many rows is in memory once, and their lengths are checked before they
are expanded. The actual encoding of pages may differ from the declared one, so callers limit the memory as
well.

The chain of Samson et al. 2024 is reimplemented, so that our results can be compared with the paper's. They
print medians of the norm of g over windows of 2 s. Their u is not the raw command but the response of a
powertrain model to it; their v comes from splines of held poses. Where the paper and its public code leave a
choice, the function that makes it documents it.
"""

from __future__ import annotations

import functools
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.core import arrays, naming_os_errors
from pipeline.core.arrays import ROUNDING_S, Flags, Floats, Ints
from pipeline.fleet import ComparisonError
from pipeline.stages.slip_stage import PUBLISHED_SAMPLES, WINDOW_S
from schemas import Features, contract_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pyarrow as pa

MAGIC = b"PAR1"
LARGEST_BYTES = 64 * 2**20
"""Largest size of a file from elsewhere [bytes]; it is read into memory at once."""
MOST_ROWS = 100_000
"""Most rows (one per run and input) of a file from elsewhere: ten times a season of 5,000 runs."""
_ENCODINGS = frozenset({"PLAIN", "RLE", "RLE_DICTIONARY", "PLAIN_DICTIONARY", "BIT_PACKED"})
_LONGEST_TEXT = 1024
"""Longest text in a file from elsewhere [bytes]; names of vehicles and terrains have some tens."""
_LARGEST_PART = 10**9
"""Upper limit of the parts of a version number: larger ones compare as equal."""
_PARTS = ("sha256", "input")
_STORED = {pl.String(): "BYTE_ARRAY", pl.Float64(): "DOUBLE", pl.Int64(): "INT64"}


def write_features(frame: pl.DataFrame, path: Path) -> None:
    """Write features and replace the previous file.

    Raises:
        ComparisonError: ``not_written``.
    """
    from pipeline.store.files import replace_file  # noqa: PLC0415 - heavy
    from pipeline.store.parquet_tables import encode_parquet  # noqa: PLC0415

    what, hint = "the file cannot be written", "Choose another file."
    with naming_os_errors(ComparisonError, "not_written", what, where=path, hint=hint):
        replace_file(path, encode_parquet(contract_of("features"), frame, compression="none"))


def check_features(frame: pl.DataFrame, where: str) -> pl.DataFrame:
    """Return the rows if all of them satisfy the contract.

    Raises:
        ComparisonError: ``bad_features``.
    """
    valid, failure = Features.filter(frame)
    if len(failure):
        rules = ", ".join(sorted(failure.counts()))
        raise _refuse(where, f"{len(failure)} of {frame.height} rows break the contract ({rules})")
    return valid


def read_features(path: Path) -> pl.DataFrame:
    """Read features from an untrusted file.

    Raises:
        ComparisonError: ``bad_features``: the reason for the rejection.
    """
    import pyarrow as pa  # noqa: PLC0415 - heavy

    data = _read_small(path)
    try:
        table = _open_table(data, str(path))
        table = _write_out_texts(table, str(path))
        # Invalid UTF-8, in rows or in the schema, would end the program later.
        table.validate(full=True)
        frame = pl.from_arrow(pa.Table.from_arrays(table.columns, names=table.column_names))
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, pl.exceptions.PolarsError) as error:
        lines = str(error).splitlines()[:1] or [type(error).__name__]
        raise _refuse(str(path), f"it cannot be read: {lines[0][:200]}") from error
    wanted = Features.create_empty().schema
    if not isinstance(frame, pl.DataFrame) or dict(frame.schema) != dict(wanted):
        raise _refuse(str(path), "its columns are of other types than the contract's")
    return check_features(frame.select(wanted.names()), str(path))


def _read_small(path: Path) -> bytes:
    """Bytes of a regular file of limited size; never blocks on pipes or devices."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError as error:
        raise _refuse(str(path), f"it cannot be opened: {error.strerror}") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _refuse(str(path), "it is not a regular file")
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(LARGEST_BYTES + 1)
    if len(data) > LARGEST_BYTES:
        raise _refuse(str(path), f"it is larger than {LARGEST_BYTES >> 20} MB")
    if data[:4] != MAGIC:
        raise _refuse(str(path), "it is not a Parquet file")
    return data


def _open_table(data: bytes, where: str) -> pa.Table:
    import pyarrow as pa  # noqa: PLC0415 - heavy
    import pyarrow.parquet as pq  # noqa: PLC0415 - heavy

    texts = [name for name, kind in Features.create_empty().schema.items() if kind == pl.String]
    file = pq.ParquetFile(
        pa.BufferReader(data), thrift_string_size_limit=2**20, thrift_container_size_limit=2**16,
        read_dictionary=texts,
    )  # fmt: skip
    about, contract = file.metadata, contract_of("features")
    metadata = {key: value for key, value in (about.metadata or {}).items() if key != b"ARROW:schema"}
    version = metadata.get(b"contract_version", b"").decode("utf-8", "replace")[:20]
    if metadata.get(b"contract") != b"features" or version != str(contract.version):
        raise _refuse(where, f"it is not of version {contract.version} of the contract `features`")
    if about.num_rows > MOST_ROWS:
        raise _refuse(where, f"it has more than {MOST_ROWS} rows")
    if sorted(file.schema_arrow.names) != sorted(Features.column_names()):
        raise _refuse(where, "its columns are not those of the contract")
    stored = {
        column.path: column.physical_type
        for column in (about.schema.column(i) for i in range(about.num_columns))
    }
    if stored != {name: _STORED[kind] for name, kind in Features.create_empty().schema.items()}:
        raise _refuse(where, "its columns are of other types than the contract's")
    ours = contract.metadata_of
    theirs = {
        name: (file.schema_arrow.field(name).metadata or {}).get(b"unit", b"")
        for name in file.schema_arrow.names
    }
    if wrong := sorted(name for name, unit in theirs.items() if unit != ours(name).get("unit", "").encode()):
        raise _refuse(where, f"units are others than the contract's: of {', '.join(wrong)}")
    groups = [about.row_group(group) for group in range(about.num_row_groups)]
    chunks = [group.column(column) for group in groups for column in range(about.num_columns)]
    # Chunk metadata decides what is read, not the totals that the file declares.
    if sum(chunk.num_values for chunk in chunks) != about.num_rows * about.num_columns:
        raise _refuse(where, "its parts hold other numbers of rows than it says")
    if sum(chunk.total_compressed_size for chunk in chunks) > len(data):
        raise _refuse(where, "its parts hold more bytes than it has")
    if any(chunk.compression != "UNCOMPRESSED" for chunk in chunks):
        raise _refuse(where, "a part of it is compressed, and might be anything")
    if odd := {encoding for chunk in chunks for encoding in chunk.encodings} - _ENCODINGS:
        raise _refuse(where, f"a part of it is encoded as {min(odd)}, and might be anything")
    # An error in one of several threads can abort the process.
    return file.read(use_threads=False)


def _write_out_texts(table: pa.Table, where: str) -> pa.Table:
    """Expand the dictionaries of the table to plain texts, if none of these is long."""
    import pyarrow as pa  # noqa: PLC0415 - heavy
    import pyarrow.compute as pc  # noqa: PLC0415 - heavy

    for index, field in enumerate(table.schema):
        if pa.types.is_dictionary(field.type):
            column = table.column(index)
            if any(
                (pc.max(pc.binary_length(chunk.dictionary)).as_py() or 0) > _LONGEST_TEXT
                for chunk in column.chunks
            ):
                raise _refuse(where, f"a text of {field.name} is longer than {_LONGEST_TEXT} bytes")
            table = table.set_column(index, field.name, column.cast(pa.large_string()))
    return table


def merge_features(frames: Sequence[pl.DataFrame], where: str) -> tuple[pl.DataFrame, int]:
    """Merge features of several files, sorted; return them and the number of duplicate rows.

    A log is identified by the hash of its content. If two versions of slip give different results for one
    log, the row of the later version remains. The results that a row comes from do not matter.

    Raises:
        ComparisonError: ``bad_features``: one version has different rows for the same log.
    """
    columns = [name for name in Features.column_names() if name != "from_results"]
    joined = pl.concat(frames).sort("from_results").unique(columns, keep="first", maintain_order=True)
    newest = pl.col("made_by").map_elements(_order_version, return_dtype=pl.List(pl.Int64))
    ranked = joined.with_columns(newest.alias("order")).sort(*_PARTS, "order")
    last = ranked.filter(pl.col("order") == pl.col("order").last().over(_PARTS)).drop("order")
    twice = last.filter(last.select(_PARTS).is_duplicated())
    if twice.height:
        logs = ", ".join(twice["run"].unique().sort().head(5))
        counts = twice.group_by(_PARTS).n_unique()
        differ = ", ".join(name for name in columns if name not in _PARTS and (counts[name] > 1).any())
        raise _refuse(where, f"they contradict each other on the logs {logs}, in {differ}")
    return last, sum(frame.height for frame in frames) - last.height


def _order_version(text: str) -> list[int]:
    return [min(int(part), _LARGEST_PART) if part.isdigit() else -1 for part in text.split(".")][:8]


def _refuse(where: str, why: str) -> ComparisonError:
    return ComparisonError(
        "bad_features", f"these features are not taken: {why}", where=where,
        hint="Have them made again: slip fleet share --file features.parquet.",
    )  # fmt: skip


_STIFFNESS = 0.8
"""Lambda of the published smoothing spline; it halves the amplitude of a motion of 0.36 Hz."""
_PERIOD = WINDOW_S / PUBLISHED_SAMPLES
_TAUS = (0.05, 3.0)
"""Bounds of the powertrain's time constant [s]: the published ones are 0.6 to 1.1, see `follow_published`."""
_SLOW_SHARE = 0.5
"""Share of the steps to use, the slower ones: in fast ones limits lower the ratio."""
_SMALLEST = 0.05
"""Command [m/s, rad/s] below which a ratio to it is noise."""
_OFF_RATE = 0.01
"""Relative tolerance of the rate of 20 Hz: the chain is defined for 40 samples in 2 s."""


@dataclass(frozen=True)
class Limits:
    """Vehicle data of the published chain.

    Attributes:
        speed_mps: limit of the body command's speed; None if unknown.
        yaw_rate_radps: limit of its yaw rate; None if unknown.
        track_m: track width, which converts a yaw rate into a difference of wheel speeds.
    """

    speed_mps: float | None
    yaw_rate_radps: float | None
    track_m: float


@dataclass(frozen=True)
class PublishedRun:
    """Result of the published chain for a run.

    Attributes:
        norms: one row per window: ``t_start`` [s], ``segment``, ``step``, ``window_norm`` [m/s].
        tau_s: fitted time constant of the wheels.
        scale: factors of the body command, (forward, yaw rate).
    """

    norms: pl.DataFrame
    tau_s: float
    scale: tuple[float, float]


@dataclass(frozen=True)
class _Steps:
    """Command steps as rows of a matrix: sample indices, -1 beyond a step's end."""

    index: Ints

    def lay_out(self, values: Floats) -> Floats:
        """Values (n, 2) as (steps, longest, 2); the last sample of a step is repeated beyond its end."""
        return values[np.where(self.index < 0, self.index.max(axis=1, keepdims=True), self.index)]


def follow_published(
    slip: pl.DataFrame, poses: pl.DataFrame, *, limits: Limits, command_is_scaled: bool
) -> PublishedRun | None:
    """Window norms of one run by the published chain, with the pose's yaw rate.

    - u: the body command, clipped, through a first-order lag with one time constant for both wheels, over the
      whole command step, starting from the measured wheel speeds. The time constant minimizes the mean
      absolute error between the lagged command and the measured wheels of the run (0.05 to 3 s).
    - If the log's command is known to be scaled wrongly (finding `command_scale`), forward speed and yaw
      rate are first multiplied by their measured ratios in slow steady steps.
    - v: x, y and yaw of the poses as recorded, held ones too, at 20 Hz; per window of 40 samples a smoothing
      spline with lambda 0.8 over t from 0 to 2 s; forward differences, rotated by the smoothed heading at
      their start, the last value repeated.
    - The norm of a window is that of its 3 x 40 slips, with L = 1 m. No window is excluded as suspect.

    Args:
        slip: table `slip` of the run, both inputs.
        poses: table `poses` of the run.
        limits: limits of the vehicle's body command.
        command_is_scaled: whether the run has the finding `command_scale`.

    Returns:
        None if the run has no command, no measured wheels, no whole window, or a rate other than 20 Hz.
    """
    both = _join_inputs(slip)
    if both.height < PUBLISHED_SAMPLES or abs(float(both["t"].diff().median()) / _PERIOD - 1.0) > _OFF_RATE:  # type: ignore[arg-type]
        return None
    steps = _find_steps(both)
    command, measured = both.select("f_x", "f_w").to_numpy(), both.select("m_x", "m_w").to_numpy()
    scale = _find_scale(both) if command_is_scaled else (1.0, 1.0)
    bounds = [np.inf if end is None else end for end in (limits.speed_mps, limits.yaw_rate_radps)]
    asked = steps.lay_out(np.clip(command * scale, [-end for end in bounds], bounds))
    got = steps.lay_out(measured)
    sides = np.array([[1.0, 1.0], [-0.5, 0.5]]) * np.array([[1.0], [limits.track_m]])
    tau = _fit_lag(asked @ sides, got @ sides, steps.index >= 0)
    driven = _lag(asked, got[:, 0], tau)
    windows = _cut_windows(steps.index)
    if not windows.size:
        return None
    input_velocity = np.empty_like(command)
    there = steps.index >= 0
    input_velocity[steps.index[there]] = driven[there]
    norms = _measure_windows(both, poses, input_velocity, windows)
    first = windows[:, 0]
    frame = both[first].select(pl.col("t").alias("t_start"), "segment", "step")
    return PublishedRun(frame.with_columns(pl.Series("window_norm", norms)), tau, scale)


def _join_inputs(slip: pl.DataFrame) -> pl.DataFrame:
    wheels = slip.filter(pl.col("input") == "measured").select(
        "stamp", pl.col("f_x").alias("m_x"), pl.col("f_w").alias("m_w")
    )
    return slip.filter(pl.col("input") == "command").join(wheels, on="stamp").sort("t")


def _find_steps(both: pl.DataFrame) -> _Steps:
    """A step ends where its number changes or a sample is missing."""
    number, times = both["step"].to_numpy(), both["t"].to_numpy()
    starts = np.flatnonzero(
        np.concatenate(([True], (np.diff(number) != 0) | (np.diff(times) > 1.5 * _PERIOD)))
    )
    sizes = np.diff(np.concatenate((starts, [number.size])))
    offset = np.arange(int(sizes.max()))
    index = starts[:, None] + offset[None, :]
    return _Steps(np.where(offset[None, :] < sizes[:, None], index, -1))


def _find_scale(both: pl.DataFrame) -> tuple[float, float]:
    """Ratio of measured to commanded motion, forward and turning, in the slower half of the steady steps."""
    means = both.filter(~pl.col("transitory")).group_by("step").agg(pl.col("f_x", "f_w", "m_x", "m_w").mean())
    scales = []
    for asked, got in (("f_x", "m_x"), ("f_w", "m_w")):
        live = means.filter(pl.col(asked).abs() > _SMALLEST)
        slow = live.filter(pl.col(asked).abs() <= pl.col(asked).abs().quantile(_SLOW_SHARE))
        ratio = slow.select((pl.col(got) / pl.col(asked)).median()).item()
        scales.append(1.0 if ratio is None or ratio <= 0.0 else float(ratio))
    return scales[0], scales[1]


def _fit_lag(asked: Floats, got: Floats, there: Flags) -> float:
    """Time constant [s] that minimizes the error of lagged wheel commands (left, right)."""
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - heavy

    def miss(tau: float) -> float:
        return float(np.mean(np.abs(_lag(asked, got[:, 0], tau) - got)[there]))

    return float(minimize_scalar(miss, bounds=_TAUS, method="bounded", options={"xatol": 0.01}).x)


def _lag(asked: Floats, start: Floats, tau: float) -> Floats:
    """First-order response to held values, along axis 1; exact for commands that are held over a sample."""
    from scipy.signal import lfilter  # noqa: PLC0415 - heavy

    keep = np.exp(-_PERIOD / tau)
    before = np.concatenate((start[:, None], asked[:, :-1]), axis=1)
    # The first output is the start itself: the filter state compensates for its first input.
    memory = keep * start[:, None]
    answer: Floats = lfilter([1.0 - keep], [1.0, -keep], before, axis=1, zi=memory)[0]
    return answer


def _cut_windows(index: Ints) -> Ints:
    """Whole windows from each step's start, as rows of sample indices."""
    whole = index[:, : index.shape[1] // PUBLISHED_SAMPLES * PUBLISHED_SAMPLES].reshape(-1, PUBLISHED_SAMPLES)
    return whole[whole[:, -1] >= 0]


def _measure_windows(both: pl.DataFrame, poses: pl.DataFrame, driven: Floats, windows: Ints) -> Floats:
    held = np.maximum(arrays.hold_indices(both["t"].to_numpy() + ROUNDING_S, poses["t"].to_numpy()), 0)
    turned = {name: poses[name].to_numpy()[held] for name in ("x", "y", "q_x", "q_y", "q_z", "q_w")}
    yaw = np.arctan2(
        2.0 * (turned["q_w"] * turned["q_z"] + turned["q_x"] * turned["q_y"]),
        1.0 - 2.0 * (turned["q_y"] ** 2 + turned["q_z"] ** 2),
    )
    smoother = _make_smoother()
    x, y, heading = (
        values @ smoother.T
        for values in (turned["x"][windows], turned["y"][windows], np.unwrap(yaw[windows], axis=1))
    )
    east, north, turn = (_difference(values) for values in (x, y, heading))
    cosine, sine = np.cos(heading), np.sin(heading)
    forward, sideways = cosine * east + sine * north, cosine * north - sine * east
    for velocity in (forward, sideways):
        velocity[:, -1] = velocity[:, -2]
    squares = (driven[windows, 0] - forward) ** 2 + sideways**2 + (driven[windows, 1] - turn) ** 2
    norms: Floats = np.sqrt(squares.sum(axis=1))
    return norms


def _difference(values: Floats) -> Floats:
    forward = np.diff(values, axis=1) / _PERIOD
    return np.concatenate((forward, forward[:, -1:]), axis=1)


@functools.cache
def _make_smoother() -> Floats:
    """The matrix (40, 40) of the smoothing spline: with fixed abscissae it is linear in the values."""
    from scipy.interpolate import make_smoothing_spline  # noqa: PLC0415 - heavy

    times = np.linspace(0.0, WINDOW_S, PUBLISHED_SAMPLES)
    columns = [
        make_smoothing_spline(times, unit, lam=_STIFFNESS)(times) for unit in np.eye(PUBLISHED_SAMPLES)
    ]
    return np.stack(columns, axis=1)


def read_limits(vehicle: Mapping[str, object]) -> Limits:
    """Limits of a vehicle from its manifest."""
    names = ("max_speed_mps", "max_yaw_rate_radps", "track_width_m")
    ends = [vehicle.get(name) for name in names]
    speed, turn, track = (float(end) if isinstance(end, (int, float)) else None for end in ends)
    return Limits(speed, turn, 1.0 if track is None else track)
