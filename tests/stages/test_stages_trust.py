"""Poses that are integrated wheels are told from a localization that sees how the wheels skid."""

from __future__ import annotations

import numpy as np
import pytest
from stage_logs import make_samples

from pipeline.sources import find_preset
from pipeline.stages.trust import Samples, check_independence

PERIODS_S = (0.05, 0.1)


def drive_curves(drift_s: float, uneven_m: float = 0.0) -> Samples:
    """Wheels that drive curves of all kinds, and poses that follow them but for v_y = drift_s v w.

    Args:
        drift_s: by which they go beside them.
        uneven_m: spread of what single steps are beside that, and the next ones make good.
    """
    times = np.arange(0.0, 60.0, 0.05)
    speed, turn = 1.0 + 0.5 * np.sin(0.7 * times), 0.6 * np.sin(0.4 * times)
    velocity = np.column_stack((speed, drift_s * speed * turn, turn))
    beside = np.random.default_rng(1).normal(0.0, uneven_m, times.size)
    velocity[:, 1] += np.diff(beside, prepend=0.0) / 0.05
    return make_samples(times, np.column_stack((speed, np.zeros(times.size), turn)), velocity)


@pytest.mark.parametrize(
    ("drift_s", "found"),
    [(0.0, True), (0.025, True), (-0.025, True), (0.05, True), (0.005, True), (-0.04, False), (-0.1, False)],
)
def test_steps_before_or_after_the_turn_are_odometry_and_a_skid_is_not(
    drift_s: float,
    found: bool,  # noqa: FBT001 - one of the cases
) -> None:
    told = check_independence(drive_curves(drift_s), find_preset("husky_a200"), PERIODS_S)
    assert [finding.id for finding in told] == (["pose_from_wheels"] if found else [])


def test_uneven_steps_that_do_not_add_up_are_odometry_all_the_same() -> None:
    vehicle = find_preset("husky_a200")
    assert check_independence(drive_curves(0.025, uneven_m=5e-5), vehicle, PERIODS_S)
    assert not check_independence(drive_curves(0.025, uneven_m=5e-4), vehicle, PERIODS_S)
