"""Frames that keep or break their contracts, for the tests of the store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.store.parquet_tables import schema_of

if TYPE_CHECKING:
    from pipeline.store import Manifest, Store

ROWS = 500


def make_slip(run: str, seed: int, rows: int = ROWS) -> pl.DataFrame:
    """Slip rows that keep the contract and depend on ``seed`` in every number."""
    random = np.random.default_rng(seed)
    ideal, measured = random.normal(size=(2, rows, 3))
    slip = ideal - measured
    columns: dict[str, object] = {
        **_say_who(run, rows),
        "input": ["command", "measured"] * (rows // 2),
        "t": np.arange(rows) * 0.05,
        "stamp": np.arange(rows) * 50_000_000,
        "segment": np.zeros(rows, int),
        "step": np.full(rows, seed),
        "transitory": np.arange(rows) % 3 == 0,
        "modulus": np.linalg.norm(slip, axis=1),
    }
    for at, axis in enumerate("xyw"):
        columns |= {f"f_{axis}": ideal[:, at], f"v_{axis}": measured[:, at], f"g_{axis}": slip[:, at]}
    return fit("slip", columns, rows)


def make_windows(run: str, seed: int, rows: int = ROWS) -> pl.DataFrame:
    """Windows that keep the contract; ``step`` is the seed."""
    start = np.arange(rows) * 2.0
    norm = np.random.default_rng(seed).uniform(size=rows)
    return fit(
        "windows",
        {
            **_say_who(run, rows),
            "input": ["measured"] * rows,
            "t_start": start,
            "t_end": start + 2.0,
            "segment": np.zeros(rows, int),
            "step": np.full(rows, seed),
            "transitory": np.zeros(rows, bool),
            "samples": np.full(rows, 40),
            "rms_modulus": norm,
            "window_norm": norm * np.sqrt(40.0),
        },
        rows,
    )


def break_windows(frame: pl.DataFrame) -> pl.DataFrame:
    """The frame with two rows that break three rules between them."""
    at = pl.int_range(pl.len())
    return frame.with_columns(
        terrain=pl.when(at == 1).then(None).otherwise(pl.col("terrain")),
        segment=pl.when(at == 3).then(-1).otherwise(pl.col("segment")).cast(pl.Int32),
        t_end=pl.when(at == 3).then(float("inf")).otherwise(pl.col("t_end")),
    )


def fit(table: str, columns: dict[str, object], rows: int = ROWS) -> pl.DataFrame:
    """Columns in the types and the order of a contract; those not given hold a neutral value."""
    schema = schema_of(table)
    filled = {name: columns.get(name, [_neutral(kind)] * rows) for name, kind in schema.items()}
    return pl.DataFrame(filled, schema=schema)


def _neutral(kind: pl.DataType) -> object:
    if isinstance(kind, pl.Enum):
        return kind.categories[0]
    if kind == pl.String:
        return "neutral"
    return False if kind == pl.Boolean else 0


def write_generation(store: Store, run: str, key: str, seed: int) -> Manifest:
    """Two tables and a text, all telling ``seed``."""
    with store.open_generation(run, key) as generation:
        generation.write_table("slip", make_slip(run, seed))
        generation.write_table("windows", break_windows(make_windows(run, seed)))
        generation.write_text("summary.json", f"{seed}\n")
        return generation.commit({"seed": seed})


def read_seed(store: Store, run: str) -> int | None:
    """The seed of the current generation, after checking that all of it tells the same one."""
    manifest = store.manifest(run)
    if manifest is None:
        return None
    seed = manifest.details["seed"]
    told = {
        *manifest.read("slip")["step"].unique(),
        *manifest.read("windows")["step"].unique(),
        int(manifest.path("summary.json").read_text()),
    }
    assert told == {seed}
    assert manifest.read("slip").height == ROWS
    assert isinstance(seed, int)
    return seed


def _say_who(run: str, rows: int) -> dict[str, object]:
    who = {"run": run, "dataset": "husky_tile", "vehicle": "husky_a200", "terrain": "tile"}
    return {name: [value] * rows for name, value in who.items()}
