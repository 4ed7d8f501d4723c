"""Errors of a model: of displacement over half a second, and of predictions over 2 s."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.core import JSON_DIGITS, Floats, finite_or_none, pick_finite, robust_spreads


@dataclass(frozen=True)
class Errors:
    """Errors of a model.

    Attributes:
        velocity_rms: rms of displacement over half a second, over half a second: x, y [m/s], w [rad/s].
        velocity_spread: 1.4826 times the median size of the same; far below the rms if few stretches
            contain most of the error.
        t_mrmse_m: root mean square position error over windows and steps of a 2 s horizon [m].
        r_mrmse_rad: the same of the wrapped yaw [rad].
        t_mean_m, r_mean_rad: the published variant: mean of the per-step error norms.
        t_median_m, r_median_rad: median of the same: the error of a typical prediction.
        windows: number of windows scored.
    """

    velocity_rms: tuple[float, float, float]
    velocity_spread: tuple[float, float, float]
    t_mrmse_m: float
    r_mrmse_rad: float
    t_mean_m: float
    r_mean_rad: float
    t_median_m: float
    r_median_rad: float
    windows: int

    def ratios(self, other: Errors) -> tuple[float, float, float, float, float]:
        """Ratios of these errors to others: x, y, w, T, R."""
        mine = (*self.velocity_rms, self.t_mrmse_m, self.r_mrmse_rad)
        theirs = (*other.velocity_rms, other.t_mrmse_m, other.r_mrmse_rad)
        x, y, w, t, r = (a / b if b > 0.0 else float("nan") for a, b in zip(mine, theirs, strict=True))
        return x, y, w, t, r


def measure_errors(residuals: Floats, position: Floats, yaw: Floats) -> Errors:
    """Errors of residuals (n, 3) and of prediction errors (m,); NaN without predictions."""
    position, yaw = position[np.isfinite(position)], yaw[np.isfinite(yaw)]
    known = residuals if len(residuals) else np.full((1, 3), np.nan)
    rms = np.sqrt(np.mean(known**2, axis=0))
    spread = robust_spreads(known)
    none = np.full(1, np.nan)
    position, yaw = (position, yaw) if position.size else (none, none)
    return Errors(
        velocity_rms=_triple(rms),
        velocity_spread=_triple(spread),
        t_mrmse_m=float(np.sqrt(np.mean(position**2))),
        r_mrmse_rad=float(np.sqrt(np.mean(yaw**2))),
        t_mean_m=float(position.mean()),
        r_mean_rad=float(yaw.mean()),
        t_median_m=float(np.median(position)),
        r_median_rad=float(np.median(yaw)),
        windows=int(residuals.shape[0]),
    )


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, w = values.tolist()
    return x, y, w


def errors_as_json(errors: Errors) -> dict[str, object]:
    """The documented error keys and the published variant."""

    def cut(value: float) -> float | None:
        return finite_or_none(value, JSON_DIGITS)

    return {
        "velocity_rms": [cut(value) for value in errors.velocity_rms],
        "velocity_spread": [cut(value) for value in errors.velocity_spread],
        **pick_finite(errors, "t_mrmse_m", "r_mrmse_rad", digits=JSON_DIGITS),
        "published_t_mean_m": cut(errors.t_mean_m),
        "published_r_mean_rad": cut(errors.r_mean_rad),
        **pick_finite(errors, "t_median_m", "r_median_rad", digits=JSON_DIGITS),
        "windows": errors.windows,
    }
