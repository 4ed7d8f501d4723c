"""Slip relative to a model: how far the motion was from what a fitted model predicts."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.analysis.errors import JobError
from pipeline.core.arrays import Floats
from pipeline.core.errors import SlipError, naming_os_errors
from pipeline.stages.finding import Finding
from pipeline.vehicles import Vehicle

COLUMNS = ("model_x", "model_y", "model_w", "residual_modulus")


def hash_model(path: Path | None) -> str | None:
    """Hash of a model file's bytes and of the Python that is run for it; None without one.

    Raises:
        JobError: the file cannot be read.
        MotionError: the model file is wrong.
    """
    if path is None:
        return None
    hint = "Check the path; `slip model new` makes one."
    with naming_os_errors(
        JobError, "model_not_found", "the model file cannot be read", where=path, hint=hint
    ):
        content = path.read_bytes()
    from pipeline.models import read_model  # noqa: PLC0415 - heavy

    return hashlib.sha256(content + "".join(read_model(path).code).encode()).hexdigest()


def add_model(
    slip: pl.DataFrame,
    tables: Mapping[str, pl.DataFrame],
    path: Path,
    vehicle: Vehicle,
    *,
    length: float,
) -> tuple[pl.DataFrame, tuple[Finding, ...]]:
    """Table `slip` with the velocity of a model and the modulus of what is left of it; what was left out.

    Args:
        slip: table `slip`, its columns for a model empty.
        tables: `poses`, `alignments`, `commands`, `wheels`, `imu`, as far as the log has them.
        path: the model file.
        vehicle: of the run; the model must be of its kind.
        length: length scale L [m] of the modulus.

    Raises:
        MotionError: the model file is wrong.
        JobError: the model is of another kind of vehicle.
    """
    from pipeline.identification import Input  # noqa: PLC0415 - heavy
    from pipeline.identification.predict import predict_at  # noqa: PLC0415 - heavy
    from pipeline.models import read_model  # noqa: PLC0415 - heavy
    from pipeline.runs import load_run  # noqa: PLC0415 - heavy

    file = read_model(path)
    model = file.model
    found = [Finding("model_code_left_out", "warning", warning, where="model") for warning in file.warnings]
    if model.vehicle.kind != vehicle.kind:
        what = f"the model is of a vehicle of kind {model.vehicle.kind!r}, the run's is {vehicle.kind!r}"
        raise JobError("wrong_model", what, where=str(path), hint="Give a model of this vehicle.")
    run = load_run({**tables, "slip": slip}, model.vehicle, name=str(path))
    parts = []
    for name in slip["input"].unique(maintain_order=True):
        part = slip.filter(pl.col("input") == name)
        try:
            predicted = predict_at(model, run, Input(name), part["t"].to_numpy())
        except SlipError as error:
            # Encoders that are dead, for example: there is an input, but no model can follow it.
            found.append(Finding("model_not_followed", "warning", f"{name}: {error}", where="model"))
            parts.append(part)
            continue
        columns = [*predicted.T, find_residual_modulus(predicted, part, length=length)]
        parts.append(
            part.with_columns(
                pl.Series(column, values).fill_nan(None)
                for column, values in zip(COLUMNS, columns, strict=True)
            )
        )
    return pl.concat(parts), tuple(found)


def find_residual_modulus(predicted: Floats, slip: pl.DataFrame, *, length: float) -> Floats:
    """Modulus of what a model leaves of the motion [m/s], shape (n,).

    Args:
        predicted: body velocities of the model at the rows of ``slip`` [m/s, m/s, rad/s], shape (n, 3).
        slip: rows of table `slip` of one input.
        length: length scale L [m] of the modulus.
    """
    left = (predicted - slip.select("v_x", "v_y", "v_w").to_numpy()) * np.array([1.0, 1.0, length])
    return np.asarray(np.sqrt(np.sum(left**2, axis=1)), dtype=np.float64)
