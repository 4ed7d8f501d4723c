"""Columns that several contracts share, so that one quantity has one unit and one frame everywhere."""

from collections.abc import Iterator, Sequence
from functools import partial

import dataframely as dy
import polars as pl

LARGEST_NS = 2**62


def source(description: str = "what u was: the command or the measured wheels") -> dy.Enum:
    """Which input a row speaks of."""
    return choice(("command", "measured"), description)


def choice(words: Sequence[str], description: str) -> dy.Enum:
    """One of some words, never null."""
    return dy.Enum(words, metadata={"description": description})


def count(description: str, least: int = 0, *, nullable: bool = False) -> dy.Int64:
    """A whole number."""
    return dy.Int64(min=least, nullable=nullable, metadata={"description": description})


def name(description: str) -> dy.String:
    """A text that is never empty."""
    return dy.String(min_length=1, metadata={"description": description})


def stamp(frame: str = "log clock", description: str = "stamp of the sample") -> dy.Int64:
    """Time stamp, in the clock of the log if no other is said."""
    metadata = {"unit": "ns", "frame": frame, "description": description}
    return dy.Int64(min=-LARGEST_NS, max=LARGEST_NS, metadata=metadata)


def log_time() -> dy.Int64:
    """When the recorder wrote the message."""
    return stamp("recorder clock", "log time of the message")


def seconds(description: str = "time since the run's first sample") -> dy.Float64:
    """Seconds since the start of the run."""
    return number("s", description, frame="log clock")


def number(unit: str, description: str, *, frame: str = "", nullable: bool = False) -> dy.Float64:
    """A finite number with a unit; null only where ``nullable`` says so."""
    metadata = {"unit": unit, "description": description}
    if frame:
        metadata["frame"] = frame
    return dy.Float64(nullable=nullable, check=lambda value: value.is_finite(), metadata=metadata)


optional = partial(number, nullable=True)
"""A finite number with a unit, or null."""


def vector(unit: str, description: str, frame: str, size: int = 3) -> Iterator[dy.Float64]:
    """The components of a vector in a frame."""
    return (number(unit, description, frame=frame) for _ in range(size))


def bounded(
    unit: str,
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    nullable: bool = False,
) -> dy.Float64:
    """A number with a unit within what can be; one without bounds may be anything."""
    metadata = {"unit": unit, "description": description}
    return dy.Float64(nullable=nullable, min=low, max=high, metadata=metadata)


def body(unit: str, description: str, *, nullable: bool = False) -> dy.Float64:
    """A finite number in the body frame (x forward, y left, z up; REP-103)."""
    return number(unit, description, frame="base_link", nullable=nullable)


def text(description: str) -> dy.String:
    """A text that is always there, possibly empty."""
    return dy.String(metadata={"description": description})


def flag(description: str) -> dy.Bool:
    """Yes or no, never null."""
    return dy.Bool(metadata={"description": description})


def segment() -> dy.Int32:
    """Stretch without gap, clock jump or pose jump."""
    return dy.Int32(min=0, metadata={"description": "number of the segment; nothing crosses its ends"})


def step() -> dy.Int32:
    """Stretch of one command."""
    return dy.Int32(min=0, metadata={"description": "number of the command step within the run"})


def drive_is_complete() -> pl.Expr:
    """Either both wheel speeds or speed and steering angle are there."""
    wheels = pl.col("left").is_not_null() & pl.col("right").is_not_null()
    return wheels | (pl.col("speed").is_not_null() & pl.col("steering").is_not_null())
