"""Folds of blocked cross-validation, and fits without one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pipeline.core import (
    FOLDS,
    Flags,
    Floats,
    Ints,
)
from pipeline.estimation.fit import PathFit, invert

if TYPE_CHECKING:
    from pipeline.estimation.model_state import ModelState
    from pipeline.estimation.window_residuals import WindowResiduals

# Blocked cross-validation: ten-second stretches are tested with parameters fitted without them.
#
# Residuals of field data are autocorrelated: stretches are not divided, and gaps separate training windows
# from test windows.

GAP_S = 1.5
"""Gap between training and test windows [s]: residuals are correlated for about a second."""
_LEAST_SHARE = 0.01
"""Regularization of each parameter in a fold, as a share of the information of the whole run."""


@dataclass(frozen=True)
class Fold:
    """Masks of the training windows and of the test windows."""

    train: Flags
    test: Flags


class _Rows(Protocol):
    """Rows with a run and times: windows, or the steps of a path."""

    run: Ints
    times: Floats


def make_folds(windows: WindowResiduals) -> tuple[Fold, ...]:
    """Five folds of ten-second stretches, with gaps of 1.5 s between training and test windows."""
    tests = [windows.unit % FOLDS == number for number in range(FOLDS)]
    return tuple(Fold(~find_near(windows, windows, test), test) for test in tests)


def find_near(rows: _Rows, held: _Rows, test: Flags) -> Flags:
    """Mask of rows within the gap of test rows of the same runs, shape (n,).

    Args:
        rows: the rows.
        held: those with the test rows; may be the same.
        test: mask of these, shape (m,).
    """
    near = np.zeros(rows.run.size, dtype=bool)
    for run in np.unique(rows.run).tolist():
        mine, judged = rows.run == run, (held.run == run) & test
        starts, ends = np.sort(held.times[judged, 0]), np.sort(held.times[judged, 1])
        # A row is near if more test rows begin before its end than end before its start.
        later = np.searchsorted(starts, rows.times[mine, 1] + GAP_S)
        earlier = np.searchsorted(ends, rows.times[mine, 0] - GAP_S)
        near[mine] = later > earlier
    return near


def refit(fit: PathFit, train: Flags) -> ModelState:
    """State of the fit on some steps only, by one step from its solution with its own derivatives.

    Args:
        fit: fit to all steps.
        train: mask of the steps to fit, shape (n,).
    """
    smooth, state = fit.smooth, fit.state
    if not smooth or not train.any():
        return state
    white = fit.white
    columns = white.columns[:, smooth]
    own = _LEAST_SHARE * np.diag(np.einsum("ij,ij->j", columns, columns))
    free = [fit.free[index] for index in smooth]
    prior = fit.path.prior
    rows = train[white.rows]
    normal = columns[rows].T @ columns[rows] + own + np.diag(prior.weigh(state, fit.free)[smooth])
    pull = columns[rows].T @ white.residual[rows] + prior.pull(state, fit.free)[smooth]
    return state.move(free, (invert(normal) @ pull).tolist())
