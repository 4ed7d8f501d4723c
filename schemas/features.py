"""What a deployment shares with others: its features, never its data."""

from typing import ClassVar

import dataframely as dy
import polars as pl

from schemas.contract import Table

_NAME = r"^[^\x00-\x1f\x7f/\\]{1,120}$"


def _text(pattern: str, description: str, *, nullable: bool = False) -> dy.String:
    """A text that looks like this."""
    return dy.String(nullable=nullable, regex=pattern, metadata={"description": description})


def _feature(
    unit: str, description: str, low: float = 0.0, high: float = 1e9, *, nullable: bool = True
) -> dy.Float64:
    """A number within what can be."""
    return dy.Float64(
        nullable=nullable,
        min=low,
        max=high,
        check=lambda value: value.is_finite(),
        metadata={"unit": unit, "description": description},
    )


class Features(Table):
    """One row a run and input; ``run`` is the beginning of the log's hash: no name of a file is shared."""

    VERSION: ClassVar[int] = 1

    run = _text(r"^[0-9a-f]{16}$", "first 16 digits of sha256")
    dataset = _text(_NAME, "runs of one vehicle on one terrain")
    vehicle = _text(_NAME, "vehicle name")
    terrain = _text(_NAME, "terrain name")
    input = _text("^(command|measured)$", "what u was: command or measured wheels")
    sha256 = _text(r"^[0-9a-f]{64}$", "SHA-256 of the log, which counts once")
    month = _text(r"^(19|20)\d\d-(0[1-9]|1[0-2])$", "month of the run", nullable=True)
    made_by = _text(r"^[0-9A-Za-z.+_-]{1,40}$", "version of slip")
    from_results = _text(r"^[0-9A-Za-z_-]{1,80}$", "key of the results: inputs and versions")
    mass = _feature("kg", "mass as configured", 0.01, 1e6)
    inertia = _feature("kg m^2", "yaw inertia of a plate of that mass, as wide as the track", 0.0, 1e8)
    length_scale = _feature("m", "L that turns yaw rate into speed in the modulus", 1e-3, 100.0)
    samples = dy.Int64(min=1, max=10**10, metadata={"description": "time steps"})
    windows = dy.Int64(min=0, max=10**9, nullable=True, metadata={"description": "2 s windows"})
    distance = _feature("m", "distance driven")
    duration = _feature("s", "time covered")
    median_modulus = _feature("m/s", "median slip modulus", 0.0, 1e3, nullable=False)
    median_window_norm = _feature("m/s", "median norm of 2 s windows", 0.0, 1e4)
    transitory_median_modulus = _feature("m/s", "after a change of command", 0.0, 1e3)
    steady_median_modulus = _feature("m/s", "away from changes of command", 0.0, 1e3)
    drivetrain_mean_square = _feature("m^2/s^2", "of f(command) - f(measured wheels)", 0.0, 1e6)
    ground_mean_square = _feature("m^2/s^2", "of f(measured wheels) - v", 0.0, 1e6)
    cross_mean_square = _feature("m^2/s^2", "twice the mean product of the two parts", -1e6, 1e6)
    height_rate = _feature("m/s", "height variation per second", 0.0, 1e3)
    largest_kinetic_energy = _feature("J", "largest 1/2 m v^2", 0.0, 1e10)
    relative_slip = _feature("1", "median modulus over ideal speed, while it moves", 0.0, 1e6)
    slip_energy = _feature("J", "median of 1/2 m |g_xy|^2 + 1/2 I g_w^2", 0.0, 1e12)
    lost_energy = _feature("1", "slip path over path driven: energy per metre and mass over mu g", 0.0, 1e9)
    unpredictability = _feature("m/s", "rms slip that a fitted slip model leaves, held out", 0.0, 1e3)
    relative_unpredictability = _feature("1", "unpredictability over rms ideal speed", 0.0, 1e6)
    transitory_slip = _feature("m", "slip path a change of command adds to the steady one", -1e6, 1e6)

    @dy.rule()
    def run_is_the_beginning_of_the_hash(cls) -> pl.Expr:  # noqa: N805 - rules receive the class
        return pl.col("sha256").str.slice(0, 16) == pl.col("run")
