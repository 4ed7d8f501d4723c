"""Errors of a model: of displacement over half a second, and of predictions over 2 s."""

from __future__ import annotations

import numpy as np

from pipeline.core import Floats, robust_spreads
from pipeline.results import Errors


def measure_errors(residuals: Floats, position: Floats, yaw: Floats) -> Errors:
    """Errors of residuals (n, 3) and of prediction errors (m,); NaN without predictions."""
    position, yaw = position[np.isfinite(position)], yaw[np.isfinite(yaw)]
    known = residuals if len(residuals) else np.full((1, 3), np.nan)
    none = np.full(1, np.nan)
    position, yaw = (position, yaw) if position.size else (none, none)
    return Errors(
        velocity_rms=tuple(np.sqrt(np.mean(known**2, axis=0)).tolist()),
        velocity_spread=tuple(robust_spreads(known).tolist()),
        t_mrmse_m=float(np.sqrt(np.mean(position**2))),
        r_mrmse_rad=float(np.sqrt(np.mean(yaw**2))),
        t_mean_m=float(position.mean()),
        r_mean_rad=float(yaw.mean()),
        t_median_m=float(np.median(position)),
        r_median_rad=float(np.median(yaw)),
        windows=int(residuals.shape[0]),
    )
