"""What several figures draw from: the tables of a run, joined and thinned once."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from pipeline.report.run import RunReport
from pipeline.report.scales import round_up, usual_ends
from pipeline.report.thinning import break_lines, drop_flat_rows, find_spans, thin_series, thin_to_peaks

LINE_BINS = 1000
TRACK_BINS = 2400
COMPONENTS = ("x", "y", "w")

_DEFAULT_RATE_HZ = 20.0
_HOLE_PERIODS = 2.5
_WIDEST_PIXELS = 1200
_FAR_M = 10_000.0
_CAP_QUANTILE = 0.98
_WORST_S = 20.0


@dataclass(frozen=True)
class Thinned:
    """Rows to draw, and how many there were.

    Attributes:
        frame: the rows that are drawn, with those that break lines.
        drawn: how many points that are.
        total: the rows that they stand for.
        usual: where all but lone peaks of a line lie, before anything was left out.
    """

    frame: pl.DataFrame
    drawn: int
    total: int
    usual: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """A run's tables as figures need them; every part is worked out once, when it is first asked for."""

    report: RunReport

    @cached_property
    def period(self) -> float:
        """Time between two steps of the grid [s]."""
        return 1.0 / (self.report.number("rate_hz") or _DEFAULT_RATE_HZ)

    @cached_property
    def slip(self) -> dict[str, pl.DataFrame]:
        """Slip by input, in order of time, with ``piece``: a number for each stretch without a hole."""
        table = self.report.table("slip")
        if table is None:
            return {}
        if "suspect" not in table.columns:
            table = table.with_columns(suspect=pl.lit(value=False))
        found = {}
        for name in self.report.inputs:
            rows = table.filter(pl.col("input").cast(pl.String) == name)
            if not rows.is_empty():
                found[name] = self._number_pieces(rows)
        return found

    @cached_property
    def sound_slip(self) -> dict[str, pl.DataFrame]:
        """Slip by input without the suspect stretches: what medians are taken of."""
        sound = {name: frame.filter(~pl.col("suspect")) for name, frame in self.slip.items()}
        return {name: frame for name, frame in sound.items() if not frame.is_empty()}

    def median_modulus(self, name: str) -> float | None:
        """Median slip modulus on an input [m/s], suspect stretches left out."""
        frame = self.sound_slip.get(name)
        return None if frame is None else float(np.median(frame["modulus"].to_numpy()))

    @cached_property
    def main_slip(self) -> pl.DataFrame | None:
        """Slip of the leading input."""
        return self.slip.get(self.report.main_input)

    @cached_property
    def velocities(self) -> pl.DataFrame | None:
        """Velocities in order of time, with ``piece``."""
        table = self.report.table("velocities")
        return None if table is None else self._number_pieces(table)

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
        """Where the colour ramp of slip ends [m/s]: the 98th percentile, rounded up to two digits."""
        sound = self.sound_slip.get(self.report.main_input)
        if sound is None:
            return 1.0
        top = sound["modulus"].quantile(_CAP_QUANTILE) or 0.0
        return round_up(top) if top > 0.0 else 1.0

    @cached_property
    def worst_span(self) -> tuple[float, float] | None:
        """The 20 s with the most slip [s], lone peaks held; None where the run is hardly longer than that."""
        slip, domain = self.sound_slip.get(self.report.main_input), self.time_domain
        if slip is None or domain is None or domain[1] - domain[0] < 1.5 * _WORST_S:
            return None
        edges = np.arange(domain[0], domain[1] + 1.0, 1.0)
        squared = np.minimum(slip["modulus"].to_numpy(), self.modulus_cap) ** 2
        second = np.histogram(slip["t"].to_numpy(), edges, weights=squared)[0]
        width = int(_WORST_S)
        total = np.convolve(second, np.ones(width), mode="valid")
        start = min(float(edges[int(np.argmax(total))]), domain[1] - _WORST_S)
        return start, start + _WORST_S

    @cached_property
    def origin(self) -> tuple[float, float]:
        """What is taken off the map's coordinates [m]: nothing, or the start where that is far away."""
        if self.velocities is None:
            return 0.0, 0.0
        start = [float(self.velocities[axis][0]) for axis in "xy"]
        if max(abs(value) for value in start) < _FAR_M:
            return 0.0, 0.0
        return float(round(start[0])), float(round(start[1]))

    @cached_property
    def track(self) -> Thinned | None:
        """Where the vehicle was, what was asked and how much it slipped: ``t x y f_x f_w modulus piece``."""
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
            asked = self.main_slip.select("stamp", "segment", "f_x", "f_w", "modulus")
            asked = asked.unique(["stamp", "segment"], maintain_order=True)
            joined = places.join(asked, on=["stamp", "segment"], how="left", maintain_order="left")
        joined = joined.drop("stamp", "segment")
        peaks = joined.with_columns(peak=pl.col("modulus").fill_null(-1.0))
        thinned = thin_to_peaks(peaks, "peak", bins=TRACK_BINS).drop("peak")
        return Thinned(thinned, thinned.height, joined.height)

    @cached_property
    def modulus_lines(self) -> Thinned | None:
        """Slip modulus over time, long: ``t value series``, null where a line breaks."""
        return self._join_lines([(frame, "modulus", name) for name, frame in self.slip.items()])

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
        """Stretches that medians leave out, their poses being wrong: ``t_start t_end`` [s]."""
        return self._find_spans("suspect")

    def _find_spans(self, flag: str) -> pl.DataFrame:
        if self.main_slip is None or self.time_domain is None:
            return pl.DataFrame(schema={"t_start": pl.Float64, "t_end": pl.Float64})
        pixel = (self.time_domain[1] - self.time_domain[0]) / _WIDEST_PIXELS
        return find_spans(self.main_slip, flag, period=self.period, shortest_gap=pixel)

    def _number_pieces(self, frame: pl.DataFrame) -> pl.DataFrame:
        # By segment first: a clock that was set back makes segments overlap in time.
        ordered = frame.sort("segment", "t", maintain_order=True)
        hole = pl.col("t").diff() > _HOLE_PERIODS * self.period
        new = (hole | (pl.col("segment") != pl.col("segment").shift(1))).fill_null(value=False)
        return ordered.with_columns(piece=new.cum_sum().cast(pl.Int32))

    def _join_lines(self, lines: list[tuple[pl.DataFrame, str, str]]) -> Thinned | None:
        if not lines:
            return None
        parts, drawn, total, ends = [], 0, 0, []
        for frame, column, series in lines:
            # Flat stretches go first, so that a held command keeps its edges where they were.
            line = drop_flat_rows(frame.select("t", "piece", value=pl.col(column)), "value")
            thinned = thin_series(line, "value", bins=LINE_BINS, whole=self.worst_span)
            parts.append(break_lines(thinned, "value").with_columns(series=pl.lit(series)))
            drawn, total = drawn + thinned.height, total + line.height
            ends += usual_ends(frame[column], exact=column.startswith("f_"))
        return Thinned(pl.concat(parts), drawn, total, (min(ends), max(ends)))
