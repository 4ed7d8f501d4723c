"""Data of a report: summary and tables of a run, joined and thinned once for all figures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.core import ROUNDING_S, mapping_in, number_in, objects_in
from pipeline.report.motion_view import MotionView
from pipeline.report.theme import round_up, usual_ends
from pipeline.results import RunDiagnosis, find_refusal, read_findings
from pipeline.run import HORIZON_S
from pipeline.sources import VelocitySection
from pipeline.words import format_finding
from schemas.run_tables import COUNTED

INPUTS = ("command", "measured")
NOT_DIAGNOSED = RunDiagnosis()


@dataclass(frozen=True)
class RunReport:
    """Run as the source of a report.

    Attributes:
        summary: the JSON object of one run of ``slip analyze --json``.
        tables: tables by contract name (`commands`, `slip`, `windows`, ...); any may be missing or empty.
        diagnosis: of the run; empty without one.
        motion: a model of the run; None without one.
        peers: median slip moduli [m/s] of comparable runs by input; empty without any.
        catalogue: relative address of the page over all runs; empty without one.
        planned: preview of the drive planned after it; empty without one.
    """

    summary: Mapping[str, object]
    tables: Mapping[str, pl.DataFrame] = field(default_factory=dict)
    diagnosis: RunDiagnosis = NOT_DIAGNOSED
    motion: MotionView | None = None
    peers: Mapping[str, Sequence[float]] = field(default_factory=dict)
    catalogue: str = ""
    planned: Mapping[str, object] = field(default_factory=dict)

    def table(self, name: str) -> pl.DataFrame | None:
        """Table with rows, or None."""
        frame = self.tables.get(name)
        return None if frame is None or frame.is_empty() else frame

    @property
    def main_input(self) -> str:
        """Leading input: the one given in the summary, or the command if both are available."""
        wanted = self.text("input")
        there = self.inputs
        if wanted in there:
            return wanted
        return there[0] if there else "command"

    @property
    def inputs(self) -> list[str]:
        """Inputs with values or slip, command first."""
        names = set(self.part("by_input"))
        slip = self.table("slip")
        if slip is not None:
            names |= set(slip["input"].cast(str).unique())
        return [name for name in INPUTS if name in names]

    @property
    def is_diagnosed(self) -> bool:
        """Whether the run was diagnosed."""
        return bool(self.diagnosis.run)

    @property
    def verdict(self) -> str:
        """Verdict on the run; empty without a diagnosis."""
        from pipeline.words import format_verdict  # noqa: PLC0415 - heavy

        return format_verdict(self.diagnosis) if self.is_diagnosed else self.text("verdict")

    @property
    def refusal(self) -> str:
        """Finding that makes every fit to the run meaningless; empty without one."""
        refusal = find_refusal(read_findings(self.summary))
        return "" if refusal is None else format_finding(refusal)

    def text(self, key: str) -> str:
        """Text of the summary; empty if missing."""
        value = self.summary.get(key)
        return value if isinstance(value, str) else ""

    def number(self, key: str) -> float | None:
        """Number of the summary, or None."""
        return number_in(self.summary, key)

    def part(self, key: str) -> Mapping[str, object]:
        """Object in the summary; empty if missing."""
        return mapping_in(self.summary, key)

    def items(self, key: str) -> list[Mapping[str, object]]:
        """List of objects in the summary; empty if missing."""
        return objects_in(self.summary, key)


_BIN = "_bin"
_ROW = "_row"
_KEPT_PER_BIN = 4


def drop_flat_rows(frame: pl.DataFrame, value: str) -> pl.DataFrame:
    """Drop rows that equal both neighbours: the line through the others is the same.

    Args:
        frame: rows in order of ``t`` [s] with ``piece``; lines do not cross pieces.
        value: column to draw.
    """
    column, piece = pl.col(value), pl.col("piece")
    flat = [(column == column.shift(by)) & (piece == piece.shift(by)) for by in (1, -1)]
    return frame.filter(~(flat[0] & flat[1]).fill_null(value=False))


def thin_series(
    frame: pl.DataFrame, value: str, *, bins: int, whole: tuple[float, float] | None = None
) -> pl.DataFrame:
    """Thin a line to the first, last, lowest and highest row of every time bin.

    A line through them looks the same at ``bins`` pixels (Jugel et al., VLDB 2014, "M4").

    Args:
        frame: rows in order of ``t`` [s] with ``piece``; lines do not cross pieces.
        value: column to draw.
        bins: number of equal bins over the whole span of ``t``.
        whole: stretch [s] in which every row remains.

    Returns:
        Rows of ``frame`` in their order; all of them if there are at most four per bin.
    """
    if frame.height <= _KEPT_PER_BIN * bins:
        return frame
    row, column = pl.col(_ROW), pl.col(value)
    picks = [row.first(), row.last(), row.get(column.arg_min()), row.get(column.arg_max())]
    binned = _number_bins(frame, bins).group_by(_BIN, "piece").agg(pl.concat_list(picks).explode())[_ROW]
    rows = binned.explode()
    if whole is not None:
        rows = rows.append(frame.with_row_index(_ROW).filter(pl.col("t").is_between(*whole))[_ROW])
    return frame[rows.unique().sort()]


def thin_to_peaks(frame: pl.DataFrame, value: str, *, bins: int) -> pl.DataFrame:
    """Thin to the row with the largest ``value`` of every time bin and piece.

    Args:
        frame: rows in order of ``t`` [s] with ``piece``.
        value: column whose peaks remain.
        bins: number of equal bins over the whole span of ``t``.

    Returns:
        Rows of ``frame`` in their order; all of them if there are at most ``bins``.
    """
    if frame.height <= bins:
        return frame
    rows = (
        _number_bins(frame, bins)
        .group_by(_BIN, "piece")
        .agg(pl.col(_ROW).get(pl.col(value).arg_max()))[_ROW]
        .sort()
    )
    return frame[rows]


def break_lines(frame: pl.DataFrame, *columns: str) -> pl.DataFrame:
    """Append a row of nulls to every piece but the last, which breaks the line there.

    Args:
        frame: rows in order, with ``piece``.
        columns: columns to draw.

    Returns:
        The rows without ``piece``, which is no longer needed: one broken line is drawn much faster than a
        separate line per piece.
    """
    ends = frame.filter(pl.col("piece") != pl.col("piece").shift(-1))
    gaps = ends.with_columns(pl.lit(None, frame.schema[name]).alias(name) for name in columns)
    both = pl.concat(
        [frame.with_columns(_gap=pl.lit(value=False)), gaps.with_columns(_gap=pl.lit(value=True))]
    )
    return both.sort("piece", "_gap", maintain_order=True).drop("piece", "_gap")


def find_spans(frame: pl.DataFrame, flag: str, *, period: float, shortest_gap: float = 0.0) -> pl.DataFrame:
    """Stretches of consecutive rows where a flag is set.

    Args:
        frame: rows in order of ``t`` [s] with ``segment``.
        flag: boolean column.
        period: duration of one row [s]; a span ends one period after its last row.
        shortest_gap: spans closer than this [s] are merged.

    Returns:
        Columns ``t_start``, ``t_end`` [s].
    """
    marked = frame.filter(pl.col(flag)).select("t", "segment")
    far = (pl.col("t") - pl.col("t").shift(1)).abs() > max(1.5 * period, shortest_gap)
    other = (pl.col("segment") != pl.col("segment").shift(1)) & (shortest_gap <= period)
    return (
        marked.with_columns(span=(far | other).fill_null(value=True).cum_sum())
        .group_by("span", maintain_order=True)
        .agg(t_start=pl.col("t").min(), t_end=pl.col("t").max() + period)
        .drop("span")
    )


def _number_bins(frame: pl.DataFrame, bins: int) -> pl.DataFrame:
    start, end = frame.select(low=pl.col("t").min(), high=pl.col("t").max()).row(0)
    width = math.nextafter((end - start) / bins, math.inf) or 1.0
    number = ((pl.col("t") - start) / width).cast(pl.Int64)
    return frame.with_row_index(_ROW).with_columns(number.alias(_BIN))


LINE_BINS = 1000
TRACK_BINS = 2400
COMPONENTS = ("x", "y", "w")

_DEFAULT_RATE_HZ = 20.0
_HOLE_PERIODS = 2.5
_WIDEST_PIXELS = 1200
_FAR_M = 10_000.0
CAP_QUANTILE = 0.98
"""Quantile at the upper end of colours: a few samples of a stuck vehicle would dominate the scale."""
_WORST_S = 20
STRETCH_S = 30.0
_FEWEST = 5
"""Smallest number of predictions of a ranked stretch."""


@dataclass(frozen=True)
class Thinned:
    """Rows to draw, and their original number.

    Attributes:
        frame: rows to draw, including those that break lines.
        drawn: number of points drawn.
        total: number of rows that they represent.
        usual: range of a line without isolated peaks, before thinning.
    """

    frame: pl.DataFrame
    drawn: int
    total: int
    usual: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """Tables of a run in the form that figures need; every part is computed once, on first use.

    Attributes:
        report: the run.
        stretch_number: index of the half minute that is drawn large, 0 for that with the largest error.
        ideal_cap: end of the colour scale of slip [m/s] where it is to be the same for every model.
    """

    report: RunReport
    stretch_number: int = 0
    ideal_cap: float | None = None

    @cached_property
    def period(self) -> float:
        """Time between two steps of the grid [s]."""
        return 1.0 / (self.report.number("rate_hz") or _DEFAULT_RATE_HZ)

    @cached_property
    def one_sided_s(self) -> float:
        """Distance from the end of a segment [s] below which velocities rest on poses of one side.

        A fit to 4 poses of one side has several times the error of one in their middle. Two other fits were
        tried: a window that stays whole, and curvatures that are pulled to zero by the noise; both are worse
        where poses are known to a centimetre. So the tables have what was fitted, and figures leave it out.
        """
        configuration = mapping_in(self.report.part("provenance"), "configuration")
        width = number_in(mapping_in(configuration, "velocity"), "window_s")
        return 0.5 * (width or VelocitySection().window_s)

    @cached_property
    def slip(self) -> dict[str, pl.DataFrame]:
        """Slip by input, in order of time, with ``piece``: a number for each stretch without a gap.

        ``end`` says that a row is near the end of a segment, as `one_sided_s`.
        """
        table = self.report.table("slip")
        if table is None:
            return {}
        absent = {"suspect", "standing"}.difference(table.columns)
        table = table.with_columns(pl.lit(value=False).alias(name) for name in sorted(absent))
        tables = {}
        for name in self.report.inputs:
            rows = table.filter(pl.col("input").cast(pl.String) == name)
            if not rows.is_empty():
                tables[name] = self._number_pieces(rows)
        return tables

    @cached_property
    def sound_slip(self) -> dict[str, pl.DataFrame]:
        """Slip by input without suspect stretches and those at rest: the basis of medians."""
        sound = {name: frame.filter(COUNTED) for name, frame in self.slip.items()}
        return {name: frame for name, frame in sound.items() if not frame.is_empty()}

    def median_modulus(self, name: str) -> float | None:
        """Median slip modulus on an input [m/s]; see `sound_slip`."""
        frame = self.sound_slip.get(name)
        return None if frame is None else float(np.median(frame["modulus"].to_numpy()))

    @cached_property
    def main_slip(self) -> pl.DataFrame | None:
        """Slip of the leading input."""
        return self.slip.get(self.report.main_input)

    @cached_property
    def main_residual(self) -> pl.DataFrame | None:
        """Slip of the leading input where a model was followed; None without a model."""
        known = None if self.main_slip is None else self.main_slip.drop_nulls("residual_modulus")
        return None if known is None or known.is_empty() else known

    @cached_property
    def velocities(self) -> pl.DataFrame | None:
        """Places in order of time, with ``piece``, and velocities, null where they are not to be drawn."""
        table = self.report.table("velocities")
        if table is None:
            return None
        numbered = self._number_pieces(table)
        # A wrong pose, often at the end of a segment, is no speed.
        wrong = pl.col("end") | (pl.col("outlier") if "outlier" in table.columns else pl.lit(value=False))
        shown = [pl.when(~wrong).then(f"v_{name}").alias(f"v_{name}") for name in COMPONENTS]
        return numbered.with_columns(shown)

    @cached_property
    def time_domain(self) -> tuple[float, float] | None:
        """First and last time of anything drawn over time [s]."""
        frames = [*self.slip.values()] + ([] if self.velocities is None else [self.velocities])
        if not frames:
            return None
        ends = [frame.select(low=pl.col("t").min(), high=pl.col("t").max()).row(0) for frame in frames]
        start, end = min(float(low) for low, _ in ends), max(float(high) for _, high in ends)
        return start, max(end, start + self.period)

    @cached_property
    def modulus_cap(self) -> float:
        """Upper end of the slip colour ramp [m/s]: the 98th percentile, rounded up to two digits."""
        if self.ideal_cap is not None:
            return self.ideal_cap
        sound = self.sound_slip.get(self.report.main_input)
        if sound is None:
            return 1.0
        top = sound["modulus"].quantile(CAP_QUANTILE) or 0.0
        return round_up(top) if top > 0.0 else 1.0

    @cached_property
    def worst_span(self) -> tuple[float, float] | None:
        """The 20 s with the most slip [s], with peaks clipped; None if the run is hardly longer than that."""
        slip, domain = self.sound_slip.get(self.report.main_input), self.time_domain
        if slip is None or domain is None or domain[1] - domain[0] < 1.5 * _WORST_S:
            return None
        second = (pl.col("t") - domain[0]).floor().cast(pl.Int64).alias("second")
        square = pl.col("modulus").clip(upper_bound=self.modulus_cap) ** 2
        seconds = slip.group_by(second).agg(square.sum().alias("square")).sort("second")
        totals = seconds.select(pl.col("square").rolling_sum_by("second", f"{_WORST_S}i"))["square"]
        # The worst span ends with a second that has slip, however long there was none.
        end = int(seconds["second"][totals.arg_max() or 0]) + 1
        start = domain[0] + max(end - _WORST_S, 0)
        start = min(start, domain[1] - _WORST_S)
        return start, start + _WORST_S

    @cached_property
    def stretches(self) -> list[tuple[float, float]]:
        """Stretches of half a minute [s], in order of decreasing error of the ideal model."""
        errors = None if self.report.motion is None else self.report.motion.horizon_errors
        if errors is None or errors.is_empty():
            return []
        first = float(errors["t"].min() or 0.0)  # type: ignore[arg-type]
        number = ((pl.col("t") - first) / STRETCH_S).floor().cast(pl.Int64)
        ranked = (
            errors.group_by(number=number)
            .agg(error=(pl.col("ideal") ** 2).mean(), count=pl.len())
            .with_columns(few=pl.col("count") < _FEWEST)
            .sort("few", pl.col("error") * -1.0, "number")
        )
        starts = [first + STRETCH_S * number for number in ranked["number"].to_list()]
        end = float(errors["t"].max() or 0.0) + HORIZON_S  # type: ignore[arg-type]
        # The last stretch starts earlier to have the full length.
        begins = [max(min(start, end - STRETCH_S), first) for start in starts]
        return [(start, min(start + STRETCH_S, end)) for start in begins]

    @cached_property
    def stretch(self) -> tuple[float, float] | None:
        """The half minute that is drawn large [s]; None without predictions of a model."""
        return self.stretches[self.stretch_number % len(self.stretches)] if self.stretches else None

    @cached_property
    def driven(self) -> pl.DataFrame:
        """Positions of the vehicle in the stretch: ``t x y piece``."""
        if self.velocities is None or self.stretch is None:
            return pl.DataFrame(schema={"t": pl.Float64, "x": pl.Float64, "y": pl.Float64, "piece": pl.Int32})
        east, north = self.origin
        inside = self.velocities.filter(pl.col("t").is_between(*self.stretch))
        return inside.select("t", pl.col("x") - east, pl.col("y") - north, "piece").drop_nulls()

    def cut_arcs(self, arcs: pl.DataFrame) -> pl.DataFrame:
        """The predicted paths that start in the stretch."""
        if self.stretch is None or arcs.is_empty():
            return arcs
        east, north = self.origin
        low, high = self.stretch
        begins = pl.col("t").first().over("piece")
        inside = arcs.filter((begins >= low) & (begins < high))
        return inside.with_columns(pl.col("x") - east, pl.col("y") - north)

    @cached_property
    def origin(self) -> tuple[float, float]:
        """Origin subtracted from map coordinates [m]: zero, or the start if that is far away."""
        if self.velocities is None:
            return 0.0, 0.0
        start = [float(self.velocities[axis][0]) for axis in "xy"]
        if max(abs(value) for value in start) < _FAR_M:
            return 0.0, 0.0
        return float(round(start[0])), float(round(start[1]))

    @cached_property
    def track(self) -> Thinned | None:
        """Position, command and slip of the vehicle: ``t x y f_x f_w modulus piece``."""
        if self.velocities is None:
            return None
        east, north = self.origin
        places = self.velocities.select(
            "t", "stamp", "segment", "piece", x=pl.col("x") - east, y=pl.col("y") - north
        )
        if self.main_slip is None:
            columns = [pl.lit(None, pl.Float64).alias(name) for name in ("f_x", "f_w", "modulus")]
            joined = places.with_columns(columns)
        else:
            sound = pl.when(~pl.col("suspect") & ~pl.col("end")).then("modulus").alias("modulus")
            asked = self.main_slip.select("stamp", "segment", "f_x", "f_w", sound)
            asked = asked.unique(["stamp", "segment"], maintain_order=True)
            joined = places.join(asked, on=["stamp", "segment"], how="left", maintain_order="left")
        joined = joined.drop("stamp", "segment")
        peaks = joined.with_columns(peak=pl.col("modulus").fill_null(-1.0))
        thinned = thin_to_peaks(peaks, "peak", bins=TRACK_BINS).drop("peak")
        return Thinned(thinned, thinned.height, joined.height)

    @cached_property
    def modulus_lines(self) -> Thinned | None:
        """Slip modulus over time, long: ``t value series``, null where a line breaks.

        The series `model` is what the model leaves.
        """
        lines = [(frame, "modulus", name) for name, frame in self.slip.items()]
        if self.main_residual is not None:
            lines.append((self.main_residual, "residual_modulus", "model"))
        inside = pl.col("end").not_()
        return self._join_lines(
            [
                (frame.with_columns(pl.when(inside).then(name).alias(name)), name, series)
                for frame, name, series in lines
            ]
        )

    def component_lines(self, component: str) -> Thinned | None:
        """Velocities of `x`, `y` or `w` over time, long: ``t value series``, null where a line breaks."""
        measured = self.velocities if self.velocities is not None else self.main_slip
        lines = [] if measured is None else [(measured, f"v_{component}", "velocity")]
        return self._join_lines(
            [(frame, f"f_{component}", name) for name, frame in self.slip.items()] + lines
        )

    @cached_property
    def transitory_spans(self) -> pl.DataFrame:
        """Stretches after a change of command: ``t_start t_end`` [s]."""
        return self._find_spans("transitory")

    @cached_property
    def suspect_spans(self) -> pl.DataFrame:
        """Stretches excluded from medians, incidents or wrong poses: ``t_start t_end`` [s]."""
        return self._find_spans("suspect")

    def _find_spans(self, flag: str) -> pl.DataFrame:
        if self.main_slip is None or self.time_domain is None:
            return pl.DataFrame(schema={"t_start": pl.Float64, "t_end": pl.Float64})
        pixel = (self.time_domain[1] - self.time_domain[0]) / _WIDEST_PIXELS
        return find_spans(self.main_slip, flag, period=self.period, shortest_gap=pixel)

    def _number_pieces(self, frame: pl.DataFrame) -> pl.DataFrame:
        # By segment first: after a backward jump of the clock, segments overlap in time.
        ordered = frame.sort("segment", "t", maintain_order=True)
        hole = pl.col("t").diff() > _HOLE_PERIODS * self.period
        new = (hole | (pl.col("segment") != pl.col("segment").shift(1))).fill_null(value=False)
        t = pl.col("t")
        away = pl.min_horizontal(t - t.min().over("segment"), t.max().over("segment") - t)
        return ordered.with_columns(
            piece=new.cum_sum().cast(pl.Int32), end=away < self.one_sided_s - ROUNDING_S
        )

    def _join_lines(self, lines: list[tuple[pl.DataFrame, str, str]]) -> Thinned | None:
        lines = [one for one in lines if one[0][one[1]].count()]
        if not lines:
            return None
        parts, drawn, total, ends = [], 0, 0, list[float]()
        for frame, column, series in lines:
            # Constant stretches are thinned first, so that a held command keeps its edges.
            line = drop_flat_rows(frame.select("t", "piece", value=pl.col(column)), "value")
            thinned = thin_series(line, "value", bins=LINE_BINS, whole=self.worst_span)
            parts.append(break_lines(thinned, "value").with_columns(series=pl.lit(series)))
            drawn, total = drawn + thinned.height, total + line.height
            ends += usual_ends(frame[column].drop_nulls(), exact=column.startswith("f_"))
        return Thinned(pl.concat(parts), drawn, total, (min(ends), max(ends)))
