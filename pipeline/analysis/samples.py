"""The samples that tests look at, run by run."""

import numpy as np
import polars as pl

from pipeline.analysis.compared_runs import ComparedRuns
from pipeline.core.arrays import Ints
from pipeline.fleet.pairs import Samples
from pipeline.fleet.published import WINDOW_S, follow_published, read_limits

_FEWEST = 2


def read_moduli(compared: ComparedRuns, input_name: str) -> dict[str, Samples]:
    """Slip moduli of every run on one input, suspect samples left out.

    Args:
        compared: the runs.
        input_name: `command` or `measured`.
    """
    parts = _split_by_run(compared, "slip", input_name, time="t", value="modulus")
    return {run: _take_samples(part) for run, part in parts.items()}


def read_norms(compared: ComparedRuns, input_name: str) -> dict[str, Samples]:
    """2 s window norms of every run on one input, suspect windows left out.

    Args:
        compared: the runs.
        input_name: `command` or `measured`.
    """
    parts = _split_by_run(compared, "windows", input_name, time="t_start", value="window_norm")
    return {run: _take_windows(part) for run, part in parts.items()}


def _split_by_run(
    compared: ComparedRuns, table: str, input_name: str, *, time: str, value: str
) -> dict[str, pl.DataFrame]:
    """Rows of a table on one input by run: suspect ones and numbers that are none left out."""
    frame = (
        compared.scan(table)
        .filter(pl.col("input") == input_name, ~pl.col("suspect"), pl.col(value).is_finite())
        .select("run", time, "segment", "step", value)
        .collect()
    )
    parts = frame.partition_by("run", as_dict=True, maintain_order=True)
    return {str(run): part for (run,), part in parts.items() if part.height >= _FEWEST}


def follow_published_runs(
    compared: ComparedRuns, runs: pl.DataFrame
) -> tuple[dict[str, Samples], pl.DataFrame, list[str]]:
    """Window norms of the published chain for every run that allows it.

    Returns:
        Samples by run; the runs with ``published_norm`` on their rows of the command; notes on the fits.
    """
    samples: dict[str, Samples] = {}
    notes: list[str] = []
    for run, manifest in compared.manifests.items():
        findings = set(manifest.read("findings")["id"]) if "findings" in manifest.tables else set()
        found = follow_published(
            manifest.read("slip"),
            manifest.read("poses"),
            limits=read_limits(manifest.part("vehicle")),
            command_is_scaled="command_scale" in findings,
        )
        if found is None:
            continue
        samples[run] = _take_windows(found.norms)
        scaled = f", command scaled by {found.scale[0]:.2f} forward and {found.scale[1]:.2f} in yaw" * (
            found.scale != (1.0, 1.0)
        )
        notes.append(f"published chain, {run}: wheels lag with tau = {found.tau_s:.2f} s{scaled}")
    medians = pl.DataFrame(
        {"run": list(samples), "published_norm": [own.median for own in samples.values()]},
        schema={"run": pl.String, "published_norm": pl.Float64},
    ).with_columns(pl.lit("command").cast(runs.schema["input"]).alias("input"))
    return samples, runs.update(medians, on=["run", "input"]), notes


def _take_samples(part: pl.DataFrame) -> Samples:
    times = part["t"].to_numpy()
    period = float(np.median(np.diff(times)))
    ticks = np.round((times - times[0]) / max(period, 1e-6)).astype(np.int64)
    return _as_samples(part, "modulus", ticks)


def _take_windows(norms: pl.DataFrame) -> Samples:
    """Windows as samples; several that start within one grid step of 2 s follow each other."""
    order = norms.sort("t_start")
    times = order["t_start"].to_numpy()
    ticks = np.maximum.accumulate(np.round((times - times[0]) / WINDOW_S).astype(np.int64))
    # Windows start where steps do, so two may round to one tick: count on from the last then.
    ticks = np.maximum.accumulate(ticks - np.arange(ticks.size)) + np.arange(ticks.size)
    return _as_samples(order, "window_norm", ticks)


def _as_samples(rows: pl.DataFrame, value: str, ticks: Ints) -> Samples:
    sizes = np.unique(rows["step"].to_numpy(), return_counts=True)[1]
    return Samples(
        values=rows[value].to_numpy(),
        ticks=ticks,
        pieces=rows["segment"].to_numpy().astype(np.int64),
        step=float(np.median(sizes)),
    )
