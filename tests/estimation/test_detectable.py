"""How large an effect must be to be seen: out of the noise, and worth a name."""

from __future__ import annotations

from statistics import NormalDist

import pytest

from pipeline.estimation.acceptance import LEAST_GAIN, LEAST_T
from pipeline.estimation.search import DETECTED, DETECTED_SHARE, _find_detectable
from pipeline.models import find_effect


@pytest.mark.parametrize(
    ("standard_errors", "share", "size"),
    [
        (10.0 * DETECTED, 1.0, 0.01),
        (2.0 * DETECTED, 1.0, 0.05),
        (10.0 * DETECTED, 4.0 * LEAST_GAIN, 0.05),
        (10.0 * DETECTED, 0.25 * LEAST_GAIN, 0.2),
    ],
)
def test_what_takes_less_of_the_loss_than_a_name_must_is_not_said_to_be_seen(
    standard_errors: float, share: float, size: float
) -> None:
    usual = find_effect("lateral_skid")(c=0.1)
    (found,) = _find_detectable(usual, standard_errors, share)
    least = usual.parameters[0].least
    assert found.size == pytest.approx(max(size, least.size if least else 0.0))


def test_the_stated_share_is_that_of_logs_in_which_the_size_is_named() -> None:
    """An estimate of unit error about that size is significant in so many of a hundred logs."""
    assert round(100.0 * NormalDist().cdf(DETECTED - LEAST_T)) == DETECTED_SHARE
